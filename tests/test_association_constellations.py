"""Registration of two chunks by their things alone: what a constellation determines, and when nothing is claimed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from list3r.association.revisits.constellations.chunk_registration import (
    ConstellationRegistrationSettings,
    log_odds,
    refusal,
)
from list3r.association.revisits.constellations.constellation import Constellation
from list3r.association.revisits.constellations.matching import MatchingSettings, likeness, match_constellations
from list3r.association.revisits.constellations.surface_fit import (
    ChunkSurfaces,
    KnownRelation,
    SurfaceFitSettings,
    fit_surfaces,
)
from list3r.association.revisits.cross_check import Side
from list3r.association.revisits.instance_similarity import SimilaritySettings, instance_set
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3, rotation_exp
from list3r.memory.core.records import FrameSamples


def constellation(seed: int, count: int = 9) -> Constellation:
    rng = np.random.default_rng(seed)
    feature = rng.standard_normal((count, 16))
    return Constellation(
        local_id=np.arange(count),
        feature=feature / np.linalg.norm(feature, axis=1, keepdims=True),
        center=np.c_[rng.uniform(-3, 3, (count, 2)), rng.uniform(0, 1.5, count)],
        size=rng.uniform(0.2, 0.8, (count, 3)),
        color=rng.uniform(0.2, 0.45, (count, 2)),
        R_up_chunk=np.eye(3),
        unit=2.5,
        space="looks@1/16",
    )


def seen_elsewhere(c: Constellation, S: Sim3, order: np.ndarray) -> Constellation:
    """The same things in another gauge and another order."""
    scale = float(S.scale)
    return replace(
        c,
        local_id=c.local_id,
        feature=c.feature[order],
        center=S.apply(c.center)[order],
        size=scale * c.size[order],
        color=c.color[order],
        unit=scale * c.unit,
    )


@pytest.mark.parametrize("yaw", [0.3, 3.1])
def test_a_constellation_fixes_yaw_scale_and_shift(yaw: float) -> None:
    u = constellation(1)
    S = Sim3(np.asarray(1.7), rotation_exp(np.array([0.0, 0.0, yaw])), np.array([4.0, -2.0, 0.5]))
    order = np.random.default_rng(2).permutation(len(u.local_id))
    best = match_constellations(u, seen_elsewhere(u, S, order), metric=False)[0]
    assert len(best.pairs) == len(u.local_id)
    assert {(int(i), int(order[j])) for i, j in best.pairs} == {(k, k) for k in range(len(u.local_id))}
    assert np.abs((best.S_v_u.inverse() @ S).log()).max() < 1e-6


def test_a_metric_pair_keeps_its_scale() -> None:
    u = constellation(3)
    S = Sim3(np.ones(()), rotation_exp(np.array([0.0, 0.0, 2.0])), np.array([1.0, 0.0, 0.0]))
    best = match_constellations(u, seen_elsewhere(u, S, np.arange(9)), metric=True)[0]
    assert float(best.S_v_u.scale) == 1.0
    assert np.abs((best.S_v_u.inverse() @ S).log()).max() < 1e-6


def test_half_of_the_things_moved_still_leaves_the_other_half() -> None:
    u = constellation(4, count=10)
    S = Sim3(np.asarray(0.8), rotation_exp(np.array([0.0, 0.0, -1.0])), np.zeros(3))
    v = seen_elsewhere(u, S, np.arange(10))
    v.center[:5] += np.random.default_rng(5).uniform(0.8, 1.6, (5, 3)) * [1, -1, 0.2]
    best = match_constellations(u, v, metric=False)[0]
    assert {int(i) for i, _ in best.pairs} >= {5, 6, 7, 8, 9}
    assert np.linalg.norm(best.S_v_u.apply(u.center[5:]) - v.center[5:], axis=1).max() < 0.1 * v.unit


def test_features_of_two_spaces_say_nothing() -> None:
    u = constellation(6)
    other = replace(u, space="looks@2/16")
    assert likeness(u, u).diagonal().min() > likeness(u, other).max()


def test_fewer_than_three_things_claim_nothing() -> None:
    u = constellation(7, count=2)
    assert match_constellations(u, u, metric=False, settings=MatchingSettings()) == []


def room(S: Sim3, seed: int) -> ChunkSurfaces:
    """Points of the floor and of three walls of a room of 4 x 3 x 2.5 m, in another gauge."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (3000, 3)) * [4.0, 3.0, 2.5]
    flat = rng.integers(4, size=3000)
    points[flat == 0, 2], points[flat == 1, 0] = 0.0, 0.0
    points[flat == 2, 1], points[flat == 3, 0] = 0.0, 4.0
    points = S.apply(points + 0.005 * rng.standard_normal(points.shape))
    samples = replace(
        FrameSamples.empty(),
        frame=np.zeros(3000, np.int64),
        pixel=np.arange(3000, dtype=np.int32),
        points=points.astype(np.float32),
        confidence=np.ones(3000, np.float32),
        instance=np.full(3000, -1, np.int32),
    )
    nothing = instance_set([], np.zeros((0, 4, 4)), "", SimilaritySettings())
    return ChunkSurfaces(
        Side(samples, Camera(64, 48, 50, 50, 32, 24), nothing), 2.0 * float(S.scale), SurfaceFitSettings()
    )


def test_surfaces_bring_a_rough_relation_together_and_up_holds_it_upright() -> None:
    S_v_u = Sim3(np.asarray(1.5), rotation_exp(np.array([0.0, 0.0, 2.0])), np.array([1.0, 2.0, 0.3]))
    u, v = room(Sim3.identity(), 1), room(S_v_u, 2)
    rough = S_v_u @ Sim3.exp(np.array([0.08, -0.06, 0.05, 0.02, -0.02, 0.05, 0.04]))
    things = np.array([[1.0, 1.0, 0.5], [3.0, 1.0, 0.5], [2.0, 2.5, 1.0]])
    up = np.array([0.0, 0.0, 1.0])
    found = fit_surfaces(rough, u, v, KnownRelation(things, S_v_u.apply(things), up, up, 1.5), metric=False)
    assert found is not None
    error = np.abs((found.S_v_u.inverse() @ S_v_u).log())
    assert error[:3].max() < 0.02 and np.degrees(error[3:6].max()) < 0.5 and error[6] < 0.01
    assert found.fitting > 0.8


def test_a_relation_is_believed_by_all_that_speaks_for_it() -> None:
    scores = {
        "match": np.e**3,
        "agreeing": 8.0,
        "after": 1.0,
        "agreement": 1.0,
        "fitting": 1.0,
        "likeness": 0.7,
        "rival": 0.0,
    }
    settings = ConstellationRegistrationSettings()
    # -3.1 + 0.89 * 3 + 0.33 * 8 - 2.6 * 1 + 9.7 * 0 + 1 * 0 + 9.3 * 0.7
    assert log_odds(scores, settings.belief) == pytest.approx(6.12)
    assert refusal(scores, settings) is None
    for worse in ({"agreeing": 3.0}, {"agreement": 0.6}, {"after": 2.5}, {"fitting": 0.09}, {"rival": 0.95}):
        assert refusal(scores | worse, settings) is not None
