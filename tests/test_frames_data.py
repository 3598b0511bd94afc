"""The real sequences: what is recognised, and that depth edges meet colour edges."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from list3r.frames.base import Frame
from list3r.frames.registration.calibrate import DepthCalibrationSettings, calibrate
from list3r.frames.source import SourceOptions, open_source, require_camera

pytestmark = pytest.mark.data
FEW = DepthCalibrationSettings(frames=10, candidates=3)


def test_redkitchen_is_recognised(shared_data: Path) -> None:
    source = open_source(shared_data / "redkitchen")
    assert source.info.kind == "7scenes" and source.info.frame_count == 1000 and source.info.has_poses
    frame = next(iter(source.read(400, 401)))
    assert isinstance(frame, Frame) and frame.depth is not None and frame.index == 400
    assert 0.5 < (frame.depth > 0).mean() < 0.9 and frame.depth.max() < 10


@pytest.mark.slow
@pytest.mark.parametrize("focal", [525.0, 585.0])
def test_redkitchen_calibrates_from_a_wrong_start(shared_data: Path, focal: float) -> None:
    """From 0 offset and the given focal length; known from the page of the data: 524 px, (-0.023, -0.008) m."""
    options = SourceOptions(intrinsics=(focal, focal, 320, 240), T_color_depth=np.eye(4))  # type: ignore[arg-type]
    found = calibrate(shared_data / "redkitchen", options, FEW)
    assert found.status == "estimated", found.reason
    assert found.intrinsics[0] == pytest.approx(524.0, abs=4.0)
    np.testing.assert_allclose(found.T_color_depth[:3, 3], [-0.023, -0.008, 0], atol=0.005)
    known = calibrate_score(shared_data / "redkitchen")
    assert found.score > 1.3 * found.score_assumed and known > 0.95 * found.score


@cache
def calibrate_score(path: Path) -> float:
    """How well edges meet with the constants that the layout knows."""
    return calibrate(path, SourceOptions(), FEW).score_assumed


def test_cabinet_is_registered(shared_data: Path) -> None:
    source = open_source(shared_data / "cabinet")
    assert (source.info.kind, source.info.frame_count, source.info.has_poses) == ("tum", 58, True)
    assert require_camera(source.info).fx == 525.0 and any("assumed" in note for note in source.info.notes)
    assert calibrate(shared_data / "cabinet", SourceOptions(), FEW).status == "registered"


def test_bedroom_is_a_video_without_depth(shared_data: Path) -> None:
    source = open_source(shared_data / "bedroom" / "bedroom.mp4")
    assert source.info.frame_count == 200 and not source.info.has_depth
    late = next(iter(source.read(150, 151)))
    assert isinstance(late, Frame) and late.color.shape == (540, 960, 3) and late.time_s == pytest.approx(5.0)
