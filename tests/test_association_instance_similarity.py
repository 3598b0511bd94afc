"""Instances speak for or against a revisit; joint windows are tested against what else was seen; the way is a gate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from list3r.association.revisits.chain import ChainSettings, EdgeChains
from list3r.association.revisits.cross_check import Side, cross_check, shared_view
from list3r.association.revisits.instance_similarity import (
    InstanceSet,
    SimilaritySettings,
    compare_instances,
    instance_set,
    loop_score,
)
from list3r.association.revisits.joint_window import Place, composed_covariance, joint_edge
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples, JointWindow
from tests.association_scenes import CAMERA, film

GAUGE_U = Sim3.exp([0.5, -0.2, 1.0, 0.3, -0.5, 0.2, 0.4])
GAUGE_V = Sim3.exp([-1.0, 0.4, 0.2, -0.2, 0.9, 0.1, -0.3])
GAUGE_W = Sim3.exp([0.2, 0.1, -0.4, 0.8, 0.2, -0.3, 0.2])
S_V_U = GAUGE_V @ GAUGE_U.inverse()
NOWHERE = InstanceSet(np.zeros(0, np.int64), np.zeros((0, 0)), np.zeros((0, 3)), np.zeros(0), np.zeros(3), "test@1/8")


def instances(count: int, seed: int, S: Sim3 | None = None, noise: float = 0.02, kinds: int = 99) -> InstanceSet:
    """Things on the floor of a room, in a gauge; things of one kind look alike but for noise."""
    rng = np.random.default_rng(seed)
    center = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(0, 0.8, count)])
    looks = np.random.default_rng(7).normal(size=(count, 8))[np.arange(count) % kinds]
    own = np.random.default_rng([seed, 3])
    feature = looks + 0.1 * own.normal(size=looks.shape)
    gauge = S or Sim3.identity()
    return InstanceSet(
        local_id=np.arange(count),
        feature=feature / np.linalg.norm(feature, axis=1, keepdims=True),
        center=gauge.apply(center + noise * own.normal(size=center.shape)),
        size=np.full(count, 0.4 * float(gauge.scale)),
        up=gauge.rotation @ np.array([0.0, 0.0, 1.0]),
        space="test@1/8",
    )


@pytest.mark.parametrize("seed", range(5))
def test_one_layout_in_two_gauges_is_recognised_with_its_scale(seed: int) -> None:
    u = instances(9, seed)
    v = replace(instances(9, seed, GAUGE_V), local_id=np.arange(9) + 20)
    cues = compare_instances(u, v)
    assert cues.s_sem > 0.9
    assert cues.s_rel > 0.7
    assert all(j == i + 20 for i, j in cues.pairs)
    assert cues.log_scale == pytest.approx(np.log(float(GAUGE_V.scale)), abs=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_the_same_kinds_of_things_elsewhere_are_vetoed_by_the_layout(seed: int) -> None:
    here, same, other = instances(9, seed), instances(9, seed, GAUGE_V), instances(9, seed + 50, GAUGE_V)
    right, wrong = compare_instances(here, same), compare_instances(here, other)
    assert wrong.s_sem > 0.9
    assert wrong.s_rel < 0.7 * right.s_rel
    assert loop_score(0.6, wrong, 0.5) < loop_score(0.6, right, 0.5)


def test_look_alikes_are_sorted_out_by_the_layout() -> None:
    u, v = instances(10, 1, kinds=5), instances(10, 1, GAUGE_V, kinds=5)
    shuffled = replace(v, feature=v.feature[(np.arange(10) + 5) % 10])
    cues = compare_instances(u, shuffled)
    assert cues.s_rel > 0.7
    assert sum(i == j for i, j in cues.pairs) >= 7


def test_a_mirrored_layout_is_no_revisit() -> None:
    u = instances(9, 2)
    mirrored = replace(u, center=u.center * np.array([1.0, -1.0, 1.0]))
    assert compare_instances(u, mirrored).s_rel == 0.0


def test_few_or_strange_instances_give_no_layout() -> None:
    u = instances(9, 0)
    for few in (NOWHERE, instances(1, 0), instances(2, 0)):
        assert compare_instances(few, u).s_rel == 0.0
        assert compare_instances(u, few).s_rel == 0.0
    assert compare_instances(u, NOWHERE).s_sem == 0.0
    assert compare_instances(u, replace(u, space="other@1/8")).s_sem == 0.0
    assert instance_set([], np.zeros((0, 4, 4)), "test@1/8", SimilaritySettings()).local_id.shape == (0,)
    heaped = replace(u, center=np.zeros_like(u.center))
    assert compare_instances(heaped, u).s_rel == 0.0


def side(samples: FrameSamples) -> Side:
    return Side(samples, CAMERA, NOWHERE)


def test_a_true_relation_stands_and_false_ones_are_contradicted() -> None:
    u, v = side(film(S_chunk_world=GAUGE_U)), side(film(S_chunk_world=GAUGE_V, first=30))
    true = cross_check(S_V_U, u, v)
    assert true.agreement > 0.95
    assert true.overlap > 0.4
    for tangent in ([0.0, 0, 1.2, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0.4], [0, 0, 0, 0, 0.6, 0, 0]):
        wrong = cross_check(GAUGE_V @ Sim3.exp(tangent) @ GAUGE_U.inverse(), u, v)
        assert wrong.agreement < true.agreement - 0.1 or wrong.overlap < 0.5 * true.overlap
    nothing = cross_check(S_V_U, side(FrameSamples.empty()), v)
    assert nothing.overlap == 0.0


def test_frames_share_a_view_only_from_the_same_side() -> None:
    u, v = film(S_chunk_world=GAUGE_U), film(S_chunk_world=GAUGE_V, first=30)
    frames = u.camera_frames, v.camera_frames
    assert shared_view(S_V_U, side(u), side(v), frames) > 0.5
    behind = Sim3.exp([0.0, 0, 0, 0, np.pi, 0, 0])
    facing = Sim3(np.ones(()), behind.rotation, np.array([0.0, 0.0, 8.0]))
    assert shared_view(GAUGE_V @ facing @ GAUGE_U.inverse(), side(u), side(v), frames) < 0.1
    assert shared_view(S_V_U, side(FrameSamples.empty()), side(v), (u.frame[:0], v.camera_frames)) == 0.0


class Model:
    """Frames of the simulated walk together; `off` is what it gets wrong between the two places."""

    def __init__(self, off: Sim3 | None = None) -> None:
        self.off = off or Sim3.identity()

    def __call__(
        self, u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]
    ) -> JointWindow | None:
        u = film(S_chunk_world=GAUGE_W, first=u_frames[0], frames=len(u_frames), noise=0.004, seed=1)
        v = film(S_chunk_world=GAUGE_W @ self.off, first=v_frames[0], frames=len(v_frames), noise=0.004, seed=2)
        return JointWindow(u, v, "relative")


def places() -> tuple[Place, Place]:
    u = film(S_chunk_world=GAUGE_U, noise=0.004, seed=3, frames=40)
    v = film(S_chunk_world=GAUGE_V, noise=0.004, seed=4, first=50, frames=40)
    return Place(0, 0, 15, False, side(u)), Place(5, 0, 70, False, side(v))


def no_objection(S_v_u: Sim3) -> str | None:
    return None


def test_a_joint_window_gives_the_relation_and_how_sure_it_is() -> None:
    u, v = places()
    edge = joint_edge(Model(), u, v, no_objection)
    assert edge.accepted, edge.reason
    assert (edge.u, edge.v, edge.frames) == (0, 5, (15, 70))
    off = (S_V_U.inverse() @ edge.S_v_u).log()
    assert np.abs(off).max() < 0.03
    assert edge.covariance is not None
    assert off @ np.linalg.solve(edge.covariance, off) < 40
    assert {"shared_view", "overlap", "agreement", "spread"} <= set(edge.scores)


def test_an_invented_relation_is_rejected_with_the_reason_but_not_by_the_baseline() -> None:
    u, v = places()
    invented = Model(Sim3.exp([0.0, 0.0, 1.2, 0.0, 0.0, 0.0, 0.0]))
    edge = joint_edge(invented, u, v, no_objection)
    assert not edge.accepted
    assert edge.reason
    assert edge.weight == 0.0
    assert joint_edge(invented, u, v).accepted
    assert joint_edge(Model(), u, v, lambda S: "the way says no").reason == "the way says no"


def test_windows_that_cannot_be_made_or_fit_nothing_are_rejected() -> None:
    u, v = places()
    assert not joint_edge(lambda *_: None, u, v, no_objection).accepted
    empty = JointWindow(FrameSamples.empty(), FrameSamples.empty(), "relative")
    assert not joint_edge(lambda *_: empty, u, v, no_objection).accepted
    assert not joint_edge(lambda *_: empty, u, v).accepted
    hollow = replace(u, side=side(FrameSamples.empty()))
    assert not joint_edge(lambda *_: empty, hollow, v, no_objection).accepted


def edge_between(u: int, v: int, S: Sim3, sigma: float = 0.01) -> Edge:
    covariance = sigma**2 * np.eye(7)
    scores = {"spread": 4.0}
    return Edge(u, v, "adjacent", S, 0.9, 0.9, 100, 0.01, True, "", scores, covariance=covariance)


def test_the_way_predicts_a_relation_and_refuses_what_lies_far_from_it() -> None:
    rng = np.random.default_rng(0)
    gauges = [Sim3.exp(rng.normal(size=7) * 0.5) for _ in range(5)]
    edges = [edge_between(k, k + 1, gauges[k + 1].inverse() @ gauges[k]) for k in range(4)]
    edges[2] = edge_between(3, 2, gauges[2].inverse() @ gauges[3])
    way = EdgeChains(edges, ChainSettings()).predict(0, 4)
    assert way is not None
    true = gauges[4].inverse() @ gauges[0]
    assert way.deviations(true) < 1e-6
    assert way.deviations(true @ Sim3.exp([0.1, 0, 0, 0, 0, 0, 0])) < ChainSettings().most_deviations
    assert way.deviations(true @ Sim3.exp([6.0, 0, 0, 0, 0, 0, 0])) > ChainSettings().most_deviations
    assert EdgeChains(edges[:2], ChainSettings()).predict(0, 4) is None
    assert EdgeChains([replace(e, accepted=False) for e in edges], ChainSettings()).predict(0, 4) is None


def test_covariances_compose_as_errors_do() -> None:
    rng = np.random.default_rng(1)
    first, second = (edge_between(k, k + 1, Sim3.exp(0.5 * rng.normal(size=7)), 1e-3) for k in range(2))
    truth = second.S_v_u @ first.S_v_u
    errors = []
    for _ in range(3000):
        a, b = (e.S_v_u @ Sim3.exp(1e-3 * rng.normal(size=7)) for e in (first, second))
        errors.append((truth.inverse() @ b @ a).log())
    composed = composed_covariance(first, second)
    assert composed is not None
    assert np.allclose(np.cov(np.array(errors).T), composed, rtol=0.15, atol=2e-7)
    assert composed_covariance(replace(first, covariance=None), second) is None


def test_the_uncertainty_of_a_way_is_that_of_its_errors() -> None:
    rng = np.random.default_rng(2)
    steps = [Sim3.exp(0.5 * rng.normal(size=7)) for _ in range(2)]
    edges = [edge_between(0, 1, steps[0], 1e-3), edge_between(2, 1, steps[1], 1e-3)]
    way = EdgeChains(edges, ChainSettings(shift=0.0, turn_deg=0.0, log_scale=0.0)).predict(0, 2)
    assert way is not None
    errors = []
    for _ in range(3000):
        a, b = (S @ Sim3.exp(1e-3 * rng.normal(size=7)) for S in steps)
        errors.append((way.S_v_u.inverse() @ b.inverse() @ a).log())
    assert np.allclose(np.cov(np.array(errors).T), way.covariance, rtol=0.15, atol=2e-7)


def test_each_instance_is_matched_once() -> None:
    """Two twins here, one of them there: only the one that looks more like it counts."""
    u, v = instances(2, 0), instances(1, 0)
    alike = replace(u, feature=np.array([[1.0, 0.0], [0.8, 0.6]]))
    cues = compare_instances(alike, replace(v, feature=np.array([[1.0, 0.0]])))
    assert cues.pairs == ((0, 0),) and cues.s_sem == pytest.approx(1.0)
