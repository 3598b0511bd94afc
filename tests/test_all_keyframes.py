"""A session in a changed room: what was moved speaks for a wrong place, and the whole of both chunks for the right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.association.revisits.all_keyframes import (
    WITNESSED,
    contradicted,
    place_by_all_keyframes,
)
from list3r.association.revisits.chunk_agreement import (
    ChunkAgreementSettings,
    ChunkKeyframes,
    chunk_agreement,
)
from list3r.association.revisits.session_edges import defer_session_edges
from list3r.association.revisits.verification import VerificationSettings
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import Edge, Keyframe
from tests.session_scenes import FOCAL, Box, cast

GREY = (128, 128, 128)
WALLS: Mapping[str, Box] = {
    "floor": Box((0.0, 0.0, -0.05), (5.2, 4.2, 0.1), GREY),
    "east": Box((2.55, 0.0, 1.25), (0.1, 4.2, 2.5), GREY),
    "west": Box((-2.55, 0.0, 1.25), (0.1, 4.2, 2.5), GREY),
    "north": Box((0.0, 2.05, 1.25), (5.2, 0.1, 2.5), GREY),
    "south": Box((0.0, -2.05, 1.25), (5.2, 0.1, 2.5), GREY),
    "shelf": Box((-2.2, 0.9, 0.9), (0.6, 1.6, 1.8), GREY),
    "bench": Box((-0.6, -1.75, 0.3), (1.6, 0.5, 0.6), GREY),
}
MOVED = np.array([0.7, 0.0, 0.0])
VIEW = (FOCAL, FOCAL, 79.5, 59.5)
GAUGE = Sim3.exp([0.3, -0.2, 0.5, 0.2, 0.4, -0.1, 0.0]).as_matrix()


def _points(low: tuple[float, ...], high: tuple[float, ...], seed: int) -> tuple[Array, np.ndarray]:
    """Features on a face: where they are and their words."""
    rng = np.random.default_rng(seed)
    return rng.uniform(low, high, (60, 3)), rng.integers(0, 255, (60, 128)).astype(np.uint8)


STAYS = _points((2.5, -0.6, 0.6), (2.5, 0.8, 1.6), 1)
"""A picture on the east wall."""
CHEST = _points((-0.4, 1.2, 0.1), (0.6, 1.2, 1.3), 2)
"""The front of a chest that is moved."""


def _keyframes(later: bool, stays: bool, gauge: Array, seed: int) -> list[Keyframe]:
    """A chunk that turns on the spot, in a gauge of its own."""
    shift = MOVED if later else np.zeros(3)
    x, y, z = (np.array([0.1, 1.6, 0.7]) + shift).tolist()
    room = {**WALLS, "chest": Box((x, y, z), (1.2, 0.8, 1.4), GREY)}
    told = [(CHEST[0] + shift, CHEST[1]), *([STAYS] if stays else [])]
    points, words = np.concatenate([p for p, _ in told]), np.concatenate([w for _, w in told])
    rng, out = np.random.default_rng(seed), []
    for k in range(10):
        T = np.eye(4)
        level = Rotation.from_euler("x", -90, degrees=True)
        T[:3, :3] = (Rotation.from_euler("z", 36.0 * k + 5.0 * seed, degrees=True) * level).as_matrix()
        T[:3, 3] = [0.15 * seed, -0.4, 1.3]
        cam = (points - T[:3, 3]) @ T[:3, :3]
        xy = cam[:, :2] / np.maximum(cam[:, 2:], 0.1) * FOCAL + [79.5, 59.5]
        seen = (cam[:, 2] > 0.3) & (xy > 0).all(axis=1) & (xy < [160, 120]).all(axis=1)
        cam, xy = cam[seen] + rng.normal(0.0, 0.004, (int(seen.sum()), 3)), xy[seen].astype(np.float32)
        look, depth = np.ones(4, np.float32) / 2, cast(room, T)[0].astype(np.float32)
        out.append(Keyframe(12 * k, gauge @ T, look, xy, words[seen], cam.astype(np.float32), depth, VIEW))
    return out


FIRST = _keyframes(False, True, np.eye(4), 0)


def _placed(later: list[Keyframe]) -> list[Edge]:
    return place_by_all_keyframes((1, FIRST), (2, later), VerificationSettings())


def _off(S_v_u: Sim3) -> float:
    """By how much a relation to the second chunk moves the middle of the room, metres."""
    middle = np.array([[0.0, 0.0, 1.0]])
    return float(np.linalg.norm(S_v_u.apply(middle) - Sim3.from_matrix(GAUGE).apply(middle)))


@pytest.mark.slow
def test_what_stayed_places_a_session_though_a_large_thing_that_moved_says_otherwise() -> None:
    found = _placed(_keyframes(True, True, GAUGE, 1))
    assert found and all(e.accepted and _off(e.S_v_u) < 0.03 for e in found)
    assert defer_session_edges(found[:1], {1: 1, 2: 2})[0].accepted
    assert found[0].scores[WITNESSED] > 0.8


def test_what_moved_alone_places_nothing() -> None:
    assert _placed(_keyframes(True, False, GAUGE, 1)) == []
    assert _placed(_keyframes(False, False, GAUGE, 1))


@pytest.mark.parametrize(("shift", "wrong"), [(0.0, False), (0.7, True)])
def test_the_rest_of_both_chunks_contradicts_a_place_that_a_thing_says(shift: float, wrong: bool) -> None:
    later = _keyframes(True, True, GAUGE, 1)
    there = Sim3.from_matrix(GAUGE) @ Sim3(1.0, np.eye(3), shift * MOVED / 0.7)
    edge = Edge(1, 2, "loop", there, 1.0, 1.0, 0, 0.0, True, "measured", frames=(0, 0))
    assert contradicted(edge, FIRST, later) == wrong
    assert not contradicted(replace(edge, frames=None), FIRST, later)


def test_two_chunks_say_the_same_of_a_relation_and_of_its_inverse() -> None:
    u, v = (ChunkKeyframes(k, ChunkAgreementSettings()) for k in (FIRST, _keyframes(True, True, GAUGE, 1)))
    there, back = chunk_agreement(GAUGE, u, v, (0, 12)), chunk_agreement(np.linalg.inv(GAUGE), v, u, (12, 0))
    assert (there.seen, there.agreement) == pytest.approx((back.seen, back.agreement))
    assert there.seen > 0.3
