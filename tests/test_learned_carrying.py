"""What the network that tells what carries a thing sees, and what is joined by it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.instances.learned.carrying import Borders, CarrySettings, carry_pairs, clusters_of, joined_by_carrying
from list3r.instances.learned.graph import ChunkSurface, Surroundings, chunk_surface
from list3r.instances.learned.things import ThingVerdicts
from tests.test_learned import cloud_of

Patch = tuple[int, tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Number of the cluster, -1 for none; lower and upper corner, normal."""

UP, SIDE = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
FLOOR: Patch = (0, (-1.0, -1.0, 0.0), (1.0, 1.0, 0.0), UP)
TOP: Patch = (1, (-0.4, -0.3, 0.7), (0.4, 0.3, 0.72), UP)
LEG: Patch = (2, (-0.38, -0.28, 0.03), (-0.36, -0.28, 0.6), SIDE)
BIT: Patch = (-1, (0.36, 0.28, 0.03), (0.38, 0.28, 0.6), SIDE)
CUP: Patch = (3, (0.1, 0.1, 0.75), (0.16, 0.16, 0.83), SIDE)
NONE = Borders(np.zeros(0, int), np.zeros(0, int), np.zeros(0, np.float32), np.zeros(0, np.float32))

Cut = tuple[ChunkSurface, NDArray[np.int32], ThingVerdicts]


def scene(turn: float = 0.0) -> Cut:
    """A table's top, a leg in a cluster, a leg that is of none, and a cup, of which the top and the cup are told."""
    points, normals, labels = [], [], []
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    for number, low, high, normal in (FLOOR, TOP, LEG, BIT, CUP):
        axes = [np.arange(a, max(b, a + 0.005), 0.01) + 0.005 for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        points.append(grid @ R.T)
        normals.append(np.tile(R @ np.array(normal), (len(grid), 1)))
        labels.append(np.full(len(grid), number))
    every, numbers = np.concatenate(points), np.concatenate(labels)
    cloud = cloud_of(every.astype(np.float32), np.concatenate(normals).astype(np.float32))
    first = {tuple(p): n for p, n in zip(np.floor(every / 0.01).astype(int).tolist(), numbers.tolist(), strict=True)}
    own = np.array([first[tuple(p)] for p in np.floor(cloud.points / 0.01).astype(int).tolist()], np.int32)
    whole = np.array([0.9, 0.9, 0.1, 0.9], np.float32)
    told = ThingVerdicts(np.array([1, 0, 0, 0], np.float32), whole, np.full((4, 2), 0.5, np.float32))
    return chunk_surface(cloud, (), Surroundings(np.array(UP), 1.0, 1.4, computed=False)), own, told


def weights(column: int, sign: float, shift: float = 0.0) -> dict[str, NDArray[np.float32]]:
    """A network that says `sign * x[column] + shift` for positive values of the column's."""
    size = 71
    first = np.zeros((1, size), np.float32)
    first[0, column] = 1.0
    return {
        "names": np.array(["table", "mug"]),
        "carry.mean": np.zeros(size, np.float32),
        "carry.std": np.ones(size, np.float32),
        "carry.net.0.weight": first,
        "carry.net.0.bias": np.zeros(1, np.float32),
        "carry.net.2.weight": np.full((1, 1), sign, np.float32),
        "carry.net.2.bias": np.full(1, shift, np.float32),
    }


GAP = 44
"""Column of the least gap between a thing and a bit."""


def after(cut: Cut, network: dict[str, NDArray[np.float32]]) -> list[int]:
    """The cluster of each of the patches, in the end."""
    surface, own, told = cut
    labels = joined_by_carrying(surface, (own, told), NONE, network, CarrySettings())
    low = surface.cloud.points[:, 2] < 0.65
    return [int(np.bincount(labels[(own == k) & (low | (k != -1))] + 1).argmax()) - 1 for k in (0, 1, 2, -1, 3)]


def test_bits_that_surely_carry_join_their_thing() -> None:
    near = weights(GAP, -20.0, 5.0)
    assert after(scene(), near)[:4] == [0, 1, 1, 1]


def test_what_the_network_doubts_stays_as_it_was() -> None:
    assert after(scene(), weights(GAP, 0.0, -1.0)) == [0, 1, 2, -1, 3]


def test_a_thing_of_less_than_20_cm_has_no_bits() -> None:
    surface, own, told = scene()
    c = clusters_of(surface, own, told, ("table", "mug"), NONE)
    listed = (c.whole > 0.6) & (c.structure <= 0.5)
    assert set(carry_pairs(surface, c, listed).thing.tolist()) == {1}


@pytest.mark.parametrize("turn", [0.4, 2.0])
def test_what_is_seen_of_a_pair_does_not_depend_on_where_things_face(turn: float) -> None:
    tables = []
    for angle in (0.0, turn):
        surface, own, told = scene(angle)
        c = clusters_of(surface, own, told, ("table", "mug"), NONE)
        pairs = carry_pairs(surface, c, (c.whole > 0.6) & (c.structure <= 0.5))
        tables.append({int(b): x for b, x in zip(pairs.bit.tolist(), pairs.x, strict=True)})
    same = [np.abs(tables[0][k] - tables[1][k]) for k in (2, 4)]
    assert max(np.quantile(d, 0.9) for d in same) < 0.2
