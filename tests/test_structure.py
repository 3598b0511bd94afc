"""What bounds a room: a floor is level, lies at the floor's height and is no thicker than depth makes it."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.memory.core.geometry import upright_box
from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.relations.structure import StructureSettings, classify_structure

COMPUTED = StructureSettings(floor_band_m=StructureSettings().computed_floor_band_m)


def level(height: float, thickness: float, size: float = 3.0, flagged: float = 0.0, x: float = 0.0) -> InstanceGeometry:
    """A level surface whose middle four fifths of points are so thick; chunks took that share of it for structure."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-size / 2, -size / 2, -1.0), (size / 2, size / 2, 1.0), (3000, 3))
    points[:, 2] = height + points[:, 2] * thickness / 1.6
    points[:, 0] += x
    aabb = np.stack([points.min(axis=0), points.max(axis=0)])
    rgb, up = np.zeros((len(points), 3), np.uint8), np.array([0.0, 0.0, 1.0])
    return InstanceGeometry(1, points, rgb, upright_box(points), aabb, up, flagged=flagged)


def upright(low: tuple[float, float], high: tuple[float, float], flagged: float) -> InstanceGeometry:
    """A surface of 2 cm that faces along y, from `low` to `high` in x and z; chunks took that share for structure."""
    points = np.random.default_rng(6).uniform((low[0], 0.0, low[1]), (high[0], 0.02, high[1]), (3000, 3))
    aabb = np.stack([points.min(axis=0), points.max(axis=0)])
    rgb, ahead = np.zeros((len(points), 3), np.uint8), np.array([0.0, -1.0, 0.0])
    return InstanceGeometry(1, points, rgb, upright_box(points), aabb, ahead, flagged=flagged)


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


@pytest.mark.parametrize(
    ("floor", "rug", "settings", "said"),
    [
        (1.0, 0.0, StructureSettings(), ["floor", None]),
        (1.0, 1.0, StructureSettings(), ["floor", "floor"]),
        (0.0, 0.0, StructureSettings(), ["floor", "floor"]),
        (1.0, 0.0, StructureSettings(least_flagged=0.0), ["floor", "floor"]),
    ],
)
def test_a_rug_is_what_chunks_told_from_a_floor(
    floor: float, rug: float, settings: StructureSettings, said: list[str | None]
) -> None:
    """Discoverers that never tell structure leave the word to height alone, as does computed depth."""
    there = [level(0.0, 0.02, flagged=floor), level(0.012, 0.02, 1.2, flagged=rug)]
    assert classify_structure(there, 0.0, lambda body: 1.5, 1.0, settings) == said


def test_what_no_floor_surrounds_is_the_floor() -> None:
    """A carpet beyond a table is no rug, though chunks took it for one: a rug has floor beside it."""
    there = [level(0.0, 0.02, 1.0, flagged=1.0), level(0.012, 0.02, 1.2, x=1.5)]
    assert classify_structure(there, 0.0, lambda body: 1.5, 1.0) == ["floor", "floor"]


@pytest.mark.parametrize(
    ("wall", "door", "settings", "said"),
    [
        (1.0, 0.0, StructureSettings(), ["wall", None]),
        (1.0, 1.0, StructureSettings(), ["wall", "wall"]),
        (0.0, 0.0, StructureSettings(), ["wall", "wall"]),
        (1.0, 0.0, StructureSettings(least_flagged=0.0), ["wall", "wall"]),
    ],
)
def test_a_door_is_what_chunks_told_from_a_wall(
    wall: float, door: float, settings: StructureSettings, said: list[str | None]
) -> None:
    """Discoverers that never tell structure leave the word to size and to what lies behind, as does computed depth."""
    there = [upright((0.0, 0.0), (2.5, 2.4), wall), upright((2.5, 0.0), (3.4, 2.1), door)]
    assert classify_structure(there, 0.0, lambda body: 1.5, 1.0, settings) == said


def test_a_floor_that_chunks_told_makes_no_door_of_a_wall_that_they_missed() -> None:
    there = [level(0.0, 0.02, flagged=1.0), upright((0.0, 0.0), (2.5, 2.4), 0.0)]
    assert classify_structure(there, 0.0, lambda body: 1.5, 1.0) == ["floor", "wall"]
