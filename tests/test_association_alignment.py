"""Alignment: a known similarity is recovered, its stated region holds the truth, degenerate support is named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.peers.point_maps import align_point_maps
from list3r.association.overlap.alignment import Alignment, align
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3

S_V_U = Sim3.exp([0.4, -0.2, 0.7, 0.3, -0.5, 0.2, 0.0])
S_V_U_SCALED = Sim3.exp([0.4, -0.2, 0.7, 0.3, -0.5, 0.2, 0.35])


def frames_of_a_walk(rng: np.random.Generator, frames: int, each: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (F, N, 3) that a camera sees on its way, and their depth (F, N)."""
    depth = rng.uniform(1, 4, (frames, each))
    across = rng.uniform(-0.6, 0.6, (2, frames, each)) * depth
    yaw = np.cumsum(rng.normal(size=frames) * 0.05)[:, None]
    turned = depth * np.sin(yaw) + across[0] * np.cos(yaw), across[1], depth * np.cos(yaw) - across[0] * np.sin(yaw)
    return np.stack(turned, axis=-1) + np.cumsum(rng.normal(size=(frames, 1, 3)) * 0.05, axis=0), depth


def seen(rng: np.random.Generator, points: np.ndarray, depth: np.ndarray, by_frame: float) -> np.ndarray:
    """The points as a reconstruction gives them: noise growing with depth, and an error that each frame shares."""
    noisy = points + 0.005 * depth[..., None] ** 1.5 * rng.normal(size=points.shape)
    off = by_frame * rng.normal(size=(len(points), 7)) * [1, 1, 1, 0.5, 0.5, 0.5, 0.5]
    middle = noisy.mean(axis=1, keepdims=True)
    return np.asarray(Sim3.exp(off).apply(noisy - middle) + middle)


def trial(seed: int, metric: bool, by_frame: float, outliers: float, each: int = 40) -> tuple[Alignment, Sim3]:
    rng = np.random.default_rng([seed, metric])
    points, depth = frames_of_a_walk(rng, 30, each)
    S_v_u = Sim3.exp(np.r_[rng.normal(size=3), 0.7 * rng.normal(size=3), 0.0 if metric else 0.4 * rng.normal()])
    p_u = seen(rng, points, depth, by_frame).reshape(-1, 3)
    p_v = S_v_u.apply(seen(rng, points, depth, by_frame).reshape(-1, 3))
    wrong = rng.random(len(p_v)) < outliers
    p_v[wrong] += S_v_u.scale * (rng.normal(size=(int(wrong.sum()), 3)) * 0.7 + [0.2, 0.1, 0.3])
    return align(p_u, p_v, rng.uniform(0.3, 1, len(p_u)), np.repeat(np.arange(30), each), metric), S_v_u


@pytest.mark.parametrize(
    ("metric", "by_frame", "outliers"), [(False, 0.0, 0.0), (False, 0.008, 0.1), (True, 0.008, 0.1)]
)
def test_the_stated_region_holds_the_truth_as_often_as_it_says(metric: bool, by_frame: float, outliers: float) -> None:
    size, inside = 6 if metric else 7, []
    for seed in range(120):
        found, S_v_u = trial(seed, metric, by_frame, outliers)
        x = (found.S_v_u.inverse() @ S_v_u).log()[:size]
        inside.append(x @ np.linalg.solve(found.covariance[:size, :size], x) < chi2.ppf(0.95, size))
    assert 0.88 <= np.mean(inside) <= 0.995


def test_scale_is_not_shrunk_by_noise() -> None:
    errors = [(f.S_v_u.inverse() @ S).log()[6] for f, S in (trial(s, False, 0.0, 0.1) for s in range(60))]
    assert abs(np.mean(errors)) < 3 * np.std(errors) / np.sqrt(len(errors)) + 1e-5


def test_frames_that_are_misplaced_together_are_let_go() -> None:
    rng = np.random.default_rng(5)
    points, depth = frames_of_a_walk(rng, 30, 40)
    p_u, p_v = seen(rng, points, depth, 0), S_V_U_SCALED.apply(seen(rng, points, depth, 0))
    p_v[4:15] += [0.4, -0.2, 0.3]
    group = np.repeat(np.arange(30), 40)
    found = align(p_u.reshape(-1, 3), p_v.reshape(-1, 3), np.ones(1200), group, metric=False)
    assert np.abs((found.S_v_u.inverse() @ S_V_U_SCALED).log()).max() < 0.01
    assert found.inside.reshape(30, 40)[4:15].mean() < 0.02
    assert found.close == pytest.approx(19 / 30, abs=0.05)


def test_bending_widens_the_region() -> None:
    rng = np.random.default_rng(6)
    points, depth = frames_of_a_walk(rng, 30, 40)
    straight, bent = seen(rng, points, depth, 0), seen(rng, points, depth, 0)
    bent += 0.02 * np.sin(np.linspace(0, 4, 30))[:, None, None]
    group = np.repeat(np.arange(30), 40)
    a, b = (align(points.reshape(-1, 3), p.reshape(-1, 3), np.ones(1200), group, metric=True) for p in (straight, bent))
    assert a.bending < 2 < b.bending
    assert np.trace(b.covariance[:3, :3]) > 10 * np.trace(a.covariance[:3, :3])


def test_the_covariance_moves_with_the_frame_of_reference() -> None:
    rng = np.random.default_rng(7)
    points, depth = frames_of_a_walk(rng, 12, 30)
    p_u, p_v = seen(rng, points, depth, 0.01).reshape(-1, 3), S_V_U.apply(points.reshape(-1, 3))
    group, T = np.repeat(np.arange(12), 30), Sim3.exp([5.0, -3.0, 2.0, 0.4, 0.2, -0.9, 0.0])
    here = align(p_u, p_v, np.ones(360), group, metric=False)
    there = align(T.apply(p_u), p_v, np.ones(360), group, metric=False)
    assert np.allclose((there.S_v_u @ T).as_matrix(), here.S_v_u.as_matrix(), atol=1e-6)
    step = np.linalg.cholesky(here.covariance + 1e-15 * np.eye(7))[:, :7].T * 1e-3
    moved = (T @ Sim3.exp(step) @ T.inverse()).log() * 1e3
    assert np.allclose(moved.T @ moved, there.covariance, rtol=1e-3, atol=1e-6 * np.abs(there.covariance).max())


def test_metric_leaves_scale_alone() -> None:
    found, _ = trial(1, True, 0.005, 0.1)
    assert float(found.S_v_u.scale) == 1.0
    assert not found.covariance[6].any() and not found.covariance[:, 6].any()


def test_exact_pairs_and_a_single_frame() -> None:
    points = np.random.default_rng(8).uniform(-1, 1, (200, 3))
    found = align(points, S_V_U_SCALED.apply(points), np.ones(200), np.zeros(200, int), metric=False)
    assert np.allclose(found.S_v_u.as_matrix(), S_V_U_SCALED.as_matrix(), atol=1e-9)
    assert found.inliers == 200 and found.groups == 1
    assert np.isfinite(found.covariance).all()


def test_all_points_on_one_plane_determine_it() -> None:
    points = np.random.default_rng(9).uniform(-1, 1, (300, 3)) * [1, 1, 0]
    found = align(points, S_V_U_SCALED.apply(points), np.ones(300), np.repeat(np.arange(10), 30), metric=False)
    assert np.allclose(found.S_v_u.as_matrix(), S_V_U_SCALED.as_matrix(), atol=1e-9)


def test_pairs_that_are_not_finite_or_weigh_nothing_are_left_out() -> None:
    rng = np.random.default_rng(10)
    p_u = rng.uniform(-1, 1, (300, 3))
    p_v, weight = S_V_U.apply(p_u), np.ones(300)
    p_v[:40], weight[40:80] = np.nan, 0.0
    p_v[40:80] += 3.0
    found = align(p_u, p_v, weight, np.repeat(np.arange(10), 30), metric=True)
    assert np.isinf(found.residual[:80]).all() and found.inside[80:].all()
    assert np.allclose(found.S_v_u.as_matrix(), S_V_U.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda p, w: (p[:20], w[:20]), "20 pairs"),
        (lambda p, w: (p, 0 * w), "weights of 300 are zero"),
        (lambda p, w: (p * np.nan, w), "300 are not finite"),
        (lambda p, w: (0 * p + 7.0, w), "no extent"),
        (lambda p, w: (p * [1, 0, 0] + 2.0, w), "line"),
    ],
)
def test_degenerate_pairs_have_a_name(spoil, word: str) -> None:  # type: ignore[no-untyped-def]
    p, w = spoil(np.random.default_rng(11).uniform(-1, 1, (300, 3)), np.ones(300))
    with pytest.raises(DegenerateError, match=word):
        align(p, S_V_U.apply(p), w, np.arange(len(p)) // 30, metric=False)


def test_a_line_within_its_noise_has_a_name() -> None:
    rng = np.random.default_rng(12)
    line = np.linspace(0, 1, 300)[:, None] * [1.0, 2.0, 3.0]
    p_u, p_v = (line + 0.01 * rng.normal(size=line.shape) for _ in range(2))
    with pytest.raises(DegenerateError, match="line"):
        align(p_u, p_v, np.ones(300), np.repeat(np.arange(30), 10), metric=True)


# ---------------------------------------------------------------------------------------------- point maps


def test_point_maps_are_aligned_with_outliers_and_any_scale_of_confidence() -> None:
    rng = np.random.default_rng(13)
    points, depth = frames_of_a_walk(rng, 8, 60 * 80)
    maps_u, maps_v = (seen(rng, points, depth, 0).reshape(8, 60, 80, 3) for _ in range(2))
    wrong = rng.random(depth.shape).reshape(8, 60, 80) < 0.1
    maps_v[wrong] *= rng.uniform(0.3, 2.0, (int(wrong.sum()), 1))
    maps_v[0, :5] = np.nan
    maps_v = S_V_U_SCALED.apply(maps_v.reshape(-1, 3)).reshape(maps_v.shape)
    confidence = 50.0 / depth.reshape(8, 60, 80)
    found = align_point_maps(maps_u, confidence, maps_v, confidence, metric=False)
    error = (found.S_v_u.inverse() @ S_V_U_SCALED).log()
    assert abs(error[6]) < 1e-3
    assert np.abs(error[:6]).max() < 3e-3
    with pytest.raises(DegenerateError, match="no pixel"):
        align_point_maps(maps_u, 0 * confidence, maps_v, confidence, metric=False)


@pytest.mark.parametrize("seed", range(8))
def test_what_is_flat_is_never_mirrored(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p_u = rng.uniform(-1, 1, (900, 3)) * [1.0, 0.8, 0.0] + [0.0, 0.0, 2.0]
    S_v_u = Sim3.exp([0.3, -0.1, 0.2, *rng.normal(size=3), 0.0])
    noisy = S_v_u.apply(p_u) + 0.002 * rng.normal(size=p_u.shape)
    found = align(p_u, noisy, np.ones(900), np.repeat(np.arange(30), 30), metric=True).S_v_u
    assert np.linalg.det(found.rotation) > 0
    assert np.abs(found.rotation - S_v_u.rotation).max() < 0.01
