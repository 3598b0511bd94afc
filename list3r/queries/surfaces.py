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

_trees: WeakKeyDictionary[Store, dict[int, tuple[bytes, cKDTree]]] = WeakKeyDictionary()


def surface_tree(store: Store, instance: Instance) -> cKDTree:
    """KD-tree of an instance's support in the world; its box's corners where it has no support."""
    known = _trees.setdefault(store, {})
    stamp = np.concatenate([instance.aabb.ravel(), instance.center, [instance.observations]]).tobytes()
    if instance.id not in known or known[instance.id][0] != stamp:
        known[instance.id] = (stamp, cKDTree(_points(store, instance)))
    return known[instance.id][1]


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
    """Between the nearest surface points of two instances."""
    small, large = sorted((surface_tree(store, a), surface_tree(store, b)), key=lambda t: t.n)
    return float(np.min(large.query(np.asarray(small.data))[0]))
