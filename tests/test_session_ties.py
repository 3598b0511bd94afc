"""When one video is placed in the world of another: laws on small graphs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.association.revisits.further_pairs import FurtherPairSettings, similar_views
from list3r.association.revisits.session_edges import defer_session_edges
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkRow, Edge, FrameSamples
from list3r.memory.library.world.session_ties import SessionTies, counted_once

CHUNKS = {1: 1, 2: 1, 3: 2, 4: 2, 5: 3, 6: 3}
"""Session of each chunk; chunk k stands at x = k metres."""


def _edge(u: int, v: int, kind: str = "loop", off_m: float = 0.0, features: float = 20.0) -> Edge:
    S_v_u = Sim3(1.0, np.eye(3), np.array([u - v + off_m, 0.0, 0.0]))
    scores = {"feature_inliers": features, "overlap": 0.8, "agreement": 1.0}
    return Edge(u, v, kind, S_v_u, 0.8, 0.8, 100, 0.01, True, "measured", scores)


def _accepted(edges: list[Edge], sessions: dict[int, int] | None = None) -> list[bool]:
    return [e.accepted for e in defer_session_edges(edges, sessions or CHUNKS)]


INSIDE = [_edge(1, 2, "adjacent"), _edge(3, 4, "adjacent"), _edge(5, 6, "adjacent")]


def test_one_weak_relation_does_not_place_a_session() -> None:
    out = defer_session_edges([*INSIDE, _edge(1, 3)], CHUNKS)
    assert [e.accepted for e in out] == [True, True, True, False]
    assert "deferred" in out[3].reason


def test_two_that_agree_do_and_release_what_was_held() -> None:
    held = defer_session_edges([*INSIDE, _edge(1, 3)], CHUNKS)[3]
    out = defer_session_edges([*INSIDE, held, _edge(2, 4)], CHUNKS)
    assert all(e.accepted for e in out)
    assert out[3].reason == "measured"


@pytest.mark.parametrize(("frames", "placed"), [((30, 45), True), ((22, 9), True), ((12, 13), False), ((30, 6), False)])
def test_two_of_the_same_chunks_count_when_their_frames_lie_apart(frames: tuple[int, int], placed: bool) -> None:
    one, two = replace(_edge(1, 3), frames=(2, 5)), replace(_edge(1, 3, off_m=0.05), frames=frames)
    assert _accepted([*INSIDE, one, two])[3:] == [placed, placed]
    assert _accepted([*INSIDE, one, replace(two, S_v_u=_edge(1, 3, off_m=2.0).S_v_u)])[3:] == [False, False]


def test_one_by_frames_and_one_by_things_place_a_session_though_of_the_same_chunks() -> None:
    frames, things = (replace(_edge(1, 3, off_m=x), frames=(2, 5)) for x in (0.0, 0.05))
    things = replace(things, scores={"things_pairs": 10.0})
    assert _accepted([*INSIDE, frames, things])[3:] == [True, True]
    assert _accepted([*INSIDE, things, replace(things, frames=(3, 6))])[3:] == [False, False]
    assert _accepted([*INSIDE, frames, replace(things, S_v_u=_edge(1, 3, off_m=2.0).S_v_u)])[3:] == [False, False]


def test_a_relation_says_which_other_keyframes_see_the_same() -> None:
    """Cameras that turn on the spot, two chunks in gauges of their own; a frame of v looks where that of u does."""
    frames = np.arange(0, 60, 5)
    T = np.tile(np.eye(4), (len(frames), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("y", 6.0 * frames[:, None], degrees=True).as_matrix()
    S = Sim3(2.0, Rotation.from_euler("x", 40, degrees=True).as_matrix(), np.array([1.0, -2.0, 0.5]))
    moved = T.copy()
    moved[:, :3, :3], moved[:, :3, 3] = S.rotation @ T[:, :3, :3], S.apply(T[:, :3, 3])
    empty = FrameSamples.empty()
    u, v = (replace(empty, camera_frames=frames, T_chunk_cam=poses) for poses in (T, moved))
    edge = replace(_edge(1, 3), S_v_u=S, frames=(10, 10))
    found = similar_views(edge, (u, v), (frames.tolist(), frames.tolist()), FurtherPairSettings(most=8))
    assert len(found) == 8 and {a - b for a, b in found} == {0}
    assert min(abs(a - 10) for a, _ in found) == 10  # 10 on either side, 20 on both
    near = FurtherPairSettings(most=99, turn_deg=31.0)
    apart = similar_views(edge, (u, v), (frames.tolist(), frames.tolist()), near)
    assert {abs(a - b) for a, b in apart} == {0, 5, 55}


def test_two_that_disagree_do_not() -> None:
    assert _accepted([*INSIDE, _edge(1, 3), _edge(2, 4, off_m=3.0)]) == [True] * 3 + [False] * 2


def test_one_beyond_doubt_is_enough() -> None:
    assert _accepted([*INSIDE, _edge(1, 3, features=150.0)]) == [True] * 4


def test_a_third_session_connects_a_second_that_could_not_be_placed() -> None:
    """The third lies surely in both worlds, so the first relation between them is believed too."""
    edges = [*INSIDE, _edge(1, 3), _edge(2, 5, features=90.0), _edge(4, 6, features=90.0)]
    assert _accepted(edges) == [True] * 6


def test_pairs_given_the_other_way_round_agree_too() -> None:
    backwards = _edge(4, 2)
    assert _accepted([*INSIDE, _edge(1, 3), backwards]) == [True] * 5


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (4, 3, 2, 1, 0), (3, 0, 4, 1, 2)])
def test_the_order_of_edges_does_not_matter(order: tuple[int, ...]) -> None:
    edges = [*INSIDE, _edge(1, 3), _edge(2, 4, off_m=3.0)]
    out = _accepted([edges[k] for k in order])
    assert [out[order.index(k)] for k in range(5)] == [True, True, True, False, False]


def test_a_memory_of_one_session_is_left_as_it_is() -> None:
    edges = [_edge(1, 2), _edge(3, 4)]
    assert defer_session_edges(edges, dict.fromkeys(CHUNKS, 1)) == edges


def test_one_that_the_depth_contradicts_is_not_beyond_doubt() -> None:
    edge = _edge(1, 3, features=150.0)
    for name in ("overlap", "agreement"):
        assert _accepted([*INSIDE, replace(edge, scores={**edge.scores, name: 0.3})]) == [True] * 3 + [False]


def test_two_that_share_a_keyframe_count_as_one() -> None:
    """What misled one, a thing that was moved, misleads the other."""
    one = replace(_edge(1, 3), frames=(2, 50))
    two, three = (replace(_edge(2, 3), frames=(30, n)) for n in (50, 80))
    assert _accepted([*INSIDE, one, two])[3:] == [False, False]
    assert _accepted([*INSIDE, one, three])[3:] == [True, True]


def _measured(edge: Edge, sigma_m: tuple[float, float, float], frames: tuple[int, int]) -> Edge:
    covariance = np.diag(np.square([*sigma_m, 1e-4, 1e-4, 1e-4, 0.0]))
    return replace(edge, covariance=covariance, frames=frames)


def _rows() -> dict[int, ChunkRow]:
    S = {k: Sim3(1.0, np.eye(3), np.array([float(k), 0.0, 0.0])) for k in CHUNKS}
    place = (1.0, 1.0, 0.0, 0.0)
    return {k: ChunkRow(k, s, k, 0, 9, 1, S[k], place, (240, 320), "metric") for k, s in CHUNKS.items()}


@pytest.mark.parametrize("often", [2, 3, 5])
def test_relations_that_share_a_keyframe_tell_as_much_as_one(often: int) -> None:
    at = np.array([1.0, 0.5, 0.0])
    shared = [_measured(_edge(1, 3), (0.02, 0.02, 0.02), (10 * k, 7)) for k in range(often)]
    apart = [_measured(_edge(1, 3), (0.02, 0.02, 0.02), (10 * k, 10 * k)) for k in range(often)]
    own = [_measured(_edge(1, 2), (0.02, 0.02, 0.02), (10 * k, 7)) for k in range(often)]
    one, same, many = (SessionTies(e, _rows()).covariance(2, at) for e in (shared[:1], shared, apart))
    assert np.allclose(same, one, rtol=1e-6)
    assert np.allclose(many, one / often, rtol=1e-6)
    assert counted_once(own, CHUNKS) == own  # a video's own loops are held by the chain
    assert not SessionTies(own, _rows()).covariance(2, at).any()


def test_a_place_is_known_as_little_as_the_bare_wall_tells() -> None:
    """Along the wall, x, a relation tells nothing; a second one from elsewhere may tell it."""
    wall, corner = (
        _measured(_edge(1, 3), s, f) for s, f in (((0.5, 0.01, 0.01), (0, 0)), ((0.01, 0.01, 0.01), (40, 40)))
    )
    at = np.array([1.0, 0.0, 0.0])
    alone, both = (np.sqrt(np.diag(SessionTies(e, _rows()).covariance(2, at))) for e in ([wall], [wall, corner]))
    assert np.allclose(alone, [0.5, 0.01, 0.01], rtol=0.02)
    assert np.allclose(both, [0.01, 0.0071, 0.0071], rtol=0.02)
    shifts = SessionTies([wall], _rows()).shifts(2, at, 2.0, 0.025)
    assert sorted(np.round(s[0], 2) for s in shifts) == [-0.98, 0.98]
    far = np.sqrt(np.diag(SessionTies([corner], _rows()).covariance(2, at + np.array([0.0, 300.0, 0.0]))))
    assert far[0] > 0.03  # a turn moves what is far
