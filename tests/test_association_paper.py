"""Numbers of the paper, worked out by hand: s_sem, s_loop and its threshold, delta(o), the support and its confidence,
coverage sampling, the weights of edges, and where their graph begins."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.association.graph.pose_graph import chain_poses
from list3r.association.overlap.alignment import AlignmentSettings, align
from list3r.association.overlap.inconsistency import displacement, inconsistency
from list3r.association.overlap.regions import EdgeSupportSettings, Regions, confident
from list3r.association.overlap.shared_points import Pairs
from list3r.association.paper.support import coverage_turn
from list3r.association.paper.weights import paper_weights
from list3r.association.revisits.instance_similarity import (
    InstanceSet,
    InstanceSimilarity,
    compare_instances,
    loop_score,
)
from list3r.frames.base import Camera
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge
from list3r.memory.core.settings import as_plain, from_plain
from list3r.pipeline.settings import ASSOCIATIONS, AssociationSettings


def test_s_loop_weighs_frames_against_instances() -> None:
    cues = InstanceSimilarity(s_sem=0.9, s_rel=0.6, pairs=((1, 1),), log_scale=0.0)
    settings = AssociationSettings.by_method("paper").revisits
    assert (settings.lambda_, settings.rule) == (0.5, "score")
    assert loop_score(0.8, cues, settings.lambda_) == pytest.approx(1.15)  # 0.5 * 0.8 + 0.5 * (0.9 + 0.6)
    assert loop_score(0.8, cues, 1.0) == pytest.approx(0.8)
    assert loop_score(0.8, cues, 0.0) == pytest.approx(1.5)
    # frames that are the same and no instance that matches stay below the threshold
    assert loop_score(1.0, InstanceSimilarity(0.0, 0.0, (), float("nan")), 0.5) < settings.least_score
    assert loop_score(0.95, InstanceSimilarity(0.9, 0.9, (), 0.0), 0.5) > settings.least_score


def test_the_methods_of_association_are_stored_with_a_session() -> None:
    for method in ASSOCIATIONS:
        settings = AssociationSettings.by_method(method)
        assert from_plain(AssociationSettings, as_plain(settings)) == settings
    with pytest.raises(OptionError, match="--association slam: choose from list3r, paper, frames"):
        AssociationSettings.by_method("slam")


def test_s_sem_is_the_mean_cosine_of_mutual_nearest_neighbours() -> None:
    # v has the looks of u's first two instances, turned by 0.2 and 0.4 rad; u's third finds no mutual neighbour
    looks_u = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    looks_v = np.array([[np.cos(0.2), 0, np.sin(0.2)], [0, np.cos(0.4), np.sin(0.4)]])
    cues = compare_instances(_set(looks_u), _set(looks_v))
    assert cues.s_sem == pytest.approx((np.cos(0.2) + np.cos(0.4)) / 2)
    assert cues.s_rel == 0.0  # two pairs tell nothing of a layout


def _set(looks: np.ndarray) -> InstanceSet:
    n = len(looks)
    centers = np.arange(3.0 * n).reshape(n, 3)
    return InstanceSet(np.arange(n), looks, centers, np.full(n, 0.3), np.array([0.0, 0.0, 1.0]), "looks@1/3")


def test_weights_of_edges_are_the_papers() -> None:
    # m = 1: log(1.3) = 0.262364, u = 0.207836, u^6 = 8.0598e-5, (1 - u)^6 = 0.247110, weight 3.2606e-4
    # m = 0.25: log(1.075) = 0.072321, u = 0.067443, u^6 = 9.4110e-8, (1 - u)^6 = 0.657642, weight 1.4310e-7
    weights = paper_weights(np.array([1.0, 0.25]))
    assert weights[0] == 1.0
    assert weights[1] == pytest.approx(1.4310e-7 / 3.2606e-4, rel=1e-3)
    assert 1 / weights[1] == pytest.approx(2278, rel=2e-3)


def _pairs(p_u: np.ndarray, p_v: np.ndarray, confidence_u: np.ndarray | None = None) -> Pairs:
    """Pairs of one frame, whose camera stands at the origin of both chunks."""
    n = len(p_u)
    here, one = np.tile(np.eye(4)[:3], (n, 1, 1)), np.ones(n)
    zero = np.zeros(n, np.int64)
    known = one if confidence_u is None else confidence_u
    return Pairs(p_u, p_v, known, one, zero, zero, zero, zero, here, here, p_v)


def test_delta_is_the_mean_distance_in_pixels_between_projected_and_observed() -> None:
    # f = 100 px. Moved by 0.02 along x, a point 2 away lands 1 px off and one 4 away 0.5 px: delta = 0.75.
    # The other region lies 1 away and moves by 2 px; across depth alone nothing is seen.
    p = np.array([[0.1, 0.0, 2.0], [0.0, 0.2, 4.0], [0.3, 0.1, 1.0]])
    pairs, camera = _pairs(p, p), Camera(100, 80, 100.0, 100.0, 50.0, 40.0)
    none, settings = np.zeros(3, bool), EdgeSupportSettings()
    S = Sim3(1.0, np.eye(3), np.array([0.02, 0.0, 0.0]))
    off = displacement(pairs, S, camera, ~none, none)
    assert off.delta_px == pytest.approx([1.0, 0.5, 2.0])
    regions = Regions(np.array([7, 8]), np.array([0, 0, 1]), np.array([2, 1]))
    assert inconsistency(off, regions, pairs.frame, camera, settings).delta_px == pytest.approx([0.75, 2.0])
    away = displacement(_pairs(1.5 * p, p), Sim3.identity(), camera, ~none, none)
    assert away.delta_px == pytest.approx([0.0, 0.0, 0.0])


def test_confident_pairs_are_above_a_tenth_of_the_lower_median() -> None:
    # medians 0.5 and 1: the limit is 0.05 on either side
    p = np.ones((5, 3))
    pairs = _pairs(p, p, np.array([0.9, 0.5, 0.04, 0.06, 0.5]))
    assert EdgeSupportSettings().confidence_share == 0.1
    assert confident(pairs, EdgeSupportSettings()).tolist() == [True, True, False, True, True]


def test_the_confidence_of_an_alignment_is_the_papers_m() -> None:
    # eight corners of a cube fit exactly with weight 1; two pairs at its middle are off by sigma_r either way, which
    # leaves the fit as it is: m = (8 + 2 w / e) / (8 + 2 w), with w = 0.5 (8 + 0.367879) / 9 = 0.929764
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    p_u = np.tile(np.concatenate([corners, np.zeros((2, 3))]), (10, 1))
    settings, group, weight = AlignmentSettings(), np.zeros(100, int), np.tile(np.r_[np.ones(8), 0.5, 0.5], 10)
    spread = align(p_u, p_u, weight, group, True).spread
    p_v = p_u.copy()
    p_v[8::10, 0] = settings.residual_scale * spread
    p_v[9::10, 0] = -settings.residual_scale * spread
    found = align(p_u, p_v, weight, group, True, settings)
    assert found.spread == pytest.approx(spread)
    assert found.confidence == pytest.approx(0.929764, abs=1e-4)


def test_coverage_sampling_takes_the_surest_of_each_cell_in_turn() -> None:
    # one cell a metre: three points of the first lie before one of the second and one of the third in confidence
    x = np.array([0.0, 0.2, 0.4, 1.2, 2.0])
    points, weight = np.stack([x, 0 * x, 0 * x], axis=1), np.array([0.7, 0.9, 0.8, 0.1, 0.2])
    low, high = np.quantile(x, [0.05, 0.95])
    rank = coverage_turn(points, np.zeros(len(points), np.int64), weight, 1)
    assert high - low == pytest.approx(1.8)  # the cell: 0 to 1.8 holds four points, 2.0 lies alone
    assert rank.tolist() == [2, 0, 1, 3, 0]


def test_the_graph_begins_where_adjacent_relations_chain() -> None:
    # G_1 = I and G_{k+1} = G_k T_{k,k+1}^-1: with T = 2 x + (1, 0, 0), x = 1 of the second chunk is 0 of the first
    S = Sim3(2.0, np.eye(3), np.array([1.0, 0.0, 0.0]))
    edges = [Edge(k, k + 1, "adjacent", S, 1.0, 1.0, 9, 0.0, True, "", {}) for k in (1, 2)]
    poses, _ = chain_poses([1, 2, 3], edges)
    at = np.array([[1.0, 0.0, 0.0]])
    assert np.allclose(poses[1].apply(at), at)
    assert np.allclose(poses[2].apply(at), 0.0)
    assert np.allclose(poses[3].apply(at), [[-0.5, 0.0, 0.0]])
