"""A simulated walk on disk: the TUM layout, read back by the project's own reader."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.evaluation.scene import evaluate_scene, read_scene
from list3r.evaluation.trajectory import read_tum
from list3r.frames.base import Frame
from list3r.frames.source import open_source
from list3r.memory.core.errors import ExportError, OptionError
from list3r.simulation.dataset import WalkSettings, write_walk

SETTINGS = WalkSettings(seed=2, frames=26, start=40, size=(160, 120), write_ids=True)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk"), SETTINGS)


def test_the_reader_finds_what_was_written(walk: Path) -> None:
    source = open_source(walk)
    assert (source.info.kind, source.info.frame_count, source.info.has_depth) == ("tum", 26, True)
    assert source.info.camera == SETTINGS.camera()
    frames = [f for f in source.read(0, 26) if isinstance(f, Frame)]
    _, poses = SETTINGS.poses()
    assert len(frames) == 26
    for frame, pose in zip(frames, poses, strict=True):
        assert frame.T_source_cam is not None
        assert np.allclose(frame.T_source_cam, pose, atol=1e-5)
        assert frame.depth is not None
        assert (frame.depth > 0).mean() > 0.85


def test_points_of_all_frames_agree_on_the_things(walk: Path) -> None:
    world = SETTINGS.world()
    camera = SETTINGS.camera()
    table = next(t for t in world.objects if t.label == "table").box()
    distances = []
    for k, frame in enumerate(open_source(walk).read(0, 26)):
        assert isinstance(frame, Frame) and frame.depth is not None and frame.T_source_cam is not None
        ids = cv2.imread(str(walk / "ids" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        v, u = np.nonzero((ids == next(t.id for t in world.objects if t.label == "table")) & (frame.depth > 0))
        z = frame.depth[v, u]
        local = np.stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z], axis=1)
        points = local @ frame.T_source_cam[:3, :3].T + frame.T_source_cam[:3, 3]
        distances.append(np.max(np.abs((points - table.center) @ table.rotation) - table.size / 2, axis=1))
    assert np.concatenate(distances).size > 5000
    assert np.quantile(np.concatenate(distances), 0.95) < 0.03


@pytest.mark.slow
def test_processes_do_not_change_a_byte(walk: Path, tmp_path: Path) -> None:
    again = write_walk(tmp_path / "again", SETTINGS, workers=2)
    names = sorted(p.relative_to(walk) for p in walk.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    assert all((walk / n).read_bytes() == (again / n).read_bytes() for n in names)


def test_the_truth_is_perfect_against_itself(walk: Path) -> None:
    truth = read_scene(walk / "truth.json")
    result = evaluate_scene(truth, truth, min_px=20)
    assert result["instances_0.50"]["recall"] == 1.0
    assert result["instances_0.25"]["duplicates"] == 0
    assert result["instances_0.25"]["merged_pairs"] == 0
    assert result["relations"]["total"]["precision"] == 1.0
    assert result["relations"]["total"]["recall"] == 1.0


def test_areas_in_the_truth_are_those_of_the_id_pictures(walk: Path) -> None:
    counts = np.array(
        [
            np.bincount(cv2.imread(str(p), cv2.IMREAD_UNCHANGED).ravel(), minlength=200)
            for p in sorted((walk / "ids").iterdir())
        ]
    )
    for entry in json.loads((walk / "truth.json").read_text())["instances"]:
        assert entry["largest_px"] == counts[:, entry["id"]].max()
        assert entry["frames_seen"] == np.count_nonzero(counts[:, entry["id"]])


def test_poses_are_written_as_the_camera_went(walk: Path) -> None:
    trajectory = read_tum(walk / "groundtruth.txt")
    time_s, poses = SETTINGS.poses()
    assert np.allclose(trajectory.time_s, time_s, atol=1e-6)
    assert np.allclose(trajectory.T_world_cam, poses, atol=1e-6)


def test_a_folder_that_holds_a_walk_is_left_alone(walk: Path) -> None:
    with pytest.raises(OptionError, match="already holds"):
        write_walk(walk, SETTINGS)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="file"):
        write_walk(tmp_path / "file" / "walk", SETTINGS)


@pytest.mark.parametrize(
    "wrong", [{"frames": 1}, {"size": (10, 240)}, {"size": (320, 9000)}, {"start": -1}, {"start": 9999}]
)
def test_settings_that_make_no_sense_are_named(wrong: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        WalkSettings(**wrong).poses()  # type: ignore[arg-type]
