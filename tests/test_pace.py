"""Depth of every n-th frame of a slow video: n follows from the picture, every frame keeps its pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from list3r.cli.app import run
from list3r.frames.base import BadFrame, Frame, SourceInfo
from list3r.frames.chunking.chunks import ChunkSettings, ChunkSpan
from list3r.frames.chunking.pace import PaceSettings, depth_step, picture_flows
from list3r.frames.source import SourceOptions
from list3r.memory.core.geometry import umeyama
from list3r.memory.store.store import Store
from list3r.pipeline.chunks.chunk import ChunkTask, process_parts
from list3r.pipeline.session import _pace
from list3r.pipeline.settings import BuildSettings
from tests.rgbd_scenes import CAMERA, render
from tests.test_sfm_build import pose

SMALL = CAMERA.shrunk(160)
OPTIONS = SourceOptions(intrinsics=(SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy), distortion=())


@dataclass
class Sliding:
    """Frames of a picture that slides by so many px a frame; black ones before `dark`."""

    step_px: float
    count: int = 1000
    dark: int = 0
    size: tuple[int, int] = (240, 320)

    @property
    def info(self) -> SourceInfo:
        words = ("images", "sliding", self.count, 30.0, None, False, False, "")
        return SourceInfo(*words, image_size=self.size)  # type: ignore[arg-type]

    def read(self, start: int, stop: int) -> Iterator[Frame | BadFrame]:
        rng = np.random.default_rng(101)
        wide = cv2.GaussianBlur(rng.integers(0, 256, (240, 640)).astype(np.uint8), (0, 0), 2.0)
        wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX)
        for k in range(start, min(stop, self.count)):
            shift = np.array([[1.0, 0.0, -(k % 20) * self.step_px], [0.0, 1.0, 0.0]])
            gray = cv2.warpAffine(wide, shift, (320, 240), flags=cv2.INTER_CUBIC)
            gray = np.zeros_like(gray) if k < self.dark else gray
            yield Frame(k, k / 30, np.repeat(gray[..., None], 3, axis=2), None, None)


@pytest.mark.parametrize("step_px", [0.5, 2.5, 9.0])
def test_the_flow_of_a_sliding_picture_is_how_far_it_slides(step_px: float) -> None:
    flows = picture_flows(Sliding(step_px), PaceSettings(spots=6))  # type: ignore[arg-type]
    assert np.median(flows) == pytest.approx(step_px / 320, rel=0.05)


@pytest.mark.parametrize(("step_px", "expected"), [(0.5, 4), (3.0, 3), (4.5, 2), (9.0, 1), (13.0, 1)])
def test_the_slower_the_picture_the_fewer_frames_get_depth(step_px: float, expected: int) -> None:
    assert depth_step(Sliding(step_px), 100) == expected  # type: ignore[arg-type]


def test_a_short_video_a_dark_one_and_large_pictures_keep_more_frames() -> None:
    assert depth_step(Sliding(0.5, count=199), 100) == 1  # type: ignore[arg-type]
    assert depth_step(Sliding(0.5, count=210), 100) == 2  # type: ignore[arg-type]
    assert depth_step(Sliding(0.5, dark=900), 100) == 1  # type: ignore[arg-type]
    large = Sliding(0.5, size=(1080, 1920))
    assert depth_step(large, 100) == 1 and depth_step(large, 30) == 2  # type: ignore[arg-type]


@pytest.mark.parametrize("fps", [2.0, 30.0])
def test_the_rate_of_frames_changes_nothing(fps: float) -> None:
    job = SimpleNamespace(settings=BuildSettings("rgbd", "estimate"), info=SimpleNamespace(fps=fps))
    assert _pace(job).most == 2  # type: ignore[arg-type]


def test_progress_is_told_of_every_place_that_is_looked_at() -> None:
    told: list[tuple[int, int]] = []
    depth_step(Sliding(0.5), 100, progress=lambda done, total: told.append((done, total)))  # type: ignore[arg-type]
    assert told == [(k, 16) for k in range(1, 17)]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pace") / "walk"
    folder.mkdir()
    for k in range(30):
        small = cv2.resize(render(pose(k), index=k).color, (160, 120), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"{k:04d}.png"), small[..., ::-1])
    return folder


@pytest.mark.slow
def test_every_frame_has_a_pose_and_every_third_has_depth(pictures: Path) -> None:
    settings = BuildSettings("sfm", "estimate", device="cpu", chunks=ChunkSettings(10, 3))
    task = ChunkTask(str(pictures), OPTIONS, ChunkSpan(0, 0, 30), settings, None, (0, 30), 3)
    (made,) = process_parts(task)
    assert made.frame_indices.tolist() == list(range(30)) and made.posed.all()
    assert np.allclose(made.times_s, np.arange(30) / 30)
    assert len(made.samples.frame) and set(np.unique(made.samples.frame)) <= set(range(0, 30, 3))
    assert {k.frame_index for k in made.keyframes} <= set(range(0, 30, 3))
    truth = np.stack([pose(k)[:3, 3] for k in range(30)])
    S = umeyama(made.T_chunk_cam[:, :3, 3], truth, with_scale=True)
    assert np.linalg.norm(S.apply(made.T_chunk_cam[:, :3, 3]) - truth, axis=1).max() < 0.02


@pytest.mark.slow
def test_a_build_says_it_and_goes_on_as_it_began(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    memory = str(tmp_path / "m.l3r")
    words = ["build", str(pictures), "-m", memory, "--intrinsics", ",".join(map(str, OPTIONS.intrinsics or ()))]
    assert run([*words, "--chunk", "10", "--overlap", "4", "--workers", "0", "--depth-every", "2"]) == 0
    assert "as asked: depth and things are from every 2nd frame" in capsys.readouterr().out
    with Store.open(Path(memory)) as store:
        assert len(store.chunks.all()) == 2 and sum(f.state == "posed" for f in store.frames.all(1)) == 30
        assert store.sessions.all()[0].settings["depth_every"] == 2
    assert run([*words, "--chunk", "10", "--overlap", "4", "--resume", "--depth-every", "3"]) == 2
    assert "depth_every" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--depth-every", "0"], "--depth-every 0: choose 1 to 8"),
        (["--depth-every", "9"], "--depth-every 9: choose 1 to 8"),
        (["--depth-every", "2", "--reconstruction", "precomputed"], "--depth-every works with sfm and rgbd"),
    ],
)
def test_a_step_that_makes_no_sense_is_refused(
    more: list[str], said: str, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "precomputed.json").write_text(
        '{"format": "list3r-precomputed", "version": 1, "scale": "metric"}'
    )
    weights = ["--weights", str(tmp_path / "files")] if "precomputed" in more else []
    assert run(["build", str(pictures), "-m", str(tmp_path / "m.l3r"), *more, *weights]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "m.l3r").exists()
