"""Surface points of instances as KD-trees, kept while the store stays as it is."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.records import Instance
from list3r.memory.store import Store

_MAX_POINTS = 4000
"""More points of one instance are thinned out: that is finer than the surfaces are known."""

_trees: WeakKeyDictionary[Store, dict[int, tuple[bytes, cKDTree, float]]] = WeakKeyDictionary()


def surface_tree(store: Store, instance: Instance) -> cKDTree:
    """KD-tree of an instance's support in the world; its box's corners where it has no support."""
    return _surface(store, instance)[0]


def _surface(store: Store, instance: Instance) -> tuple[cKDTree, float]:
    """The tree, and how far its points lie from each other: what is nearer than that touches, as far as is known."""
    known = _trees.setdefault(store, {})
    stamp = np.concatenate([instance.aabb.ravel(), instance.center, [instance.observations]]).tobytes()
    if instance.id not in known or known[instance.id][0] != stamp:
        tree = cKDTree(_points(store, instance))
        known[instance.id] = (stamp, tree, _spacing(tree))
    return known[instance.id][1], known[instance.id][2]


def _spacing(tree: cKDTree) -> float:
    if tree.n < 9:
        return 0.0
    sample = np.asarray(tree.data)[:: -(-tree.n // 200)]
    return float(np.median(np.asarray(tree.query(sample, k=2)[0])[:, 1]))


def _points(store: Store, instance: Instance) -> NDArray[np.float64]:
    """Support points inside the box, which leaves strays out, as deriving the box did."""
    points = store.support(instance.id).points.astype(np.float64)
    slack = 0.02 * float(np.max(instance.box.size)) + 1e-9
    inside = np.all((points >= instance.aabb[0] - slack) & (points <= instance.aabb[1] + slack), axis=1)
    points = points[inside] if inside.any() else instance.box.corners()
    return points[:: -(-len(points) // _MAX_POINTS)]


def distance_to_point(store: Store, instance: Instance, point: NDArray[np.float64]) -> float:
    """From a point to the nearest surface point of an instance."""
    return float(np.min(surface_tree(store, instance).query(point)[0]))


def distance_between(store: Store, a: Instance, b: Instance) -> float:
    """Between the nearest surface points of two instances; 0 where they touch, which is where the points of one lie as
    near to the other as to each other.
    """
    (one, spacing_one), (two, spacing_two) = _surface(store, a), _surface(store, b)
    small, large = sorted((one, two), key=lambda t: t.n)
    gap = float(np.min(large.query(np.asarray(small.data))[0]))
    return 0.0 if gap <= max(spacing_one, spacing_two) else gap
