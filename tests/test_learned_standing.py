"""Legs and feet join what would hover without them, and nothing else does."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.instances.learned.cut import CloudCut
from list3r.instances.learned.graph import Surroundings, chunk_surface
from list3r.instances.learned.standing import StandingSettings, with_supports
from list3r.instances.learned.things import ThingVerdicts
from tests.test_learned import cloud_of

Patch = tuple[int, tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Number of the cluster, lower and upper corner, normal."""

UP, SIDE = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
FLOOR: Patch = (0, (-1.0, -1.0, 0.0), (1.0, 1.0, 0.0), UP)
TOP: Patch = (1, (-0.4, -0.3, 0.7), (0.4, 0.3, 0.72), UP)
LEGS: list[Patch] = [
    (2 + k, (x, y, 0.03), (x + 0.02, y, 0.6), SIDE)
    for k, (x, y) in enumerate(((-0.38, -0.28), (0.36, -0.28), (-0.38, 0.28), (0.36, 0.28)))
]


def after(patches: list[Patch], things: set[int], structure: set[int]) -> list[int]:
    """The cluster of which each cluster is in the end; -1 for none that is left."""
    points, normals, labels = [], [], []
    for number, low, high, normal in patches:
        axes = [np.arange(a, max(b, a + 0.005), 0.01) + 0.005 for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        points.append(grid)
        normals.append(np.tile(np.array(normal), (len(grid), 1)))
        labels.append(np.full(len(grid), number))
    every, numbers = np.concatenate(points), np.concatenate(labels)
    cloud = cloud_of(every.astype(np.float32), np.concatenate(normals).astype(np.float32))
    first = {tuple(c): n for c, n in zip(np.floor(every / 0.01).astype(int).tolist(), numbers.tolist(), strict=True)}
    before = np.array([first[tuple(c)] for c in np.floor(cloud.points / 0.01).astype(int).tolist()], np.int32)
    count = int(numbers.max()) + 1
    bound = np.isin(np.arange(count), list(structure))
    whole = np.where(np.isin(np.arange(count), list(things)), 0.9, 0.1).astype(np.float32)
    told = ThingVerdicts(bound.astype(np.float32), whole, np.eye(count, dtype=np.float32))
    surface = chunk_surface(cloud, (), Surroundings(np.array(UP), 1.0, 1.4, computed=False))
    cut = with_supports(surface, CloudCut(before, told), bound | (whole > 0.5), StandingSettings())
    was = [int(row.argmax()) for row in cut.told.names]
    return [was[int(np.bincount(cut.labels[before == k]).argmax())] for k in range(count)]


def test_a_table_top_takes_its_legs() -> None:
    assert after([FLOOR, TOP, *LEGS], things={1}, structure={0}) == [0, 1, 1, 1, 1, 1]


def test_legs_in_bits_are_reached_over_gaps() -> None:
    bits: list[Patch] = [(2, (0.0, 0.0, 0.45), (0.02, 0.0, 0.55), SIDE), (3, (0.0, 0.0, 0.05), (0.02, 0.0, 0.25), SIDE)]
    assert after([FLOOR, TOP, *bits], things={1}, structure={0}) == [0, 1, 1, 1]


def test_a_leg_that_is_a_thing_of_its_own_stays_one() -> None:
    assert after([FLOOR, TOP, *LEGS], things={1, 2, 3, 4, 5}, structure={0}) == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("stands_on", ["floor", "wall", "ceiling"])
def test_what_is_held_takes_nothing(stands_on: str) -> None:
    bit: Patch = (2, (0.0, 0.5, 0.02), (0.02, 0.5, 0.2), SIDE)
    thing: dict[str, Patch] = {
        "floor": (1, (-0.2, 0.4, 0.02), (0.2, 0.6, 0.5), SIDE),
        "wall": (1, (-0.3, 0.95, 0.4), (0.3, 0.96, 0.9), (0.0, -1.0, 0.0)),
        "ceiling": (1, (-0.2, 0.4, 0.4), (0.2, 0.6, 0.95), SIDE),
    }
    wall: Patch = (0, (-1.0, 1.0, 0.0), (1.0, 1.0, 1.0), (0.0, -1.0, 0.0))
    ceiling: Patch = (0, (-1.0, -1.0, 1.0), (1.0, 1.0, 1.0), (0.0, 0.0, -1.0))
    low: Patch = (2, (0.0, 0.93, 0.05), (0.02, 0.93, 0.3), SIDE) if stands_on == "wall" else bit
    assert after([FLOOR, wall, ceiling, thing[stands_on], low], things={1}, structure={0}) == [0, 1, 2]


def test_a_cup_on_a_table_does_not_take_the_tables_legs() -> None:
    cup: Patch = (6, (0.33, -0.29, 0.73), (0.39, -0.23, 0.83), SIDE)
    table = TOP[:1] + TOP[1:]
    told = after([FLOOR, table, *LEGS, cup], things={6}, structure={0})
    assert told[6] == 6 and 6 not in told[1:6]


def test_what_lies_flat_on_the_floor_carries_nothing() -> None:
    flat: Patch = (2, (-0.2, -0.2, 0.01), (0.2, 0.2, 0.01), UP)
    assert after([FLOOR, TOP, flat], things={1}, structure={0}) == [0, 1, 2]
