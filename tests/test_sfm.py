"""Reconstruction from colour alone: truth recovered, what cannot be known said, nothing invented."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.base import BadFrame, Camera, Frame, FrameSource, SourceInfo
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import TrackingError
from list3r.memory.core.geometry import rotation_exp, umeyama
from list3r.reconstruction.mvs.settings import MvsSettings, SweepSettings
from list3r.reconstruction.registry import MODELS, ModelOptions, make_reconstructor
from list3r.reconstruction.sfm.calibration import calibrate
from list3r.reconstruction.sfm.mapping import SparseMap, best_of
from list3r.reconstruction.sfm.reconstructor import SfmReconstructor
from list3r.reconstruction.sfm.settings import CameraCalibrationSettings, CornerSettings, SfmSettings
from list3r.reconstruction.sfm.tracks import follow_corners
from tests.rgbd_scenes import CAMERA, render

FRAMES = 24


def pose(x: float, y: float = 0.0, z: float = -0.4, turn: float = 0.0) -> np.ndarray:
    """A camera looking into the room, turned about the vertical by radians."""
    T = np.eye(4)
    T[:3, :3] = rotation_exp(np.array([0.0, turn, 0.0]))
    T[:3, 3] = x, y, z
    return T


@lru_cache(maxsize=1)
def walk() -> tuple[Frame, ...]:
    """A camera that goes sideways through the room, half a metre."""
    return tuple(
        replace(render(pose(-0.3 + 0.025 * k, 0.04 * np.sin(k / 4), -0.4, 0.004 * k), index=k), depth=None)
        for k in range(FRAMES)
    )


def black(frame: Frame) -> Frame:
    return replace(frame, color=np.zeros_like(frame.color))


def centres(frames: Sequence[Frame]) -> np.ndarray:
    return np.stack([np.asarray(f.T_source_cam)[:3, 3] for f in frames])


class Held(FrameSource):
    """A source whose frames are in memory."""

    def __init__(self, frames: Sequence[Frame], camera: Camera | None) -> None:
        size = frames[0].color.shape[:2]
        self._frames = frames
        self._info = SourceInfo(
            "images", "here", len(frames), 30.0, camera, False, False, "", image_size=(size[0], size[1])
        )

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        return iter(self._frames[start:stop:step])

    def position(self, index: int) -> int:
        return index


QUICK = SfmReconstructor(settings=SfmSettings(dense=MvsSettings(sweep=SweepSettings(width_px=80, coarse_width_px=80))))
"""For tests of poses: depth, which takes four fifths of the time, at a quarter of the width."""


@pytest.fixture(scope="module")
def made():
    return SfmReconstructor()(walk(), CAMERA)


@pytest.mark.slow
def test_poses_are_the_true_ones_but_for_the_scale(made):
    assert made.posed.all() and made.scale_kind == "relative"
    truth, found = centres(walk()), made.T_chunk_cam[:, :3, 3]
    S = umeyama(found, truth, with_scale=True)
    assert np.linalg.norm(S.apply(found) - truth, axis=1).max() < 0.01
    R, Q = np.array([np.asarray(f.T_source_cam)[:3, :3] for f in walk()]), made.T_chunk_cam[:, :3, :3]
    turned = np.swapaxes(R[0].T @ R, 1, 2) @ (Q[0].T @ Q)
    assert np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))).max() < 0.2


def test_the_chunk_begins_at_its_first_camera_and_the_middle_of_its_depths_is_two(made):
    np.testing.assert_allclose(made.T_chunk_cam[0], np.eye(4), atol=1e-9)
    known = made.depth[made.depth > 0]
    assert len(known) and 1.2 < np.median(known) < 3.0


def test_depth_fits_the_poses(made):
    truth = render(pose(-0.3, 0.0, -0.4), noise=False).depth
    S = umeyama(made.T_chunk_cam[:, :3, 3], centres(walk()), with_scale=True)
    known = made.depth[0] > 0
    assert known.mean() > 0.2
    assert np.median(np.abs(made.depth[0][known] * float(S.scale) / truth[known] - 1)) < 0.05


@pytest.mark.slow
def test_the_same_frames_give_the_same_numbers(made):
    once = QUICK(walk(), CAMERA)
    np.testing.assert_array_equal(once.T_chunk_cam, made.T_chunk_cam)
    once, again = (QUICK(walk()[:14], CAMERA) for _ in range(2))
    np.testing.assert_array_equal(once.T_chunk_cam, again.T_chunk_cam)
    np.testing.assert_array_equal(once.depth, again.depth)


@pytest.mark.slow
def test_given_poses_are_kept_and_make_it_metric():
    made = make_reconstructor("sfm", ModelOptions(poses="given", device="cpu"))(walk(), CAMERA)
    assert made.scale_kind == "metric" and made.posed.all()
    np.testing.assert_array_equal(made.T_chunk_cam, np.stack([f.T_source_cam for f in walk()]))
    truth = render(pose(-0.3 + 0.025 * 12, 0.04 * np.sin(3), -0.4, 0.048), noise=False).depth
    known = made.depth[12] > 0
    assert known.mean() > 0.2 and np.median(np.abs(made.depth[12][known] / truth[known] - 1)) < 0.05


def test_black_frames_are_left_out_and_the_rest_keeps_together():
    frames = [black(f) if f.index in (9, 10) else f for f in walk()]
    made = QUICK(frames, CAMERA)
    assert not made.posed[[9, 10]].any() and made.posed.sum() == FRAMES - 2
    posed = made.posed
    S = umeyama(made.T_chunk_cam[posed, :3, 3], centres(walk())[posed], with_scale=True)
    assert np.linalg.norm(S.apply(made.T_chunk_cam[posed, :3, 3]) - centres(walk())[posed], axis=1).max() < 0.015


@pytest.mark.slow
def test_a_jump_to_another_place_parts_the_chunk():
    first, count = walk()[:14], 12
    other = [
        replace(render(pose(0.5 - 0.03 * k, 0.1, -0.2, np.pi), seed=7, index=len(first) + k), depth=None)
        for k in range(count)
    ]
    frames = [*first, *other]
    parts = QUICK.parts(frames, CAMERA)
    assert [p.frame_indices.tolist() for p in parts] == [list(range(14)), list(range(14, 26))]
    assert all(p.posed.mean() > 0.8 for p in parts)
    whole = QUICK(frames, CAMERA)
    assert not whole.posed[len(first) :].any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ([walk()[0]], "at least two frames"),
        ([black(f) for f in walk()[:6]], "no texture"),
        ([replace(walk()[0], index=k) for k in range(8)], "does not move"),
        ([replace(render(pose(0, 0, -0.4, 0.03 * k), index=k), depth=None) for k in range(12)], "only turns"),
    ],
    ids=["one", "black", "still", "turning"],
)
def test_what_gives_no_depth_is_said_in_one_line(frames, said):
    with pytest.raises(TrackingError, match=said) as raised:
        QUICK(frames, CAMERA)
    assert "\n" not in str(raised.value)


def test_corners_do_not_creep():
    grays = [np.asarray(f.color.mean(axis=2), np.uint8) for f in walk()]
    tracks = follow_corners(grays)
    long = np.intersect1d(tracks.ids[0], tracks.ids[8])
    assert len(long) > 100 and (tracks.run == 0).all()
    a, b = (tracks.xy[k][np.isin(tracks.ids[k], long)] for k in (0, 8))
    depth = render(pose(-0.3), noise=False).depth
    column, row = np.rint(a).astype(int).T
    rays = np.concatenate([(a - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy), np.ones((len(a), 1))], axis=1)
    T = np.linalg.inv(np.asarray(walk()[8].T_source_cam)) @ np.asarray(walk()[0].T_source_cam)
    seen = (rays * depth[row, column][:, None]) @ T[:3, :3].T + T[:3, 3]
    at = seen[:, :2] / seen[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    assert np.median(np.linalg.norm(at - b, axis=1)) < 0.3


def test_places_do_not_creep_between_keyframes_though_only_every_third_frame_is_refined():
    rng = np.random.default_rng(3)
    scene = cv2.GaussianBlur(rng.uniform(0, 255, (240, 340)), (0, 0), 4.0)
    scene = (scene - scene.min()) / (scene.max() - scene.min()) * 255
    grays = []
    for k in range(60):  # 12 px in all, less than makes a keyframe
        moved = cv2.warpAffine(scene, np.array([[1.0, 0.0, -0.2 * k], [0.0, 1.0, 0.0]]), (320, 240))
        grays.append(np.clip(moved + rng.normal(0, 15, moved.shape), 0, 255).astype(np.uint8))

    def creep(every: int) -> float:
        tracks = follow_corners(grays, CornerSettings(refined_every=every))
        assert tracks.keyframes == (0, 59)
        off = []
        for k in (56, 57, 58):
            _, a, b = np.intersect1d(tracks.ids[0], tracks.ids[k], return_indices=True)
            assert len(a) > 100
            off.append(np.linalg.norm(tracks.xy[k][b] - tracks.xy[0][a] + (0.2 * k, 0.0), axis=1).mean())
        return max(off)

    assert creep(CornerSettings().refined_every) < 0.5 * creep(1000)


def test_corners_are_followed_on_few_levels_as_on_all_and_a_jerk_is_caught():
    rng = np.random.default_rng(5)
    scene = sum(k * cv2.GaussianBlur(rng.uniform(-1, 1, (300, 660)), (0, 0), k) for k in (1.5, 4.0, 12.0, 30.0))
    scene = (scene - scene.min()) / (scene.max() - scene.min()) * 255
    place = np.cumsum([0.0, *[2.0] * 6, 70.0, *[2.0] * 4])  # px
    grays = [
        np.clip(cv2.warpAffine(scene, np.array([[1.0, 0.0, -x], [0.0, 1.0, -20.0]]), (480, 260)), 0, 255).astype(
            np.uint8
        )
        for x in place
    ]
    few, all_ = (follow_corners(grays, CornerSettings(near_flow=f)) for f in (CornerSettings().near_flow, -1.0))
    for k in range(1, len(grays)):
        _, a, b = np.intersect1d(few.ids[k], all_.ids[k], return_indices=True)
        assert len(a) > 0.95 * len(all_.ids[k]) > 50
        assert np.quantile(np.linalg.norm(few.xy[k][a] - all_.xy[k][b], axis=1), 0.95) < 0.05


@pytest.mark.slow
def test_the_camera_is_found_and_a_wrong_one_is_doubted():
    settings = SfmSettings(calibration=CameraCalibrationSettings(windows=1, frames=FRAMES))
    found = calibrate(Held(walk(), None), settings)
    assert abs(found.camera.fx / CAMERA.fx - 1) < 0.08 and found.windows == 1
    wrong = calibrate(Held(walk(), replace(CAMERA, fx=450.0, fy=450.0)), settings)
    assert wrong.camera.fx == 450.0 and "does not fit the pictures" in wrong.notes[0]
    assert abs(wrong.focal_px / CAMERA.fx - 1) < 0.08


def test_a_camera_that_cannot_be_found_is_a_guess_and_said_to_be():
    found = calibrate(Held([black(f) for f in walk()[:5]], None))
    assert found.windows == 0 and "is a guess" in found.notes[0]


def test_sfm_is_known_by_name_and_needs_neither_depth_nor_camera():
    assert not MODELS["sfm"].needs_depth and not MODELS["sfm"].needs_camera


@pytest.mark.slow
@pytest.mark.data
def test_redkitchen_in_colour(shared_data: Path):
    source = open_source(shared_data / "redkitchen", SourceOptions(start=200, stop=240))
    frames = [replace(f, depth=None) for f in source.read(0, 40) if isinstance(f, Frame)]
    assert source.info.camera is not None
    made = SfmReconstructor()(frames, source.info.camera)
    assert made.posed.sum() >= 39
    S = umeyama(made.T_chunk_cam[made.posed, :3, 3], centres(frames)[made.posed], with_scale=True)
    off = np.linalg.norm(S.apply(made.T_chunk_cam[made.posed, :3, 3]) - centres(frames)[made.posed], axis=1)
    assert np.sqrt((off**2).mean()) < 0.01


def test_of_several_maps_the_one_that_explains_the_pictures_best_is_taken():
    def grown(keyframes: int, error_px: float) -> list[SparseMap]:
        return [SparseMap({k: np.eye(4) for k in range(keyframes)}, {}, CAMERA, 0.0, error_px)]

    straight = grown(20, 0.46)
    assert best_of([grown(20, 0.50), straight, grown(20, 0.49)], 0.95) is straight
    assert best_of([grown(10, 0.30), straight, []], 0.95) is straight, "a small map has little to explain"
    assert best_of([[], []], 0.95) == []
