"""What an instance covers as seen from above: an outline that follows corners, which a box fills in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from list3r.memory.core.geometry import Array, OrientedBox
from list3r.memory.core.records import Instance
from list3r.memory.library.rooms.outline import area_of, encloses, outline
from list3r.memory.library.rooms.space import Grid
from list3r.memory.library.world.scale import lengths_of
from list3r.memory.store.store import Store
from list3r.queries.views.surfaces import InstanceSurface, surfaces_of

_CLOSED_SPACINGS = 3.0
"""Between points that are nearer than twice this, in spacings of the surface's points, there is surface."""
_CLOSED_SHARE = 0.05
"""And where they are nearer than twice this share of the longer side."""
_WHOLE = 0.95
"""Gaps that are wider are closed until so much of the surface is within one outline."""
_LARGE_M = 0.5
"""What is longer is furniture."""
_FULL = 0.7
"""Share of its convex hull that an outline fills at least where its notches are taken as unseen: an L has less."""
_CELLS = 4
"""Cells in the radius of closing."""


def footprints_of(store: Store, instances: Sequence[Instance]) -> list[Array]:
    """Return the outline of what each instance covers, world x and y, counterclockwise, open. Shapes (N, 2).

    The largest outline where there are several; that of the box where no surface was measured. Means something where
    gravity is known. A morphological closing of the points' shadow (Serra, 1982), without holes.
    """
    return [footprint(surface) for surface in surfaces_of(store, instances)]


def large_footprints(store: Store, instances: Sequence[Instance]) -> dict[int, Array]:
    """Return the footprints of the large ones of these things by id; of small ones the box says as much."""
    least = 0.0 if lengths_of(store).metric == "relative" else _LARGE_M
    large = [i for i in instances if i.structure is None and np.ptp(i.aabb[:, :2], axis=0).max() >= least]
    return dict(zip((i.id for i in large), footprints_of(store, large), strict=True))


def footprint(surface: InstanceSurface) -> Array:
    """Return the outline of a surface as seen from above, as `footprints_of` does."""
    shadow = surface.points[:, :2]
    longest = float(np.ptp(shadow, axis=0).max())
    if surface.support is None or len(shadow) < 9 or longest <= 0.0:
        return _of_box(surface.instance.box)
    radius = max(_CLOSED_SPACINGS * surface.spacing, _CLOSED_SHARE * longest)
    while True:
        ring = _closed(shadow, radius)
        if radius >= longest or encloses(ring, shadow).mean() >= _WHOLE:
            break
        radius *= 1.5
    if len(ring) < 3:  # a picture on a wall
        return _of_box(surface.instance.box)
    around = ring[ConvexHull(ring).vertices]
    return around if area_of(ring) >= _FULL * area_of(around) else ring


def _of_box(box: OrientedBox) -> Array:
    x, y = (box.rotation[:2, k] * box.size[k] / 2 for k in range(2))
    corners = box.center[:2] + np.array([-x - y, x - y, x + y, -x + y])
    return np.asarray(corners if area_of(corners) >= 0 else corners[::-1])


def _closed(shadow: Array, radius: float) -> Array:
    """Return the largest outline of places, x and y, between which gaps of less than twice a radius are closed."""
    from scipy.ndimage import distance_transform_edt

    grid = Grid.over(shadow, radius / _CELLS)
    empty = np.pad(grid.count(shadow) == 0, _CELLS + 1, constant_values=True)
    near = np.asarray(distance_transform_edt(empty)) <= _CELLS
    covered = np.asarray(distance_transform_edt(near)) > _CELLS
    return outline(covered[_CELLS + 1 : -_CELLS - 1, _CELLS + 1 : -_CELLS - 1], grid)
