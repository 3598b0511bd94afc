"""The colour camera is found again from painted scenes with known truth, and doubt is said."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame, FrameSource, SourceInfo
from list3r.frames.inspection import SourceReport
from list3r.frames.registration.calibrate import DepthCalibrationSettings, calibrate
from list3r.frames.registration.edge_look import depth_doubts
from list3r.frames.registration.edges import depth_edges
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import SourceError
from tests.frames_scenes import cards, moved, paint, write_png
from tests.rgbd_scenes import CAMERA, frames_along, walk

DEPTH = Camera(320, 240, 290.0, 290.0, 160.0, 120.0)
COLOR = Camera(320, 240, 262.0, 262.0, 160.0, 120.0)
START = SourceOptions(depth_scale=1000.0, intrinsics=(290.0, 290.0, 160.0, 120.0))


def write_pair(root: Path, color: Camera, offset: np.ndarray, k1: float = 0.0, frames: int = 12) -> Path:
    """A folder `color`, `depth` of painted cards; the colour lens bends by k1."""
    x, y = np.meshgrid(np.arange(color.width), np.arange(color.height))
    bent = np.stack([x, y], axis=-1).astype(np.float64).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(bent, color.matrix(), np.array([k1, 0, 0, 0, 0.0]), P=color.matrix())
    u, v = straight.reshape(color.height, color.width, 2).astype(np.float32).transpose(2, 0, 1)
    for k in range(frames):
        gray, _ = paint(cards(k), color, offset)
        _, depth = paint(cards(k), DEPTH, np.eye(4))
        lens = cv2.remap(gray, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        noisy = lens.astype(np.float64) + np.random.default_rng(k).normal(0, 3, lens.shape)
        write_png(root / f"color/{k}.png", np.clip(noisy, 0, 255).astype(np.uint8))
        write_png(root / f"depth/{k}.png", np.rint(depth * 1000).astype(np.uint16))
    return root


@pytest.mark.slow
def test_a_known_camera_is_found_from_a_wrong_start(tmp_path: Path) -> None:
    root = write_pair(tmp_path, COLOR, moved(-0.025, -0.006), k1=-0.06)
    found = calibrate(root, START, DepthCalibrationSettings(frames=12, candidates=1))
    assert found.status == "estimated", found.reason
    assert found.intrinsics[0] == pytest.approx(262.0, rel=0.006)
    np.testing.assert_allclose(found.T_color_depth[:3, 3], [-0.025, -0.006, 0], atol=0.003)
    assert found.distortion and found.distortion[0] == pytest.approx(-0.06, abs=0.04)
    assert found.score > 1.5 * found.score_assumed and found.std["f"] < 3.0
    assert "--depth-to-color" in found.command_line()
    opened = open_source(root, found.options(START))
    report = SourceReport(opened.info, found)
    assert any("--depth-to-color" in line for line in report.lines())
    json.dumps(report.as_dict(), allow_nan=False)
    assert opened.info.depth_camera is not None
    again = calibrate(root, START, DepthCalibrationSettings(frames=12, candidates=1))
    assert again.as_dict() == found.as_dict()


def test_depth_that_lies_on_the_colour_is_called_registered(tmp_path: Path) -> None:
    root = write_pair(tmp_path, DEPTH, np.eye(4))
    found = calibrate(root, START, DepthCalibrationSettings(frames=12, candidates=1))
    assert found.status == "registered" and found.moved_px < 1.0
    assert found.options(START).registered and found.command_line() == ""


def test_pictures_that_do_not_belong_to_the_depth_determine_nothing(tmp_path: Path) -> None:
    root = write_pair(tmp_path, COLOR, np.eye(4))
    for k in range(12):
        noise = np.random.default_rng(k).integers(0, 255, (240, 320), dtype=np.uint8)
        write_png(root / f"color/{k}.png", noise)
    found = calibrate(root, START, DepthCalibrationSettings(frames=12, candidates=1))
    assert found.status == "undetermined" and found.options(START) == START


def test_a_flat_wall_determines_nothing(tmp_path: Path) -> None:
    for k in range(5):
        write_png(tmp_path / f"color/{k}.png", paint(cards(k), COLOR, np.eye(4))[0])
        write_png(tmp_path / f"depth/{k}.png", np.full((240, 320), 2000, np.uint16))
    found = calibrate(tmp_path, START)
    assert found.status == "undetermined" and "too few" in found.reason


def test_a_source_without_depth_is_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", paint(cards(0), COLOR, np.eye(4))[0])
    with pytest.raises(SourceError, match="no depth"):
        calibrate(tmp_path, SourceOptions(intrinsics=(262, 262, 160, 120)))


def test_depth_edges_are_the_near_side_even_across_a_shadow() -> None:
    depth = np.full((40, 60), 2.0, np.float32)
    depth[10:30, 20:40] = 1.0
    depth[10:30, 15:20] = 0.0
    edges = depth_edges(depth)
    assert np.all(edges.z == 1.0)
    outline = set(zip(edges.x.tolist(), edges.y.tolist(), strict=True))
    border = {(x, y) for x in range(20, 40) for y in range(10, 30) if x in (20, 39) or y in (10, 29)}
    assert outline == border
    assert set(edges.x[edges.horizontal].tolist()) == {20, 39}


class Apart(FrameSource):
    """A walk whose depth is that of other frames, or turned."""

    def __init__(self, lag: int, turn: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> None:
        self._frames, self._lag, self._turn = sound_walk(), lag, turn
        self._info = SourceInfo("video", "walk", len(self._frames), 30.0, CAMERA, True, False, "")

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame]:
        for k in range(len(self._frames))[start:stop:step]:
            other = self._frames[min(max(k - self._lag, 0), len(self._frames) - 1)]
            assert other.depth is not None
            yield replace(self._frames[k], depth=np.ascontiguousarray(self._turn(other.depth)))

    def position(self, index: int) -> int:
        return index


@cache
def sound_walk() -> list[Frame]:
    return frames_along(walk(60, speed=3.0))


def test_depth_that_is_late_or_mirrored_is_noticed_and_sound_depth_is_not() -> None:
    assert depth_doubts(Apart(0, lambda z: z)) == ()
    (late,) = depth_doubts(Apart(15, lambda z: z))
    assert "would fit pictures about 0.5 s earlier" in late
    (mirrored,) = depth_doubts(Apart(0, lambda z: z[:, ::-1]))
    assert "would fit if it were mirrored" in mirrored
    assert depth_doubts(Apart(0, lambda z: np.full_like(z, 2.0))) == ()  # a wall shows no steps
