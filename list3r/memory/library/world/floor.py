"""The floor, found where it is seen: a long walk climbs, and what is placed drifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from list3r.memory.core.geometry import Array
from list3r.memory.library.overlap.planes import Planes
from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.world.gravity import GravitySettings, floor_height

_UP = np.array([0.0, 0.0, 1.0])
_POINTS = 60
"""Points of an instance that tell whether something lies under the floor, about."""


def floor_near(
    near: Sequence[InstanceGeometry], camera_centers: Array, unit: float, settings: GravitySettings
) -> float | None:
    """Return the height of the floor by the instances of one place; z must be up.

    It is found as that of a whole memory is (`gravity.floor_height`), of what lies near and of the cameras that saw it,
    (F, 3), so that it holds however the place lies to others. None where no floor was seen there.
    """
    flat = [b for b in near if b.normal is not None]
    points = [b.points[:: max(1, len(b.points) // _POINTS)] for b in near]
    number = {b.id: n for n, b in enumerate(flat)}
    if not flat or not len(camera_centers):
        return None
    planes = Planes(
        normal=np.array([b.normal for b in flat]),
        center=np.array([np.median(b.points, axis=0) for b in flat]),
        area=np.array([np.prod(np.sort(b.box.size)[1:]) for b in flat]),
        points=np.concatenate(points),
        owner=np.repeat([number.get(b.id, -1) for b in near], [len(p) for p in points]),
    )
    return floor_height(_UP, planes, camera_centers, unit, settings)
