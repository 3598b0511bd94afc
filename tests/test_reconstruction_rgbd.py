"""Reconstruction rgbd: known poses are recovered, and what cannot be followed is said to be lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, TrackingError
from list3r.memory.core.geometry import rotation_exp, umeyama
from list3r.reconstruction.base import backproject
from list3r.reconstruction.rgbd.confidence import depth_confidence
from list3r.reconstruction.rgbd.frame_registration import FrameRegistration
from list3r.reconstruction.rgbd.odometry import CameraTracker, TrackedSegment
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from list3r.reconstruction.rgbd.settings import ConfidenceSettings, OdometrySettings
from list3r.reconstruction.rgbd.surfels import SurfelModel
from list3r.reconstruction.rgbd.view import make_view
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import RenderedFrame, Renderer
from list3r.simulation.rendering.sensor import SensorSettings, sense
from tests.rgbd_scenes import CAMERA, along_a_striped_wall, black, frames_along, pose_errors, render, walk


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return walk(45)


@pytest.fixture(scope="module")
def frames(truth: np.ndarray) -> list[Frame]:
    return frames_along(truth)


def test_known_poses_are_recovered(frames: list[Frame], truth: np.ndarray) -> None:
    result = RgbdReconstructor()(frames, CAMERA)
    shift, turn = pose_errors(result.T_chunk_cam, truth)
    assert result.posed.all()
    assert shift.max() < 0.01
    assert turn.max() < 0.5
    assert np.allclose(result.T_chunk_cam[0], np.eye(4))
    assert result.keyframes[0] == 0
    assert np.all(np.diff(result.keyframes) > 0)


def test_the_same_frames_give_the_same_result(frames: list[Frame]) -> None:
    a, b = (RgbdReconstructor()(frames[:15], CAMERA) for _ in range(2))
    assert np.array_equal(a.T_chunk_cam, b.T_chunk_cam)
    assert np.array_equal(a.confidence, b.confidence)


def test_the_same_pictures_give_the_same_poses_whatever_their_clock_says() -> None:
    """Whether a frame is searched for is told by the pictures, not by the time between them."""
    truth = walk(12, speed=8.0)
    frames = frames_along(truth)
    found = [
        RgbdReconstructor()([replace(f, time_s=n / fps) for n, f in enumerate(frames)], CAMERA).T_chunk_cam
        for fps in (5.0, 10.0, 30.0)
    ]
    assert pose_errors(found[0], truth)[0].max() < 0.005
    assert np.allclose(found[0], found[1], atol=1e-5) and np.allclose(found[0], found[2], atol=1e-5)


def test_confidence_is_that_of_each_depth_image_by_itself(frames: list[Frame]) -> None:
    found = RgbdReconstructor()(frames[:4], CAMERA)
    for depth, confidence in zip(found.depth, found.confidence, strict=True):
        assert np.array_equal(confidence, depth_confidence(depth, CAMERA, ConfidenceSettings()))


def test_given_poses_are_kept_and_bad_ones_are_not_used(frames: list[Frame], truth: np.ndarray) -> None:
    given = list(frames[:10])
    given[2] = replace(given[2], T_source_cam=None)
    given[3] = replace(given[3], T_source_cam=np.full((4, 4), np.nan))
    given[4] = replace(given[4], T_source_cam=np.diag([2.0, 2.0, 2.0, 1.0]))
    result = RgbdReconstructor(poses="given")(given, CAMERA)
    assert result.posed.tolist() == [True, True, False, False, False, *[True] * 5]
    assert np.array_equal(result.T_chunk_cam[result.posed], truth[:10][result.posed])


def test_covered_frames_are_lost_and_the_rest_goes_on(frames: list[Frame], truth: np.ndarray) -> None:
    covered = [black(f) if 20 <= k < 26 else f for k, f in enumerate(frames)]
    result = RgbdReconstructor()(covered, CAMERA)
    assert np.flatnonzero(~result.posed).tolist() == list(range(20, 26))
    shift, _ = pose_errors(result.T_chunk_cam[result.posed], truth[result.posed])
    assert shift.max() < 0.01


def test_frames_without_depth_are_lost(frames: list[Frame]) -> None:
    some = [replace(f, depth=None) if k == 3 else f for k, f in enumerate(frames[:8])]
    result = RgbdReconstructor()(some, CAMERA)
    assert np.flatnonzero(~result.posed).tolist() == [3]
    assert not result.depth[3].any()
    assert not result.confidence[3].any()


@pytest.mark.slow
def test_a_cut_to_a_seen_place_is_attached_again(truth: np.ndarray) -> None:
    poses = np.concatenate([walk(25), walk(20, start=2.0)])
    result = RgbdReconstructor()(frames_along(poses), CAMERA)
    shift, _ = pose_errors(result.T_chunk_cam, poses)
    assert result.posed.all()
    assert shift.max() < 0.02


def test_a_cut_to_another_place_leaves_the_larger_part(frames: list[Frame], truth: np.ndarray) -> None:
    other = frames_along(walk(15), seed=7, boxes=(((-0.5, -0.4, 1.2), (0.1, 0.3, 1.7)),))
    cut = [*frames[:25], *(replace(f, index=25 + k, time_s=(25 + k) / 30) for k, f in enumerate(other))]
    result = RgbdReconstructor()(cut, CAMERA)
    assert result.posed.tolist() == [True] * 25 + [False] * 15
    shift, _ = pose_errors(result.T_chunk_cam[:25], truth[:25])
    assert shift.max() < 0.01


def test_each_stretch_between_cuts_is_a_part_in_order_of_time(frames: list[Frame], truth: np.ndarray) -> None:
    other = frames_along(walk(15), seed=7, boxes=(((-0.5, -0.4, 1.2), (0.1, 0.3, 1.7)),))
    bare = black(frames[0])
    cut = [*other[:10], bare, *frames[:25]]
    cut = [replace(f, index=k, time_s=k / 30) for k, f in enumerate(cut)]
    first, last = RgbdReconstructor().parts(cut, CAMERA)
    assert first.frame_indices.tolist() == list(range(10)) and first.posed.all()
    assert last.frame_indices.tolist() == list(range(10, 36)) and last.posed[1:].all() and not last.posed[0]
    assert last.frame_indices[last.keyframes[0]] == 11
    for part, poses in ((first, walk(15)[:10]), (last, truth[:25])):
        shift, _ = pose_errors(part.T_chunk_cam[part.posed], poses)
        assert shift.max() < 0.01


def test_a_video_without_a_cut_is_one_part(frames: list[Frame]) -> None:
    (part,) = RgbdReconstructor().parts(frames[:12], CAMERA, deep=range(0, 12, 2))
    whole = RgbdReconstructor().thinned(frames[:12], CAMERA, range(0, 12, 2))
    assert np.array_equal(part.T_chunk_cam, whole.T_chunk_cam) and part.between is not None


def test_a_slow_video_is_followed() -> None:
    poses = walk(10, speed=15.0)
    result = RgbdReconstructor()(frames_along(poses, step_s=0.5), CAMERA)
    shift, _ = pose_errors(result.T_chunk_cam, poses)
    assert result.posed.all()
    assert shift.max() < 0.02


def test_a_step_that_features_tell_beyond_doubt_is_searched_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every other keyframe and the starts all round cost four times as much and lead to the same place."""
    asked: list[int] = []
    guess = CameraTracker._feature_guess
    monkeypatch.setattr(CameraTracker, "_feature_guess", lambda self, s, a, b: asked.append(b) or guess(self, s, a, b))
    monkeypatch.setattr(CameraTracker, "_sweep", lambda *_: pytest.fail("it was looked for all round"))
    poses = walk(6, speed=15.0)
    shift, _ = pose_errors(RgbdReconstructor()(frames_along(poses, step_s=0.5), CAMERA).T_chunk_cam, poses)
    assert asked and asked == sorted(set(asked)), "no frame by more than one keyframe"
    assert shift.max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [(70, 71, 72, 73), (68, 69, 71, 72, 73)])
def test_a_motion_that_nothing_foretells_is_searched_for(numbers: tuple[int, ...]) -> None:
    """Three degrees and a bare wall: from no motion a frame falls into a false minimum 5 cm off."""
    settings = WalkSettings(seed=3, frames=280)
    camera, renderer = settings.camera(), Renderer(settings.world(), settings.camera())
    time_s, poses = settings.poses()
    frames = []
    for k in numbers:
        sensed = sense(renderer.render(poses[k]), settings.sensor, settings.seed, k, float(time_s[k]))
        frames.append(Frame(k, float(time_s[k]), sensed.color, sensed.depth, None))
    shift, _ = pose_errors(RgbdReconstructor()(frames, camera).T_chunk_cam, poses[list(numbers)])
    assert shift.max() < 0.005


@pytest.mark.parametrize("gain", [0.8, 1.2])
def test_another_exposure_moves_nothing(gain: float) -> None:
    frames, poses = along_a_striped_wall([0.0] * 4, 0.2, 0.9, 0.6, [1.0, 1.0, 1.0, gain])
    result = RgbdReconstructor()(frames, CAMERA)
    shift, turn = pose_errors(result.T_chunk_cam, poses)
    assert result.posed.all()
    assert shift.max() < 0.0005 and turn.max() < 0.05


@pytest.mark.parametrize(("contrast", "period_m", "dark"), [(0.3, 0.1, 0.8), (0.6, 0.12, 0.5), (1.0, 0.15, 0.5)])
def test_a_pattern_that_repeats_does_not_lead_astray(contrast: float, period_m: float, dark: float) -> None:
    """The camera turns back, and the wall looks much the same where it is expected, a period away."""
    frames, poses = along_a_striped_wall([-0.1, -0.05, 0.0, 0.05, 0.1, 0.05, 0.0], contrast, period_m, dark)
    shift, _ = pose_errors(RgbdReconstructor()(frames, CAMERA).T_chunk_cam, poses)
    assert shift.max() < 0.005


def test_a_bare_wall_does_not_tell_how_the_camera_moves() -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 2, 3] = 2.0
    poses[:, 0, 3] = 0.05 * np.arange(6)
    with pytest.raises(TrackingError, match="0 to 5"):
        RgbdReconstructor()(frames_along(poses, contrast=0.0, boxes=()), CAMERA)


def test_noise_of_one_view_does_not_hold_the_camera_before_a_bare_wall() -> None:
    shape = (CAMERA.height, CAMERA.width)
    shade = np.linspace(150, 190, CAMERA.width, dtype=np.float32)
    color = np.tile(shade[None, :, None], (CAMERA.height, 1, 3))
    wall = RenderedFrame(color, np.full(shape, 0.8, np.float32), np.zeros(shape, np.int32), np.ones(shape, np.float32))
    seen = [sense(wall, SensorSettings(), 0, k, k / 15) for k in range(6)]
    frames = [Frame(k, k / 15, f.color, f.depth, None) for k, f in enumerate(seen)]
    with pytest.raises(TrackingError, match="0 to 5"):
        RgbdReconstructor()(frames, CAMERA)


def test_a_model_keeps_its_exposure(frames: list[Frame], truth: np.ndarray) -> None:
    how, small, grays = OdometrySettings(), CAMERA.shrunk(160), []
    for gain in (1.0, 0.4):
        model = SurfelModel(how.fusion, how.noise)
        for k, light in ((0, 1.0), (12, gain)):
            frame = frames[k]
            assert frame.depth is not None
            view = make_view((light * frame.color).astype(np.uint8), frame.depth, small, how.noise)
            model.fuse(view, np.linalg.inv(truth[0]) @ truth[k])
        grays.append(model.elements[:, 6].copy())
    assert len(grays[0]) == len(grays[1]) and np.quantile(np.abs(grays[1] - grays[0]), 0.9) < 15.0


def test_places_that_look_alike_on_a_plane_are_not_taken_for_one() -> None:
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = np.concatenate([x + np.linspace(0.0, 0.1, 10) for x in (-1.5, 0.0, 1.5)])
    poses[:, 2, 3] = 2.4
    parts = RgbdReconstructor().parts(frames_along(poses, boxes=()), CAMERA)  # the paper repeats after 3 m
    assert [int(p.posed.sum()) for p in parts] == [10, 10, 10]


def test_a_segment_does_not_begin_by_a_slide_along_a_plane(frames: list[Frame]) -> None:
    tracker = CameraTracker(frames, CAMERA, OdometrySettings())
    tracker.run()
    begun = TrackedSegment(tracker.segments[0].model, {0: np.eye(4)})
    found = FrameRegistration(np.eye(4), 0.9, 1.0, 1.0, 0.8, 5000, 1e8 * np.eye(6), np.zeros((6, 6)))
    assert not tracker._settled(begun, 1, found, []) and tracker._settled(
        begun, 1, replace(found, correlation=0.99), []
    )


def test_a_frame_that_depth_alone_places_says_so(frames: list[Frame], truth: np.ndarray) -> None:
    rng, blurred = np.random.default_rng(0), cv2.GaussianBlur(frames[6].color, (0, 0), 6).astype(np.float32)
    shadow = cv2.GaussianBlur(rng.standard_normal(blurred.shape[:2]), (0, 0), 4)
    color = blurred + 0.5 * blurred.std() / shadow.std() * shadow[..., None]
    spoiled = replace(frames[6], color=np.clip(color, 0, 255).astype(np.uint8))
    result = RgbdReconstructor()([*frames[:6], spoiled, *frames[7:12]], CAMERA)
    assert result.posed.all() and result.unsure == {6}
    assert pose_errors(result.T_chunk_cam, truth[:12])[0].max() < 0.01


def test_noise_is_not_followed() -> None:
    rng = np.random.default_rng(0)
    shape = (CAMERA.height, CAMERA.width)
    noise = [
        Frame(
            k, k / 30, rng.integers(0, 255, (*shape, 3), np.uint8), rng.uniform(0.5, 4, shape).astype(np.float32), None
        )
        for k in range(4)
    ]
    with pytest.raises(TrackingError):
        RgbdReconstructor()(noise, CAMERA)


def test_what_is_missing_is_named(frames: list[Frame]) -> None:
    with pytest.raises(TrackingError, match="no depth"):
        RgbdReconstructor()([replace(f, depth=None) for f in frames[:3]], CAMERA)
    with pytest.raises(TrackingError, match="--poses estimate"):
        RgbdReconstructor(poses="given")([replace(f, T_source_cam=None) for f in frames[:3]], CAMERA)
    with pytest.raises(OptionError, match="given, prior or estimate"):
        RgbdReconstructor(poses="guess")


def test_confidence_falls_with_distance_angle_and_edges(frames: list[Frame]) -> None:
    near, far = (render(_looking_at_wall(d, 0.0), boxes=(), noise=False) for d in (1.0, 3.0))
    slanted = render(_looking_at_wall(1.0, 75.0), boxes=(), noise=False)
    c_near, c_far, c_slanted = (
        RgbdReconstructor(poses="given")([f], CAMERA).confidence[0].astype(float) for f in (near, far, slanted)
    )
    middle = (slice(110, 130), slice(150, 170))
    assert c_near[middle].mean() > 0.9
    assert c_far[middle].mean() < 0.5
    assert c_slanted[middle].mean() < 0.7 * c_near[middle].mean()
    result = RgbdReconstructor(poses="given")(frames[:1], CAMERA)
    confidence, depth = result.confidence[0].astype(float), result.depth[0]
    step = np.abs(np.diff(depth, axis=1)) > 0.3
    assert np.all((confidence >= 0) & (confidence <= 1))
    assert confidence[:, 1:][step].mean() < 0.1
    assert backproject(depth, CAMERA).shape == (240, 320, 3)


def _looking_at_wall(distance: float, turn_deg: float) -> np.ndarray:
    """A camera before the wall at z = 3.2, turned about the vertical."""
    T = np.eye(4)
    T[:3, :3] = rotation_exp(np.array([0.0, np.radians(turn_deg), 0.0]))
    T[2, 3] = 3.2 - distance * max(np.cos(np.radians(turn_deg)), 0.3)
    T[0, 3] = -distance * np.sin(np.radians(turn_deg))
    return T


@pytest.mark.slow
@pytest.mark.data
def test_a_second_of_the_kitchen(shared_data: Path) -> None:
    source = open_source(shared_data / "redkitchen", SourceOptions())
    frames = [f for f in source.read(200, 240) if isinstance(f, Frame)]
    assert source.info.camera is not None
    result = RgbdReconstructor()(frames, source.info.camera)
    truth = np.stack([f.T_source_cam for f in frames if f.T_source_cam is not None])
    a, b = result.T_chunk_cam[:, :3, 3], truth[:, :3, 3]
    error = umeyama(a, b, with_scale=False).apply(a) - b
    assert result.posed.all()
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.01
