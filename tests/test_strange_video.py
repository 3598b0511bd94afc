"""Video as people film it: they stop and tremble, turn on the spot, walk up to a wall."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.frames.base import BadFrame, Frame, SourceInfo
from list3r.frames.chunking.borrowing import borrow
from list3r.frames.chunking.chunks import ChunkSpan
from list3r.frames.source import SourceOptions
from list3r.memory.core.geometry import rotation_exp, umeyama
from list3r.pipeline.chunks.chunk import ChunkTask, process_parts
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.sfm.calibration import _longest_run, _spans
from list3r.reconstruction.sfm.settings import CameraCalibrationSettings
from list3r.reconstruction.sfm.tracks import follow_corners
from tests.rgbd_scenes import render

STOP = range(12, 36)
"""Frames of the walk that stand and tremble."""
COUNT = 48


def pose(k: int) -> np.ndarray:
    """A walk of 12 steps, a stop with a trembling hand (0.3 degrees), 12 steps more."""
    step = min(k, STOP.start) + max(0, k - STOP.stop + 1)
    turn = np.array([0.0, 0.004 * step, 0.0])
    if k in STOP:
        turn = turn + np.deg2rad(0.3) * np.array([np.sin(1.9 * k), np.cos(1.3 * k), 0.0])
    T = np.eye(4)
    T[:3, :3] = rotation_exp(turn)
    T[:3, 3] = -0.35 + 0.028 * step, 0.04 * np.sin(step / 4), -0.4
    return T


@lru_cache(maxsize=64)
def picture(k: int) -> np.ndarray:
    color = cv2.resize(render(pose(k), index=0).color, (160, 120), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(k).normal(0, 1.5, color.shape)
    return np.clip(color + noise, 0, 255).astype(np.uint8)


OPTIONS = SourceOptions(intrinsics=(131.0, 131.0, 79.5, 59.5), distortion=())


class Pictures:
    """A source in memory."""

    def __init__(self, colors: list[np.ndarray]) -> None:
        self.colors = colors
        size = colors[0].shape[:2]
        self.info = SourceInfo("images", "here", len(colors), 30.0, None, False, False, "", size)

    def read(self, start: int, stop: int) -> Iterator[Frame | BadFrame]:
        for n in range(len(self.colors))[start:stop]:
            yield Frame(n, n / 30, self.colors[n], None, None)

    def position(self, index: int) -> int:
        return index


@pytest.mark.slow
def test_a_chunk_of_a_hand_that_trembles_takes_its_poses_from_frames_around_it(tmp_path: Path) -> None:
    for k in range(COUNT):
        cv2.imwrite(str(tmp_path / f"{k:04d}.png"), picture(k)[..., ::-1])
    span = ChunkSpan(1, STOP.start + 2, STOP.stop)
    settings = BuildSettings("sfm", "estimate", device="cpu")
    (made,) = process_parts(ChunkTask(str(tmp_path), OPTIONS, span, settings, shot=(0, COUNT)))
    place = {int(i): n for n, i in enumerate(made.frame_indices)}
    assert made.posed[[place[k] for k in range(span.start, span.stop)]].all()
    posed = np.flatnonzero(made.posed)
    truth = np.stack([pose(int(made.frame_indices[n]))[:3, 3] for n in posed])
    assert np.ptp(truth[:, 0]) > 0.2  # what is shared with the neighbours has a length
    S = umeyama(made.T_chunk_cam[posed, :3, 3], truth, with_scale=True)
    assert np.linalg.norm(S.apply(made.T_chunk_cam[posed, :3, 3]) - truth, axis=1).max() < 0.03


def test_what_is_followed_through_a_stop_is_told_from_a_wall() -> None:
    wall = [np.full((120, 160, 3), 190, np.uint8)] * 20
    source = Pictures([picture(k) for k in range(STOP.stop)] + wall)
    stop = borrow(source, (14, STOP.stop), (0, 56), list(source.read(14, STOP.stop)))
    assert stop.followed == STOP.stop - 14 and len(stop.repeats) < stop.followed / 2
    assert borrow(source, (STOP.stop, 56), (0, 56), list(source.read(STOP.stop, 56))).followed == 0


def test_of_a_short_video_some_window_is_half_without_any_third_of_it() -> None:
    for count in range(120, 500, 7):
        spans = _spans(count, CameraCalibrationSettings())
        assert spans[0][0] == 0 and spans[-1][1] == count
        for first in range(0, count - count // 3, 5):
            behind = first + count // 3
            assert any(2 * max(first - a, b - behind) >= b - a - 2 for a, b in spans), (count, first)
    assert _spans(40, CameraCalibrationSettings()) == [(0, 40)]
    assert _spans(300, CameraCalibrationSettings()) == [(0, 100), (100, 200), (200, 300)]
    assert [a for a, _ in _spans(1000, CameraCalibrationSettings())] == [0, 225, 450, 675, 900]


def test_a_window_that_jumps_is_its_longer_part() -> None:
    grays = [cv2.cvtColor(picture(k), cv2.COLOR_RGB2GRAY) for k in range(12)]
    jumped = follow_corners([*grays, *(np.rot90(g, 2).copy() for g in grays[:6])])
    assert len(np.unique(jumped.run)) == 2 and max(jumped.keyframes) == 17
    assert 0 < max(_longest_run(jumped).keyframes) < 12
