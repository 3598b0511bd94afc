"""A folder of pictures becomes a memory: the camera is found once, parts of a chunk are chunks of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import list3r
from list3r.frames.chunking.chunks import ChunkSettings, ChunkSpan
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import TrackingError
from list3r.memory.core.geometry import rotation_exp, umeyama
from list3r.memory.store.store import Store
from list3r.pipeline.build import build
from list3r.pipeline.chunks.calibration import estimated_camera
from list3r.pipeline.chunks.chunk import PART_STEP, ChunkTask, process_parts
from list3r.pipeline.precompute import precompute
from list3r.pipeline.request import RunOptions, Watch
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.workers import OrderedPool
from list3r.reconstruction.precomputed_files import read_piece
from tests.rgbd_scenes import CAMERA, render

COUNT = 26


def pose(k: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = rotation_exp(np.array([0.0, 0.004 * k, 0.0]))
    T[:3, 3] = -0.35 + 0.028 * k, 0.04 * np.sin(k / 4), -0.4
    return T


def save(folder: Path, poses: list[np.ndarray], seeds: list[int] | None = None) -> Path:
    folder.mkdir()
    for k, T in enumerate(poses):
        color = render(T, seed=0 if seeds is None else seeds[k], index=k).color
        cv2.imwrite(str(folder / f"{k:04d}.png"), color[..., ::-1])
    return folder


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("sfm") / "walk", [pose(k) for k in range(COUNT)])


@pytest.mark.slow
def test_pictures_alone_become_a_relative_memory(pictures: Path, tmp_path: Path):
    memory = tmp_path / "walk.l3r"
    settings = BuildSettings(reconstruction="auto", poses="auto", chunks=ChunkSettings(18, 8))
    report = build(pictures, memory, settings=settings, run=RunOptions(workers=2))
    assert report.posed == COUNT and report.components == 1 and report.chunks == 2
    assert any("estimated from the pictures" in line for line in report.notes)
    with Store.open(memory) as store:
        assert store.facts.scale_kind == "relative" and store.facts.scale_source == "none"
        assert store.sessions.all()[0].settings["reconstruction"] == "sfm"
        first, second = store.chunks.all()
        assert first.intrinsics == second.intrinsics and abs(first.intrinsics[0] / CAMERA.fx - 1) < 0.1
        found = np.stack([S.translation for _, S in store.trajectory.poses()])
    truth = np.stack([pose(k)[:3, 3] for k in range(COUNT)])
    S = umeyama(found, truth, with_scale=True)
    assert np.sqrt((np.linalg.norm(S.apply(found) - truth, axis=1) ** 2).mean()) < 0.02
    assert list3r.open(memory) is not None


@pytest.mark.slow
def test_the_camera_is_the_same_wherever_its_windows_are_mapped(pictures: Path) -> None:
    settings = BuildSettings("sfm", "estimate", device="cpu")
    short = replace(settings.models.sfm.calibration, windows=3, frames=13, least_frames=13)
    settings = replace(settings, models=replace(settings.models, sfm=replace(settings.models.sfm, calibration=short)))
    told: list[tuple[str, int, int]] = []
    with OrderedPool(process_parts, 2) as pool:
        there = estimated_camera(
            open_source(pictures), SourceOptions(), settings, lambda *said: told.append(said), pool=pool
        )
    assert told == [("camera", 1, 3), ("camera", 2, 3), ("camera", 3, 3)]
    assert there is not None and there == estimated_camera(open_source(pictures), SourceOptions(), settings)


@pytest.mark.slow
def test_nothing_is_left_of_a_video_that_cannot_be_followed(tmp_path: Path):
    folder = save(tmp_path / "still", [pose(0)] * 5)
    with pytest.raises(TrackingError, match="does not move"):
        build(folder, tmp_path / "still.l3r", settings=BuildSettings("auto", "auto"), run=RunOptions(workers=1))


@pytest.mark.slow
def test_parts_of_a_chunk_are_numbered_so_that_the_last_closes_the_span(tmp_path: Path):
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    there = [pose(k) @ away for k in range(14)]
    folder = save(tmp_path / "jump", [pose(k) for k in range(14)] + there, [0] * 14 + [7] * 14)
    camera = replace(CAMERA)
    options = SourceOptions(intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy), distortion=())
    task = ChunkTask(str(folder), options, ChunkSpan(3, 0, 28), BuildSettings("sfm", "estimate", device="cpu"))
    first, last = process_parts(task)
    assert (first.index, last.index) == (3 + PART_STEP, 3)
    assert first.frame_indices[-1] < last.frame_indices[0] and first.posed.all() and last.posed.all()


@pytest.mark.slow
def test_files_for_another_machine_have_one_estimated_camera_and_say_it(pictures: Path, tmp_path: Path) -> None:
    settings = BuildSettings(reconstruction="sfm", chunks=ChunkSettings(18, 8))
    told: list[str] = []
    report = precompute(
        pictures,
        tmp_path / "files",
        settings=settings,
        watch=Watch(look=lambda what, done, total: told.append(what)),
    )
    assert report.posed == COUNT and {"cuts", "camera"} <= set(told)
    cameras = np.concatenate([read_piece(p).intrinsics for p in sorted((tmp_path / "files").glob("*.npz"))])
    assert report.files == 2 and (cameras == cameras[0]).all() and abs(cameras[0, 0] / CAMERA.fx - 1) < 0.1
    assert any("give the build the same: --intrinsics" in line for line in report.notes)
    assert all(read_piece(p).depth_noise is not None for p in (tmp_path / "files").glob("*.npz"))


@pytest.mark.slow
def test_files_hold_frames_of_a_chunk_that_stands_still(tmp_path: Path) -> None:
    folder = save(tmp_path / "stops", [pose(k) for k in range(18)] + [pose(17)] * 12)
    options = SourceOptions(intrinsics=(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy), distortion=())
    settings = BuildSettings(reconstruction="sfm", chunks=ChunkSettings(18, 2), device="cpu")
    task = ChunkTask(str(folder), options, ChunkSpan(1, 16, 30), settings, shot=(0, 30))
    assert process_parts(task)[-1].posed.all()
    report = precompute(folder, tmp_path / "files", options=options, settings=settings)
    still = read_piece(tmp_path / "files" / "chunk-0001.npz")
    assert report.files == 2 and report.posed == 30 and still.frames.tolist() == list(range(16, 30))
    assert np.allclose(still.T_world_cam[1:], still.T_world_cam[1], atol=0.01)
