"""What bounds a room: a floor is level, lies at the floor's height and is no thicker than depth makes it."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.memory.geometry import upright_box
from list3r.memory.relations.instance_geometry import InstanceGeometry
from list3r.memory.relations.structure import StructureSettings, classify_structure

COMPUTED = StructureSettings(floor_band_m=StructureSettings().computed_floor_band_m)


def level(height: float, thickness: float, size: float = 3.0) -> InstanceGeometry:
    """A level surface whose middle four fifths of points are so thick."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-size / 2, -size / 2, -1.0), (size / 2, size / 2, 1.0), (3000, 3))
    points[:, 2] = height + points[:, 2] * thickness / 1.6
    aabb = np.stack([points.min(axis=0), points.max(axis=0)])
    return InstanceGeometry(
        1, points, np.zeros((len(points), 3), np.uint8), upright_box(points), aabb, np.array([0.0, 0.0, 1.0])
    )


@pytest.mark.parametrize(
    ("settings", "height", "thickness", "said"),
    [
        (StructureSettings(), 0.0, 0.02, "floor"),
        (StructureSettings(), 0.0, 0.16, None),
        (COMPUTED, 0.0, 0.16, "floor"),
        (COMPUTED, 0.0, 0.24, None),
        (COMPUTED, 0.15, 0.02, "floor"),
        (StructureSettings(), 0.15, 0.02, None),
        (COMPUTED, 0.7, 0.02, None),
    ],
)
def test_a_floor_is_at_the_floor_and_as_thin_as_its_band(
    settings: StructureSettings, height: float, thickness: float, said: str | None
) -> None:
    assert classify_structure([level(height, thickness)], 0.0, lambda body: 1.5, 1.0, settings) == [said]


def test_a_small_level_thing_on_the_floor_is_none() -> None:
    assert classify_structure([level(0.0, 0.02, size=0.4)], 0.0, lambda body: 1.5, 1.0) == [None]


def test_without_a_known_floor_there_is_none() -> None:
    assert classify_structure([level(0.0, 0.02)], None, lambda body: 1.5, 1.0) == [None]
