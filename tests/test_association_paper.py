"""Numbers of the paper, worked out by hand: s_sem, s_loop and its threshold, the weights of edges."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.association.graph.edge_information import WeightSettings, edge_weights
from list3r.association.revisits.cues import InstanceCues, InstanceSet, compare_instances, loop_score
from list3r.association.revisits.search import RevisitSettings


def test_s_loop_weighs_frames_against_instances() -> None:
    cues = InstanceCues(s_sem=0.9, s_rel=0.6, pairs=((1, 1),), log_scale=0.0)
    settings = RevisitSettings()
    assert (settings.lambda_, settings.least_score) == (0.5, 0.7)
    assert loop_score(0.8, cues, settings.lambda_) == pytest.approx(1.15)  # 0.5 * 0.8 + 0.5 * (0.9 + 0.6)
    assert loop_score(0.8, cues, 1.0) == pytest.approx(0.8)
    assert loop_score(0.8, cues, 0.0) == pytest.approx(1.5)
    # frames alike at 0.85 and no instance that matches stay below the threshold; two cues of 0.3 pass it
    assert loop_score(0.85, InstanceCues(0.0, 0.0, (), float("nan")), 0.5) < settings.least_score
    assert loop_score(0.85, InstanceCues(0.3, 0.3, (), 0.0), 0.5) > settings.least_score


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
    weights = edge_weights(np.array([1.0, 0.25]), WeightSettings())
    assert weights[0] == 1.0
    assert weights[1] == pytest.approx(1.4310e-7 / 3.2606e-4, rel=1e-3)
    assert 1 / weights[1] == pytest.approx(2278, rel=2e-3)
