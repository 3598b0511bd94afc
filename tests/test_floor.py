"""The floor is told where it is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.world.floor import floor_near
from list3r.memory.library.world.gravity import GravitySettings
from tests.test_structure import level

SETTINGS = GravitySettings()


def seen_from(height: float) -> np.ndarray:
    """Cameras at about a height. Shape (F, 3)."""
    return np.random.default_rng(2).normal((0.0, 0.0, height), (1.0, 1.0, 0.1), (50, 3))


def numbered(*surfaces: InstanceGeometry) -> list[InstanceGeometry]:
    return [replace(b, id=n) for n, b in enumerate(surfaces, start=1)]


@pytest.mark.parametrize("storey", [0.0, -7.3, 31.0])
def test_the_floor_of_a_storey_is_told_there(storey: float) -> None:
    near = numbered(level(storey, 0.02), level(storey + 0.75, 0.02, 1.2))
    assert floor_near(near, seen_from(storey + 1.5), 1.0, SETTINGS) == pytest.approx(storey, abs=0.01)


def test_a_table_whose_floor_nobody_saw_is_no_floor() -> None:
    assert floor_near(numbered(level(0.75, 0.02)), seen_from(1.4), 1.0, SETTINGS) is None
    assert floor_near(numbered(level(0.75, 0.02), level(0.3, 0.02, 0.3)), seen_from(1.6), 1.0, SETTINGS) is None


def test_without_cameras_or_surfaces_no_floor_is_told() -> None:
    assert floor_near([], seen_from(1.5), 1.0, SETTINGS) is None
    assert floor_near(numbered(level(0.0, 0.02)), np.zeros((0, 3)), 1.0, SETTINGS) is None
