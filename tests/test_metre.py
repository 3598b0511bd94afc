"""What a metre is where nobody knows: by depth, and in halls by how high the cameras are over a wide floor."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.memory.core.geometry import rotation_exp
from list3r.memory.library.overlap.metre import height_over_floor, metre_by_height, metre_by_sight

LOOKING_DOWN = 0.12


def cameras(height: float) -> np.ndarray:
    """Ten cameras that walk along y and look along it, slightly down; z is up. Shape (10, 4, 4)."""
    T = np.tile(np.eye(4), (10, 1, 1))
    ahead = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    T[:, :3, :3] = ahead @ rotation_exp(np.array([-LOOKING_DOWN, 0.0, 0.0]))
    T[:, 1, 3], T[:, 2, 3] = np.linspace(0.0, 1.0, 10), height
    return T


def seen(width: float, length: float, floor: float = 0.0, below: float = 0.0) -> np.ndarray:
    """Points of a level surface and of a wall behind it; a share of points lies far under it. Shape (N, 3)."""
    rng = np.random.default_rng(0)
    level = rng.uniform([-width / 2, 1.0, floor], [width / 2, 1.0 + length, floor], (9000, 3))
    wall = rng.uniform([-width / 2, 1.0 + length, floor], [width / 2, 1.0 + length, floor + 2.5], (3000, 3))
    under = rng.uniform([-1.0, 1.0, floor - 0.9], [1.0, 2.0, floor - 0.7], (int(12000 * below), 3))
    return np.concatenate([level, wall, under]) + rng.normal(0.0, 0.01, (12000 + int(12000 * below), 3))


def metre(points: np.ndarray, T: np.ndarray) -> float:
    depth = (points - T[:, :3, 3].mean(axis=0)) @ T[0, :3, 2]
    return metre_by_sight(points, depth, T)


def test_in_a_hall_the_height_of_the_cameras_tells() -> None:
    points, T = seen(8.0, 6.0), cameras(1.4)
    assert np.median((points - T[0, :3, 3]) @ T[0, :3, 2]) > 4.0  # by depth alone a metre would be more than two
    assert height_over_floor(points, T) == pytest.approx(1.4, abs=0.03)
    assert metre(points, T) == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("scale", [0.03, 7.0])
def test_a_metre_scales_with_the_chunk(scale: float) -> None:
    points, T = seen(8.0, 6.0), cameras(1.4)
    larger = T.copy()
    larger[:, :3, 3] *= scale
    assert metre(points * scale, larger) == pytest.approx(scale * metre(points, T), rel=1e-3)


def test_a_table_is_no_floor() -> None:
    table, T = seen(1.6, 0.9, floor=0.75), cameras(1.4)
    assert height_over_floor(table, T) is None
    assert metre(table, T) == pytest.approx(np.median((table - T[:, :3, 3].mean(axis=0)) @ T[0, :3, 2]) / 2.0, rel=1e-6)
    assert height_over_floor(seen(8.0, 6.0, below=0.1), cameras(1.4)) is None  # something lies under it
    assert metre_by_sight(np.zeros((0, 3)), np.zeros(0), T) == 1.0


def test_a_robot_says_nothing_about_a_metre() -> None:
    assert metre_by_height(0.3, 1.0) == metre_by_height(None, 1.0) == metre_by_height(-1.0, 1.0) == 1.0
    assert metre_by_height(1.4, 1.6) == pytest.approx(1.05, abs=0.01)
