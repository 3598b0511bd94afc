"""What recorders and converters are known to get wrong, set in recordings of the tests: read rightly, or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.cli.measure.inputs import read_trajectory
from list3r.frames.base import Frame, FrameSource
from list3r.frames.convert import convert
from list3r.frames.live.stream import open_camera
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, SourceError
from tests import recordings
from tests.recordings import COUNT, DEPTH_HEIGHT, DEPTH_WIDTH, HEIGHT, WIDTH, K, off_plane, plane_depth, png, put

FOCAL = [K[0] * (1 + 0.02 * k) for k in range(COUNT)]
"""Of each frame, px: a lens that breathes as it focuses."""


def notes(source: FrameSource) -> str:
    return "; ".join(source.info.notes)


def off_mm(source: FrameSource) -> float:
    """Return how far depth, back-projected through its pose, lies off the wall: the median of the worst frame."""
    camera, worst = source.info.camera, 0.0
    assert camera is not None
    for frame in source.read(0, source.info.frame_count):
        assert isinstance(frame, Frame) and frame.depth is not None and frame.T_source_cam is not None, frame
        v, u = np.nonzero(frame.depth)
        z = frame.depth[v, u].astype(np.float64)
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(z))], 1)
        T = frame.T_source_cam
        off = off_plane(z[:, None] * rays @ T[:3, :3].T + T[:3, 3])
        worst = max(worst, 1000 * float(np.median(off)))
    return worst


def each(folder: Path, pattern: str, change: Callable[[int, str], str]) -> None:
    """Rewrite text files, in the order of their names, by number."""
    for number, path in enumerate(sorted(folder.glob(pattern))):
        path.write_text(change(number, path.read_text()))


def breathing_record3d(root: Path) -> Path:
    return recordings.write_record3d(root, perFrameIntrinsicCoeffs=[[f, f, K[2], K[3]] for f in FOCAL])


def breathing_nerfstudio(root: Path) -> Path:
    table = json.loads((recordings.write_nerfstudio(root) / "transforms.json").read_text())
    for frame, focal in zip(table["frames"], FOCAL, strict=True):
        frame |= {"fl_x": focal, "fl_y": focal}
    put(root / "transforms.json", json.dumps(table))
    return root


def breathing_polycam(root: Path) -> Path:
    recordings.write_polycam(root)
    each(
        root / "keyframes/cameras",
        "*.json",
        lambda k, text: json.dumps(json.loads(text) | {"fx": FOCAL[k], "fy": FOCAL[k]}),
    )
    return root


def breathing_arkitscenes(root: Path) -> Path:
    recordings.write_arkitscenes(root)
    x, y = DEPTH_WIDTH / WIDTH, DEPTH_HEIGHT / HEIGHT
    centre = f"{(K[2] + 0.5) * x - 0.5} {(K[3] + 0.5) * y - 0.5}"
    size = f"{DEPTH_WIDTH} {DEPTH_HEIGHT}"
    each(root / "lowres_wide_intrinsics", "*.pincam", lambda k, _: f"{size} {FOCAL[k] * x} {FOCAL[k] * y} {centre}")
    return root


BREATHING = {
    "record3d": breathing_record3d,
    "nerfstudio": breathing_nerfstudio,
    "polycam": breathing_polycam,
    "arkitscenes": breathing_arkitscenes,
}


@pytest.mark.parametrize("kind", BREATHING)
def test_frames_with_cameras_of_their_own_agree_to_two_millimetres(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = recordings.shots()
    own = [
        replace(shot, depth=plane_depth(shot.T_world_cam, (f, f, *K[2:]), (DEPTH_HEIGHT, DEPTH_WIDTH)))
        for shot, f in zip(plain, FOCAL, strict=True)
    ]
    monkeypatch.setattr(recordings, "shots", lambda: own)
    source = open_source(BREATHING[kind](tmp_path / "walk"))
    coarse = kind == "arkitscenes"  # depth moves by half a pixel at most, and its pictures have 64 of them here
    assert off_mm(source) < (6.0 if coarse else 2.0) and "resampled to one camera" in notes(source)


def test_a_camera_written_by_rows_or_by_columns_is_the_same(tmp_path: Path) -> None:
    rows = [K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1]
    phone = open_source(recordings.write_record3d(tmp_path / "a", K=rows))
    assert off_mm(phone) < 2.0 and "row by row" in notes(phone)
    folder = recordings.write_stray(tmp_path / "b")
    put(folder / "camera_matrix.csv", f"{K[0]}, 0, 0\n0, {K[1]}, 0\n{K[2]}, {K[3]}, 1\n")
    stray = open_source(folder)
    assert off_mm(stray) < 2.0 and "column by column" in notes(stray)


def test_poses_written_by_columns_are_read_and_those_that_are_none_refused(tmp_path: Path) -> None:
    root = recordings.write_nerfstudio(tmp_path / "walk")
    table = json.loads((root / "transforms.json").read_text())
    for frame in table["frames"]:
        frame["transform_matrix"] = np.array(frame["transform_matrix"]).T.tolist()
    put(root / "transforms.json", json.dumps(table))
    source = open_source(root)
    assert off_mm(source) < 2.0 and "column by column" in notes(source)
    for frame in table["frames"]:
        frame["transform_matrix"] = np.full((4, 4), np.nan).tolist()
    put(root / "transforms.json", json.dumps(table))
    with pytest.raises(SourceError, match="no frame is a rigid motion"):
        open_source(root)


def test_depth_of_fractions_is_in_metres_or_in_the_unit_of_the_layout(tmp_path: Path) -> None:
    for unit in (1.0, 1000.0):
        root = recordings.write_nerfstudio(tmp_path / f"{unit}")
        table = json.loads((root / "transforms.json").read_text())
        for shot, frame in zip(recordings.shots(), table["frames"], strict=True):
            frame["depth_file_path"] = frame["depth_file_path"].replace(".png", ".npy")
            np.save(root / frame["depth_file_path"], unit * shot.depth)
        put(root / "transforms.json", json.dumps(table))
        assert off_mm(open_source(root)) < 2.0


def test_a_mask_of_another_shape_hides_nothing_without_a_word(tmp_path: Path) -> None:
    root = recordings.write_nerfstudio(tmp_path / "walk")
    table = json.loads((root / "transforms.json").read_text())
    for frame in table["frames"]:
        frame["mask_path"] = "mask.png"
    put(root / "transforms.json", json.dumps(table))
    put(root / "mask.png", png(np.full((HEIGHT, HEIGHT), 255, np.uint8)))
    bad = list(open_source(root).read(0, COUNT))
    assert all(not isinstance(frame, Frame) and "unlike its picture" in frame.reason for frame in bad)


def test_poses_in_splits_are_not_lost_without_a_word(tmp_path: Path) -> None:
    root = recordings.write_nerfstudio(tmp_path / "walk")
    (root / "transforms.json").rename(root / "transforms_train.json")
    with pytest.raises(SourceError, match=r"transforms_train.json; put their frames into one"):
        open_source(root)


@pytest.mark.parametrize(
    ("missing", "told"),
    [
        ("odometry.csv", "there is no odometry.csv"),
        ("depth/000001.png", "1 of 4 frames have no depth image"),
        ("rgb.mp4", "without its rgb.mp4"),
        ("camera_matrix.csv", "camera_matrix.csv is missing"),
    ],
)
def test_what_a_recording_of_stray_scanner_lacks_is_named(missing: str, told: str, tmp_path: Path) -> None:
    root = recordings.write_stray(tmp_path / "walk")
    (root / missing).unlink()
    if missing in ("rgb.mp4", "camera_matrix.csv"):
        with pytest.raises(SourceError, match=told):
            open_source(root)
    else:
        assert told in notes(open_source(root))


def test_odometry_without_a_heading_loses_no_row(tmp_path: Path) -> None:
    root = recordings.write_stray(tmp_path / "walk")
    path = root / "odometry.csv"
    path.write_text(path.read_text().split("\n", 1)[1])
    assert len(open_source(root).read_poses()) == COUNT  # type: ignore[attr-defined]


def test_frames_without_a_pose_or_a_picture_are_counted(tmp_path: Path) -> None:
    poses = [[0, 0, 0, 1, 0.1 * k, 0, 0] for k in range(COUNT)]
    poses[1] = [float("nan")] * 7
    source = open_source(recordings.write_record3d(tmp_path / "a", poses=poses))
    assert f"1 of {COUNT} frames have no pose" in notes(source)
    none = open_source(recordings.write_record3d(tmp_path / "b", poses=[[float("nan")] * 7] * COUNT))
    assert not none.info.has_poses and "no frame states a pose" in notes(none)
    root = recordings.write_polycam(tmp_path / "c")
    each(
        root / "keyframes/cameras",
        "*.json",
        lambda k, text: json.dumps(json.loads(text) | ({"t_00": float("nan")} if k == 2 else {})),
    )
    assert f"1 of {COUNT} frames have no pose" in notes(open_source(root))


def test_other_models_of_colmap_are_named(tmp_path: Path) -> None:
    root = recordings.write_colmap(tmp_path / "walk")
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        put(root / "sparse/1" / name, (root / "sparse/0" / name).read_text())
    assert "not read: the models 1 beside it" in notes(open_source(root))


def test_an_empty_file_is_said_to_be_empty(tmp_path: Path) -> None:
    put(tmp_path / "walk.r3d", b"")
    with pytest.raises(SourceError, match="empty"):
        open_source(tmp_path / "walk.r3d")


def test_the_path_of_a_recording_can_be_measured(tmp_path: Path) -> None:
    for path in (recordings.write_record3d(tmp_path / "a"), recordings.write_stray(tmp_path / "b")):
        assert len(read_trajectory(path).time_s) == COUNT


def test_odometry_drifts_by_its_definition(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    assert open_source(recordings.write_bag(tmp_path / "a", odometry=True)).info.poses_drift
    assert not open_source(recordings.write_bag(tmp_path / "b")).info.poses_drift


def test_poses_that_contradict_their_depth_are_converted_with_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = recordings.arkit
    monkeypatch.setattr(recordings, "arkit", lambda T: np.linalg.inv(right(T)))
    report = convert(recordings.write_polycam(tmp_path / "walk"), "tum", tmp_path / "out")
    assert any("do not fit" in note for note in report.notes)


def test_a_webcam_that_is_not_there_is_not_waited_for() -> None:
    with pytest.raises(OptionError, match="no webcam /dev/video97"):
        open_camera("/dev/video97", print)
