"""What a thing covers as seen from above."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.memory.library.rooms.outline import area_of, encloses
from list3r.queries.views.footprint import footprint
from list3r.queries.views.surfaces import InstanceSurface

from .conftest import instance


def corner_counter(rng: np.random.Generator, turn: float) -> np.ndarray:
    """The top and fronts of a counter over a corner: 3 x 2 m, 0.6 m deep, turned about z."""
    top = rng.uniform((0, 0, 0.9), (3, 2, 0.9), (12_000, 3))
    top = top[(top[:, 0] < 0.6) | (top[:, 1] < 0.6)]
    front = np.column_stack([rng.uniform(0.6, 3, 800), np.full(800, 0.6), rng.uniform(0, 0.9, 800)])
    points = np.concatenate([top, front])
    c, s = np.cos(turn), np.sin(turn)
    points[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]])
    return points


@pytest.mark.parametrize("turn", (0.0, 0.5, 2.0))
def test_a_counter_over_a_corner_leaves_the_room_before_it_free(turn: float) -> None:
    points = corner_counter(np.random.default_rng(3), turn)
    thing = instance(1, tuple(points.mean(axis=0)), tuple(np.ptp(points, axis=0)), (200, 200, 200))
    ring = footprint(InstanceSurface(points, thing))
    c, s = np.cos(turn), np.sin(turn)
    before = np.array([[1.5, 1.2], [2.5, 1.5]]) @ np.array([[c, s], [-s, c]])
    assert not encloses(ring, before).any()
    assert area_of(ring) == pytest.approx(0.6 * 3 + 0.6 * 1.4, rel=0.1)
    assert encloses(ring, points).mean() > 0.95


def test_gaps_of_what_was_seen_in_part_are_closed() -> None:
    rng = np.random.default_rng(1)
    strips = [rng.uniform((x, 0, 0.4), (x + 0.05, 0.5, 0.4), (300, 3)) for x in (0.0, 0.2, 0.45)]
    points = np.concatenate(strips)
    ring = footprint(InstanceSurface(points, instance(1, (0.25, 0.25, 0.4), (0.5, 0.5, 0.01), (9, 9, 9))))
    assert encloses(ring, points).mean() > 0.95


def test_python_and_json_give_the_same_outline(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    with list3r.open(make_memory()) as memory:
        memory.export("json", tmp_path / "room.json")
        entries = json.loads((tmp_path / "room.json").read_text())["instances"]
        outlined = {e["id"]: e["footprint"] for e in entries if e["footprint"]}
        assert outlined and all(memory[n].structure is None for n in outlined)
        for n, ring in outlined.items():
            np.testing.assert_allclose(ring, memory.footprint(n), atol=1e-4)
            assert np.ptp(memory[n].aabb[:, :2], axis=0).max() >= 0.5


def test_what_is_thinner_than_its_points_are_apart_has_the_outline_of_its_box() -> None:
    points = np.random.default_rng(2).uniform((0, 0, 1), (0.8, 0.001, 1.5), (400, 3))
    ring = footprint(InstanceSurface(points, instance(1, (0.4, 0.0, 1.2), (0.8, 0.02, 0.5), (9, 9, 9))))
    assert len(ring) >= 3 and area_of(ring) > 0
