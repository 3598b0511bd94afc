"""Dense depth from colour: known rooms are recovered, and what cannot be known is not invented."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
import torch

from list3r.frames.base import Camera, Frame
from list3r.memory.core.geometry import rotation_exp
from list3r.reconstruction.mvs import sweep
from list3r.reconstruction.mvs.fill import fill_regions
from list3r.reconstruction.mvs.fusion import DepthMap, fill_flat, project_depth, rims_out
from list3r.reconstruction.mvs.images import Warp, box_sum, look_up
from list3r.reconstruction.mvs.settings import DepthFusionSettings, RegionFillSettings, SweepSettings, SweepViewSettings
from list3r.reconstruction.mvs.stereo import PosedFrames, dense_depth, plane_residual, stereo_noise
from list3r.reconstruction.mvs.views import choose_projected, choose_sources, pair_views, plane_depths, seen_parts
from tests.rgbd_scenes import BOXES, CAMERA, black, frames_along, render, walk

COUNT = 20
SMALL = CAMERA.shrunk(160)


def shrunk(frame: Frame) -> Frame:
    """The frame as the camera `SMALL` takes it."""
    size = (SMALL.width, SMALL.height)
    depth = None if frame.depth is None else frame.depth[::2, ::2]
    return replace(frame, color=cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA), depth=depth)


@lru_cache(maxsize=1)
def small_scene() -> tuple[tuple[Frame, ...], np.ndarray, np.ndarray]:
    """The scene at half the size."""
    frames, T, truth = scene()
    return tuple(map(shrunk, frames)), T, truth[:, ::2, ::2]


@lru_cache(maxsize=1)
def scene() -> tuple[tuple[Frame, ...], np.ndarray, np.ndarray]:
    """Frames, poses and exact depth of a textured room."""
    T = walk(COUNT, speed=2.0)
    truth = np.stack([f.depth for f in frames_along(T, seed=101, noise=False)])
    return tuple(frames_along(T, seed=101)), T, truth


@lru_cache(maxsize=1)
def found() -> tuple[np.ndarray, np.ndarray]:
    frames, T, _ = scene()
    return dense_depth(PosedFrames(frames, np.ones(COUNT, bool), T, CAMERA))


def errors(depth: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Relative errors where depth is known. Shape (N,)."""
    known = depth > 0
    return np.abs(depth[known] / truth[known] - 1.0)


def test_a_textured_room_is_recovered() -> None:
    depth, confidence = found()
    error = errors(depth, scene()[2])
    assert (depth > 0).mean() > 0.85
    assert np.median(error) < 0.01
    assert (error > 0.1).mean() < 0.04
    assert depth.dtype == np.float32 and confidence.dtype == np.float16
    assert np.array_equal(depth > 0, confidence > 0)
    assert confidence.max() <= 1.0


def test_confidence_knows_where_the_errors_are() -> None:
    depth, confidence = found()
    error, sure = errors(depth, scene()[2]), confidence[depth > 0].astype(float)
    low, high = np.quantile(sure, [0.33, 0.67])
    assert (error[sure > high] > 0.05).mean() < 0.5 * (error[sure < low] > 0.05).mean()
    assert np.median(error[sure > high]) < np.median(error[sure < low])
    sigma = 0.02 * np.sqrt(1.0 / sure - 1.0)
    assert (error < 2.0 * sigma).mean() > 0.85


def test_depth_scales_with_the_poses_and_sparse_points_only_bound_the_search() -> None:
    frames, T, truth = small_scene()
    larger = T.copy()
    larger[:, :3, 3] *= 10.0
    v, u = np.mgrid[5:115:8, 5:155:8]
    xy = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    sparse = [(xy, 10.0 * truth[k][v.ravel(), u.ravel()].astype(float)) for k in range(COUNT)]
    sparse[3] = None
    depth, _ = dense_depth(PosedFrames(frames, np.ones(COUNT, bool), larger, SMALL, sparse))
    assert (depth > 0).mean() > 0.85
    assert np.median(errors(depth, 10.0 * truth)) < 0.015


def test_the_same_for_any_number_of_threads() -> None:
    frames, T, _ = (part[:8] for part in small_scene())
    once = dense_depth(PosedFrames(frames, np.ones(8, bool), T, SMALL))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(before + 1)
        again = dense_depth(PosedFrames(frames, np.ones(8, bool), T, SMALL))
    finally:
        torch.set_num_threads(before)
    assert once[0].any()
    assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))


def test_changing_exposure_does_not_matter() -> None:
    frames, T, truth = small_scene()
    gain = 0.75 + 0.25 * np.sin(np.arange(COUNT))
    changed = [
        replace(f, color=np.clip(f.color * g + 8.0 * g, 0, 255).astype(np.uint8))
        for f, g in zip(frames, gain, strict=True)
    ]
    depth, _ = dense_depth(PosedFrames(changed, np.ones(COUNT, bool), T, SMALL))
    assert (depth > 0).mean() > 0.8
    assert np.median(errors(depth, truth)) < 0.015


def test_walls_without_texture_are_not_invented() -> None:
    T = walk(COUNT, speed=2.0)
    frames = list(map(shrunk, frames_along(T, seed=102, contrast=0.0)))
    depth, confidence = dense_depth(PosedFrames(frames, np.ones(COUNT, bool), T, SMALL))
    truth = np.stack([f.depth[::2, ::2] for f in frames_along(T, seed=102, contrast=0.0, noise=False)])
    error, sure = errors(depth, truth), confidence[depth > 0]
    assert (confidence > 0.3).mean() < 0.25
    assert ((error > 0.1) & (sure > 0.3)).sum() < 0.05 * depth.size


def test_turning_on_the_spot_gives_no_depth() -> None:
    T = walk(16)
    T[:, :3, 3] = 0.0
    T[:, :3, :3] = rotation_exp(np.outer(np.arange(16), [0.0, 0.02, 0.0]))
    depth, confidence = dense_depth(
        PosedFrames(list(map(shrunk, frames_along(T, seed=101))), np.ones(16, bool), T, SMALL)
    )
    assert not depth.any() and not confidence.any()


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_frames_give_no_depth(count: int) -> None:
    frames, T, _ = small_scene()
    depth, _ = dense_depth(PosedFrames(frames[:count], np.ones(count, bool), T[:count], SMALL))
    assert depth.shape == (count, SMALL.height, SMALL.width) and not depth.any()


def test_black_frames_give_no_depth_and_frames_without_a_pose_stay_out() -> None:
    frames, T, truth = small_scene()
    dark = [black(f) for f in frames]
    assert not dense_depth(PosedFrames(dark, np.ones(COUNT, bool), T, SMALL))[0].any()
    posed, lost = np.ones(COUNT, bool), T.copy()
    posed[7:11], lost[7:11] = False, np.nan
    mixed = [black(f) if 7 <= k < 11 else f for k, f in enumerate(frames)]
    depth, _ = dense_depth(PosedFrames(mixed, posed, lost, SMALL))
    assert not depth[7:11].any()
    assert np.median(errors(depth[posed], truth[posed])) < 0.015


def test_what_moves_is_not_confidently_wrong() -> None:
    T = walk(COUNT, speed=2.0)
    frames, truth = [], []
    for k, pose in enumerate(T):
        shift = np.array([0.02 * k, 0.0, 0.0])
        low, high = BOXES[1]
        boxes = (BOXES[0], (tuple(low + shift), tuple(high + shift)), *BOXES[2:])
        frames.append(shrunk(render(pose, seed=101, boxes=boxes, index=k)))
        truth.append(render(pose, seed=101, boxes=boxes, index=k, noise=False).depth[::2, ::2])
    depth, confidence = dense_depth(PosedFrames(frames, np.ones(COUNT, bool), T, SMALL))
    error, sure = errors(depth, np.stack(truth)), confidence[depth > 0].astype(float)
    assert np.median(error) < 0.015
    assert ((error > 0.1) & (sure > 0.5)).mean() < 0.03


def test_odd_sizes_and_small_pictures() -> None:
    frames, T, truth = (part[:12] for part in scene())
    camera = Camera(141, 107, CAMERA.fx * 141 / 320, CAMERA.fy * 107 / 240, 70.0, 53.0)
    small = [replace(f, color=cv2.resize(f.color, (141, 107), interpolation=cv2.INTER_AREA)) for f in frames]
    depth, _ = dense_depth(PosedFrames(small, np.ones(12, bool), T, camera))
    exact = np.stack([cv2.resize(t, (141, 107), interpolation=cv2.INTER_NEAREST) for t in truth])
    assert depth.shape == (12, 107, 141)
    assert np.median(errors(depth, exact)) < 0.02


def test_a_warp_leads_points_where_the_other_camera_sees_them() -> None:
    T = walk(2, speed=8.0)
    warp = Warp.between(T[0], T[1], CAMERA, "cpu")
    x, y, ratio = warp.place(torch.full((1, CAMERA.height, CAMERA.width), 0.5))
    K = CAMERA.matrix()
    point = T[0] @ np.append(2.0 * np.linalg.inv(K) @ [40, 90, 1], 1.0)
    seen = np.linalg.inv(T[1]) @ point
    pixel = K @ seen[:3] / seen[2]
    assert np.allclose([x[0, 90, 40], y[0, 90, 40]], pixel[:2], atol=1e-2)
    assert np.isclose(float(ratio[0, 90, 40]), seen[2] / 2.0, atol=1e-4)


def test_look_up_and_box_sum() -> None:
    image = torch.arange(12.0).reshape(3, 4)
    values, inside = look_up(image, torch.tensor([[1.5, 5.0]]), torch.tensor([[1.0, 1.0]]))
    assert float(values[0, 0]) == pytest.approx(5.5)
    assert inside.tolist() == [[True, False]]
    assert torch.allclose(box_sum(torch.ones(2, 5, 6), 1), torch.full((2, 5, 6), 9.0))


def test_a_resized_camera_sees_the_same() -> None:
    small = Camera(640, 480, 524.0, 524.0, 319.5, 239.5).shrunk(320)
    assert (small.width, small.height, small.fx, small.cx, small.cy) == (320, 240, 262.0, 159.5, 119.5)


def test_sources_have_parallax_and_stand_on_both_sides() -> None:
    T = np.tile(np.eye(4), (41, 1, 1))
    T[:, 0, 3] = 0.02 * np.arange(41)
    posed, depth, sharp = np.ones(41, bool), np.full(41, 2.0), np.ones(41)
    pairs = pair_views([20], posed, T, CAMERA, depth)
    chosen = choose_sources(0, pairs, T, sharp, 20, SweepViewSettings())
    assert len(chosen) == 6 and 20 not in chosen
    assert all(k < 20 for k in chosen[0::2]) and all(k > 20 for k in chosen[1::2])
    assert (pairs.angle_deg[0, chosen] > 0.6).all()
    still = np.tile(np.eye(4), (41, 1, 1))
    nothing = pair_views([20], posed, still, CAMERA, depth)
    assert choose_sources(0, nothing, still, sharp, 20, SweepViewSettings()) == []


def test_depth_is_taken_over_from_close_looks_and_from_what_sees_the_rest() -> None:
    T = np.tile(np.eye(4), (12, 1, 1))
    T[:, 2, 3] = np.repeat([0.0, -3.0], (8, 4))  # eight close looks at the middle, four from further back
    posed, depth, keys = np.ones(12, bool), np.repeat([1.0, 4.0], (8, 4)), [*range(8), 9, 10]
    overlap = pair_views(keys, posed, T, CAMERA, depth).overlap[:, 11]
    parts = seen_parts(keys, posed, T, CAMERA, depth)[11]
    chosen = choose_projected(overlap, parts, np.array([11 - k for k in keys]), DepthFusionSettings())
    assert overlap.min() == 1.0 and parts[:8].mean() < 0.3 and parts[8:].all()
    assert len(chosen) == 6 and {8, 9} <= set(chosen)
    assert choose_projected(np.zeros(0), np.zeros((0, 20), bool), np.zeros(0, int), DepthFusionSettings()) == []


def test_who_steps_back_sees_depth_all_the_way() -> None:
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    T[:, 2, 3] = 0.9 - 1.8 * np.linspace(0.0, 1.0, COUNT)
    T[:, 0, 3] = 0.02 * np.sin(np.arange(COUNT))
    truth = np.stack([f.depth for f in frames_along(T, seed=101, noise=False)])[:, ::2, ::2]
    frames = [shrunk(f) for f in frames_along(T, seed=101)]
    depth, _ = dense_depth(PosedFrames(frames, np.ones(COUNT, bool), T, SMALL))
    assert (depth > 0).mean(axis=(1, 2)).min() > 0.75
    assert np.median(errors(depth, truth)) < 0.02


def test_planes_are_as_many_as_the_parallax_needs() -> None:
    planes = plane_depths(1.0, 4.0, 20.0, 8, 96)
    assert planes[0] == pytest.approx(0.25) and planes[-1] == pytest.approx(1.0)
    assert len(planes) == 22 and len(plane_depths(1.0, 4.0, 1e4, 8, 96)) == 96


def test_holes_in_a_plane_are_filled_and_said_to_be_unsure() -> None:
    v, u = np.mgrid[:60, :80].astype(np.float32)
    plane = 0.4 + 0.002 * u + 0.001 * v
    inverse, hole = plane.copy(), np.zeros((60, 80), bool)
    hole[25:31, 40:47] = True
    inverse[hole] = 0.0
    inverse[:, 70:] = 0.0
    sigma = np.where(inverse > 0, 0.01, 0.0).astype(np.float32)
    out = fill_flat(DepthMap(torch.from_numpy(inverse), torch.from_numpy(sigma)), DepthFusionSettings())
    assert np.allclose(out.inverse.numpy()[hole], plane[hole], rtol=1e-3)
    assert (out.sigma.numpy()[hole] == np.float32(DepthFusionSettings().fill_sigma)).all()
    assert not out.inverse.numpy()[:, 70:].any()


def test_what_stands_in_front_loses_its_rim_and_a_slanted_floor_nothing() -> None:
    inverse = np.full((40, 60), 0.5, np.float32)
    inverse[10:30, 20:40] = 1.0
    inverse[:, 50:] = 0.0
    shown = torch.from_numpy(inverse)
    kept = rims_out(DepthMap(shown, 0.01 * shown), 2, 0.04)
    gone = (kept.inverse.numpy() == 0) & (inverse > 0)
    inner = np.zeros_like(gone)
    inner[12:28, 22:38] = True
    assert np.array_equal(gone, (inverse == 1.0) & ~inner), "two pixels all around what is near, and nothing else"
    assert np.array_equal(kept.sigma.numpy() == 0, kept.inverse.numpy() == 0)

    floor = torch.from_numpy(np.linspace(0.3, 1.0, 60, dtype=np.float32)[:, None].repeat(60, 1))
    assert rims_out(DepthMap(floor, 0.01 * floor), 2, 0.04).inverse.equal(floor), "steps of 2 px of up to 0.08"


def test_a_blank_region_takes_the_plane_of_its_rim_only_where_the_rim_is_one() -> None:
    v, u = np.mgrid[:60, :80].astype(np.float32)
    plane = (0.4 + 0.002 * u + 0.001 * v).astype(np.float32)
    hole = np.zeros((60, 80), bool)
    hole[10:50, 20:60] = True
    inverse = np.where(hole, 0.0, plane).astype(np.float32)
    sigma = np.where(hole, 0.0, 0.01).astype(np.float32)
    color = np.full((60, 80, 3), 120, np.uint8)
    filled, unsure = fill_regions(inverse, sigma, color, RegionFillSettings(most_share=0.5))
    assert np.allclose(filled, plane, rtol=1e-3)
    assert (unsure[hole] == np.float32(RegionFillSettings().sigma)).all()
    rng = np.random.default_rng(0)
    crumpled = np.where(hole, 0.0, plane * rng.uniform(0.8, 1.2, plane.shape)).astype(np.float32)
    assert not fill_regions(crumpled, sigma, color, RegionFillSettings(most_share=0.5))[0][hole].any()
    other = color.copy()
    other[hole] = 30
    assert not fill_regions(inverse, sigma, other, RegionFillSettings(most_share=0.5))[0][hole].any()


def test_noise_is_measured_on_smooth_surfaces() -> None:
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:240, :320]
    inverse = 0.5 + 0.0005 * u + 0.0003 * v
    assert np.nanmax(plane_residual(inverse, 8)[8:-8, 8:-8]) < 1e-6
    noisy = inverse + rng.normal(0, 0.004, (4, 240, 320))
    noise = stereo_noise((1.0 / noisy).astype(np.float32), np.full(noisy.shape, 0.7, np.float16))
    assert noise is not None and noise.quadratic == pytest.approx(0.004, rel=0.1)
    assert float(noise.sigma(np.array([2.0], np.float32))[0]) == pytest.approx(0.016, rel=0.1)
    assert stereo_noise(np.zeros((2, 24, 32), np.float32), np.zeros((2, 24, 32), np.float16)) is None


@pytest.mark.parametrize("each", [False, True])
def test_compiled_matching_costs_are_those_of_tensors(each: bool) -> None:
    rng, settings = np.random.default_rng(5), SweepSettings()
    camera = Camera(61, 47, 50.0, 50.0, 30.0, 23.0)
    pictures = [torch.from_numpy(cv2.blur(rng.random((47, 61), np.float32), (3, 3))) for _ in range(4)]
    T = [np.eye(4) for _ in range(3)]
    for k, pose in enumerate(T):
        pose[:3, :3], pose[:3, 3] = rotation_exp(rng.normal(0.0, 0.1, 3)), (0.1 * k, -0.05, 1.2 * (k == 2))
    warps = [Warp.between(np.eye(4), pose, camera, "cpu") for pose in T]  # the last picture is taken from behind things
    depths = torch.linspace(0.2, 2.0, 7)[:, None, None]
    depths = depths * (1.0 + torch.from_numpy(rng.random((1, 47, 61), np.float32))) if each else depths
    reference = sweep.SweepReference.of(pictures[0], settings.radius_px, settings.image_noise)
    wanted = sweep._cost_of_tensors(reference, pictures[1:], warps, depths, settings)
    assert wanted.min() < 0.4 and wanted.max() > 0.6
    torch.testing.assert_close(
        sweep._group_cost(reference, pictures[1:], warps, depths, settings), wanted, atol=2e-3, rtol=0
    )


@pytest.mark.parametrize("shape", [(1, 3, 5), (2, 1, 2), (17, 23, 31)])
def test_compiled_path_costs_are_those_of_tensors_to_the_last_bit(shape: tuple[int, int, int]) -> None:
    rng, settings = np.random.default_rng(7), SweepSettings()
    volume, gray = (torch.from_numpy(rng.random(s, np.float32)) for s in (shape, shape[:2]))
    found = sweep._paths(volume, gray, settings)
    assert torch.equal(found, sweep._paths_of_tensors(volume, gray, settings))
    assert (found >= 0).all() and found.std() > 0.1


@pytest.mark.parametrize("shape", [(3, 1, 1), (5, 12, 7), (40, 9, 16)])
def test_the_least_cost_is_found_as_by_tensors_to_the_last_bit(shape: tuple[int, int, int]) -> None:
    cost = torch.from_numpy(np.random.default_rng(8).integers(0, 9, shape).astype(np.float32) / 8)
    found, wanted = sweep.below_planes(cost), sweep._below_planes_of_tensors(cost)
    assert torch.equal(found[0], wanted[0]) and torch.equal(found[1], wanted[1])


def test_depth_is_carried_to_where_it_is_seen_and_the_nearest_counts() -> None:
    rng, camera = np.random.default_rng(6), Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    inverse = np.where(rng.random((30, 40)) < 0.8, 0.5, 0.0).astype(np.float32)
    near = DepthMap(torch.from_numpy(inverse), torch.from_numpy(np.where(inverse > 0, 0.01, 0).astype(np.float32)))
    far = DepthMap(torch.full((30, 40), 0.25), torch.full((30, 40), 0.001))
    stay = Warp.between(np.eye(4), np.eye(4), camera, "cpu")
    seen = project_depth([near, far], [stay, stay], DepthFusionSettings())
    torch.testing.assert_close(seen.inverse, torch.where(near.inverse > 0, 0.5, 0.25))
    torch.testing.assert_close(seen.sigma, torch.where(near.inverse > 0, 0.01, 0.001))
    back = np.eye(4)
    back[2, 3] = -2.0  # two units behind what was at 2 units
    assert (
        project_depth([near], [Warp.between(np.eye(4), back, camera, "cpu")], DepthFusionSettings()).inverse.max()
        == 0.25
    )
