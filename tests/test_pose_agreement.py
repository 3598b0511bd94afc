"""Poses of another convention than a format states are told apart by the depth that they carry."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera, Frame, SourceInfo
from list3r.frames.options import SourceOptions
from list3r.frames.pose_agreement import CONVENTIONS, disagreements
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, SourceError
from list3r.pipeline.session import check_agreement
from tests import recordings
from tests.recordings import WITH_DEPTH, shots
from tests.rgbd_scenes import CAMERA, frames_along, walk


@pytest.mark.parametrize("kind", WITH_DEPTH)
def test_poses_as_the_format_states_them_fit(kind: str, tmp_path: Path) -> None:
    assert disagreements(open_source(WITH_DEPTH[kind](tmp_path / "walk"))) == ()


class Walk:
    """A source of frames that are there."""

    def __init__(self, frames: list[Frame], camera: Camera = CAMERA) -> None:
        self._frames = frames
        has_depth = frames[0].depth is not None
        self.info = SourceInfo("tum", "walk", len(frames), 30.0, camera, has_depth, True, "")

    def read(self, start: int, stop: int) -> list[Frame]:
        return self._frames[start:stop]


def meant(T: np.ndarray, name: str) -> np.ndarray:
    """The pose that a reader gets of someone who writes in a convention."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    return {"as": T, "with": T @ flip, "inverted": np.linalg.inv(T)}.get(name.split()[0], T)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return frames_along(walk(45)[::5])


@pytest.mark.parametrize("name", list(CONVENTIONS)[:3])
def test_the_convention_that_was_meant_is_named(name: str, frames: list[Frame]) -> None:
    told = [replace(f, T_source_cam=meant(f.T_source_cam, name)) for f in frames if f.T_source_cam is not None]
    found = disagreements(Walk(told))  # type: ignore[arg-type]
    assert found == () if name.startswith("as") else f"would fit {name}:" in found[0]


def test_drift_is_no_other_convention(frames: list[Frame]) -> None:
    drifting = []
    for k, f in enumerate(frames):
        T = np.array(f.T_source_cam)
        T[:3, 3] += 0.01 * k
        drifting.append(replace(f, T_source_cam=T))
    assert disagreements(Walk(drifting)) == ()  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["record3d", "polycam"])
def test_a_recording_whose_cameras_are_turned_twice_is_refused(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    right = recordings.arkit
    monkeypatch.setattr(recordings, "arkit", lambda T: right(T) @ flip)
    path = WITH_DEPTH[kind](tmp_path / "walk")
    with pytest.raises(SourceError, match="flipped"):
        check_agreement(open_source(path))


def test_a_world_with_y_up_is_not_taken_for_one_with_z_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = recordings.arkit
    standing = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    level = np.linalg.inv(shots()[0].T_world_cam)  # filmed level, with z up as OpenCV's -y
    upright = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    turn = np.array([[0.8, 0, 0.6, 0], [0, 1, 0, 0], [-0.6, 0, 0.8, 0], [0, 0, 0, 1]])  # no identity at the start
    monkeypatch.setattr(recordings, "arkit", lambda T: turn @ right(upright @ level @ T))
    assert open_source(recordings.write_record3d(tmp_path / "a")).info.z_up
    monkeypatch.setattr(recordings, "arkit", lambda T: standing @ turn @ right(upright @ level @ T))
    assert not open_source(recordings.write_record3d(tmp_path / "b")).info.z_up


def test_a_camera_of_another_size_is_refused_and_the_fitting_one_named(tmp_path: Path) -> None:
    open_source(recordings.write_nerfstudio(tmp_path / "a"))
    half = recordings.write_nerfstudio(tmp_path / "b", fl_x=70.0, fl_y=70.0, cx=39.5, cy=29.5)
    with pytest.raises(OptionError, match=r"80x60; .* --intrinsics 140,140,79.5,59.5"):
        open_source(half)
    assert open_source(half, SourceOptions(intrinsics=(70.0, 70.0, 39.5, 29.5))).info.camera is not None


@pytest.mark.parametrize("times", [0.2, 1.0, 1.3, 5.0])
def test_depth_in_another_unit_than_its_poses_is_told(times: float, frames: list[Frame]) -> None:
    told = [replace(f, depth=np.float32(times) * f.depth) for f in frames if f.depth is not None]
    found = disagreements(Walk(told))  # type: ignore[arg-type]
    if 0.7 < times < 1.5:
        assert found == ()
    else:
        assert float(re.search(r"fits ([\d.]+) times", found[0])[1]) == pytest.approx(1 / times, rel=0.1)  # type: ignore[index]


def test_disparity_is_told_from_depth(frames: list[Frame]) -> None:
    told = [replace(f, depth=(f.depth > 0) * np.float32(3) / np.maximum(f.depth, 1e-3)) for f in frames]
    assert "disparity" in disagreements(Walk(told))[0]  # type: ignore[arg-type]


@pytest.mark.parametrize("focal", [0.5, 2.0])
def test_a_camera_that_is_not_of_the_recording_is_told(focal: float) -> None:
    frames = frames_along(walk(120)[::8])
    assert disagreements(Walk(frames)) == ()  # type: ignore[arg-type]
    other = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)
    assert disagreements(Walk(frames, other))  # type: ignore[arg-type]


def test_poses_whose_quaternions_are_in_another_order_are_told(frames: list[Frame]) -> None:
    told = []
    for f in frames:
        assert f.T_source_cam is not None
        T = f.T_source_cam.copy()
        T[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)).as_matrix()
        told.append(replace(f, T_source_cam=T))
    assert disagreements(Walk(told))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", list(CONVENTIONS)[:3])
def test_colour_alone_tells_a_convention_by_its_corners(name: str, frames: list[Frame]) -> None:
    told = [
        replace(f, depth=None, T_source_cam=meant(f.T_source_cam, name)) for f in frames if f.T_source_cam is not None
    ]
    found = disagreements(Walk(told))  # type: ignore[arg-type]
    assert found == () if name.startswith("as") else f"would fit {name}:" in found[0]
