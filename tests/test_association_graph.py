"""The graph of chunks: loops close it, false loops do not bend it, and the order of arrival does not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from list3r.association.graph.edge_information import WeightSettings, information_of
from list3r.association.graph.pose_graph import contradicted, optimize
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge


def circle(count: int) -> list[Sim3]:
    """Chunks round a circle of 3 m, the first at the origin."""
    angle = 2 * np.pi * np.arange(count) / count
    poses = [
        Sim3(np.ones(()), Sim3.exp([0, 0, 0, 0, a, 0, 0]).rotation, np.array([3 * np.sin(a), 0.0, 3 * np.cos(a)]))
        for a in angle
    ]
    return [poses[0].inverse() @ p for p in poses]


def edge(
    truth: list[Sim3], u: int, v: int, kind: str, noise: np.ndarray | None = None, confidence: float = 0.9
) -> Edge:
    S_v_u = truth[v].inverse() @ truth[u]
    if noise is not None:
        S_v_u = S_v_u @ Sim3.exp(noise)
    return Edge(u, v, kind, S_v_u, confidence, confidence, 100, 0.01, True, "measured", {"spread": 3.0})


def drifting(truth: list[Sim3], scale: float = 0.0) -> list[Edge]:
    """Adjacent edges with a bias that adds up, the same for all."""
    bias = np.array([0.01, 0.005, -0.01, 0.004, -0.006, 0.003, scale])
    return [edge(truth, k, k + 1, "adjacent", bias) for k in range(len(truth) - 1)]


def errors(placed: dict[int, Sim3], truth: list[Sim3]) -> np.ndarray:
    return np.array([np.linalg.norm(placed[k].translation - t.translation) for k, t in enumerate(truth)])


def test_exact_edges_give_the_exact_map() -> None:
    truth = circle(12)
    edges = [edge(truth, k, k + 1, "adjacent") for k in range(11)] + [edge(truth, 0, 11, "loop")]
    result = optimize(range(12), edges, {}, metric=True)
    assert errors(result.S_graph_chunk, truth).max() < 1e-6
    assert set(result.components.values()) == {0}
    assert result.residual < 1e-6


@pytest.mark.parametrize(("metric", "scale"), [(True, 0.0), (False, 0.01)])
def test_a_loop_takes_out_drift(metric: bool, scale: float) -> None:
    truth = circle(20)
    chain = drifting(truth, scale)
    loops = [edge(truth, 0, 19, "loop"), edge(truth, 2, 15, "loop")]
    before = errors(optimize(range(20), chain, {}, metric).S_graph_chunk, truth)
    result = optimize(range(20), chain + loops, {}, metric)
    after = errors(result.S_graph_chunk, truth)
    assert after.mean() < 0.5 * before.mean()
    assert all(e.accepted for e in result.edges)
    if metric:
        assert all(float(S.scale) == 1.0 for S in result.S_graph_chunk.values())


def test_false_loops_are_switched_off() -> None:
    truth = circle(20)
    good = [edge(truth, 0, 19, "loop"), edge(truth, 2, 15, "loop"), edge(truth, 4, 17, "loop")]
    false = [
        replace(edge(truth, 1, 10, "loop"), S_v_u=Sim3.identity()),
        replace(edge(truth, 5, 14, "loop"), S_v_u=Sim3.exp([0.3, 0, 0.2, 0, 0.2, 0, 0])),
    ]
    clean = optimize(range(20), drifting(truth) + good, {}, metric=True)
    result = optimize(range(20), drifting(truth) + good + false, {}, metric=True)
    assert [e.accepted for e in result.edges[-5:]] == [True, True, True, False, False]
    assert "contradicts" in result.edges[-1].reason
    assert result.edges[-1].weight == 0.0
    difference = errors(result.S_graph_chunk, [clean.S_graph_chunk[k] for k in range(20)])
    assert difference.max() < 0.02


def test_a_loop_that_is_believed_again_says_what_geometry_said_of_it() -> None:
    truth = circle(20)
    loops = [replace(edge(truth, k, 19 - k, "loop"), reason=f"loop {k} agrees") for k in range(3)]
    doubted = [replace(e, reason=contradicted(e, 5.0), accepted=False, scores=e.scores | {"trust": 0.0}) for e in loops]
    result = optimize(range(20), drifting(truth) + doubted, {}, metric=True)
    assert [(e.accepted, e.reason) for e in result.edges[-3:]] == [(True, f"loop {k} agrees") for k in range(3)]


def test_a_rejected_loop_is_tried_again_and_geometry_has_the_last_word() -> None:
    truth = circle(20)
    chain, loop = drifting(truth), edge(truth, 0, 19, "loop")
    rejected = replace(loop, accepted=False, weight=0.0, scores={"trust": 0.0})
    again = optimize(range(20), [*chain, rejected], {}, metric=True)
    assert again.edges[-1].accepted
    never = replace(loop, accepted=False, S_v_u=Sim3.identity())
    result = optimize(range(20), [*chain, never], {}, metric=True)
    assert result.edges[-1] == never
    assert np.allclose(
        errors(result.S_graph_chunk, truth), errors(optimize(range(20), chain, {}, True).S_graph_chunk, truth)
    )


def test_the_order_of_edges_and_earlier_results_do_not_matter() -> None:
    truth = circle(12)
    edges = [*drifting(truth), edge(truth, 0, 11, "loop"), edge(truth, 1, 8, "loop")]
    once = optimize(range(12), edges, {}, metric=True)
    order = np.random.default_rng(0).permutation(len(edges))
    twice = optimize(list(range(12))[::-1], [once.edges[k] for k in order], once.S_graph_chunk, metric=True)
    for k in range(12):
        assert np.allclose(once.S_graph_chunk[k].as_matrix(), twice.S_graph_chunk[k].as_matrix(), atol=1e-6)


def test_what_is_not_connected_is_apart() -> None:
    truth = circle(6)
    edges = [edge(truth, 0, 1, "adjacent"), edge(truth, 3, 4, "adjacent"), edge(truth, 4, 5, "adjacent")]
    start = {0: Sim3.exp([1, 2, 3, 0, 0, 0.5, 0])}
    result = optimize(range(6), edges, start, metric=True)
    assert result.components == {0: 0, 1: 0, 2: 2, 3: 3, 4: 3, 5: 3}
    assert np.allclose(result.S_graph_chunk[0].as_matrix(), start[0].as_matrix())
    assert np.allclose(result.S_graph_chunk[3].as_matrix(), np.eye(4))
    assert optimize([7], [], {}, metric=True).components == {7: 7}


def test_loops_alone_can_join_what_chains_do_not() -> None:
    truth = circle(4)
    edges = [edge(truth, 0, 1, "adjacent"), edge(truth, 2, 3, "adjacent"), edge(truth, 0, 3, "loop")]
    result = optimize(range(4), edges, {}, metric=True)
    assert set(result.components.values()) == {0}
    assert errors(result.S_graph_chunk, truth).max() < 1e-6


def test_a_thousand_chunks() -> None:
    truth = circle(1000)
    loops = [edge(truth, k, (k + 400) % 1000, "loop") for k in range(0, 600, 3)]
    result = optimize(range(1000), [edge(truth, k, k + 1, "adjacent") for k in range(999)] + loops, {}, metric=True)
    assert errors(result.S_graph_chunk, truth).max() < 1e-3


def test_edges_of_known_scale_hold_it_beside_edges_of_computed_depth() -> None:
    truth = circle(2)
    known = np.diag([1e-4, 2e-4, 1e-4, 1e-4, 1e-4, 2e-4, 0.0])
    free = known + np.diag([0, 0, 0, 0, 0, 0, 1e-4])
    edges = [replace(edge(truth, 0, 1, "loop"), covariance=c) for c in (known, free)]
    stiff = replace(WeightSettings(), bending=0.0)
    sure, unsure = information_of(edges, False, stiff)[:, 6, 6]
    assert np.isfinite(sure) and sure > 1e3 * unsure
