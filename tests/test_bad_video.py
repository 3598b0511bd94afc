"""Video that gives no depth, or gives it in parts: what can be built is kept, and one line says what is wrong."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from list3r.frames.base import BadFrame, Camera, Frame, SourceInfo
from list3r.frames.chunking.borrowing import BorrowSettings, borrow
from list3r.frames.chunking.chunks import ChunkSpan
from list3r.frames.decoding.picture import small_gray
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import SourceError, TrackingError
from list3r.memory.core.geometry import rotation_exp, umeyama
from list3r.memory.store.store import Store
from list3r.pipeline.build import build
from list3r.pipeline.chunks.calibration import camera_notes
from list3r.pipeline.chunks.chunk import ChunkTask, process_parts
from list3r.pipeline.reports import _runs
from list3r.pipeline.request import RunOptions, Watch
from list3r.pipeline.session import Job, plan_session
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.sfm.calibration import _focal_sigma
from list3r.reconstruction.sfm.mapping import MapProblem, SparseMap
from list3r.reconstruction.sfm.reconstructor import SfmReconstructor
from list3r.reconstruction.sfm.settings import CameraCalibrationSettings
from tests.conftest import write_small_room
from tests.rgbd_scenes import CAMERA, render


def pose(k: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = rotation_exp(np.array([0.0, 0.004 * k, 0.0]))
    T[:3, 3] = -0.35 + 0.028 * k, 0.04 * np.sin(k / 4), -0.4
    return T


@lru_cache(maxsize=64)
def picture(k: int) -> np.ndarray:
    """What the camera sees after k steps, at half size."""
    return np.asarray(cv2.resize(render(pose(k), index=0).color, (160, 120), interpolation=cv2.INTER_AREA))


WALK = [*range(12), *[12] * 20, *range(13, 25)]
"""Steps of a walk that stands still for twenty frames."""
OPTIONS = SourceOptions(intrinsics=(131.0, 131.0, 79.5, 59.5), distortion=())


def save(folder: Path, steps: list[int]) -> Path:
    """Pictures with the noise of a sensor, which is new in each."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for n, k in enumerate(steps):
        noisy = np.clip(picture(k) + rng.normal(0, 1.5, (120, 160, 3)), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{n:04d}.png"), noisy[..., ::-1])
    return folder


class Steps:
    """A source in memory whose frames show steps of the walk."""

    def __init__(self, steps: list[int]) -> None:
        self.steps = steps
        self.info = SourceInfo("images", "here", len(steps), 30.0, None, False, False, "")

    def read(self, start: int, stop: int) -> Iterator[Frame | BadFrame]:
        for n in range(len(self.steps))[start:stop]:
            yield Frame(n, n / 30, picture(self.steps[n]), None, None)

    def position(self, index: int) -> int:
        return index


def test_a_stretch_that_stands_still_borrows_the_nearest_frames_that_differ() -> None:
    source = Steps(WALK)
    found = borrow(source, (14, 30), (0, len(WALK)), list(source.read(14, 30)), BorrowSettings(frames=5))
    assert [f.index for f in found.frames] == [8, 9, 10, 11, 12, 32, 33, 34, 35, 36]
    assert {r.index for r in found.repeats} == set(range(14, 30)) and {r.shown for r in found.repeats} == {12}
    assert found.own == {12}


def test_nothing_is_borrowed_from_another_shot_or_from_out_of_reach() -> None:
    source = Steps(WALK)
    frames = list(source.read(16, 30))
    shot = borrow(source, (16, 30), (14, 33), frames)
    assert [f.index for f in shot.frames] == [14, 32]
    near = borrow(source, (16, 30), (0, len(WALK)), frames, BorrowSettings(reach=3))
    assert [f.index for f in near.frames] == [13, 32]


@pytest.mark.slow
def test_a_chunk_that_stands_still_takes_the_pose_of_its_neighbours(tmp_path: Path) -> None:
    folder = save(tmp_path / "walk", WALK)
    settings = BuildSettings("sfm", "estimate", device="cpu")
    task = ChunkTask(str(folder), OPTIONS, ChunkSpan(1, 14, 30), settings, shot=(0, len(WALK)))
    (made,) = process_parts(task)
    place = {int(i): k for k, i in enumerate(made.frame_indices)}
    own = [place[i] for i in range(14, 30)]
    assert made.posed[own].all() and not made.lost_reason and made.index == 1
    np.testing.assert_allclose(made.times_s[own], np.arange(14, 30) / 30)
    posed = np.flatnonzero(made.posed)
    found = made.T_chunk_cam[posed, :3, 3]
    truth = np.stack([pose(WALK[int(made.frame_indices[k])])[:3, 3] for k in posed])
    S = umeyama(found, truth, with_scale=True)
    assert np.linalg.norm(S.apply(found) - truth, axis=1).max() < 0.03
    alone = process_parts(replace(task, shot=(14, 30)))[0]
    assert not alone.posed.any() and "does not move" in alone.lost_reason


@pytest.mark.slow
@pytest.mark.parametrize("focal", [CAMERA.fx, 1.2 * CAMERA.width], ids=["known", "guessed"])
@pytest.mark.parametrize("known", [True, False])
def test_a_camera_that_only_turns_makes_no_map_whatever_its_focal_length(focal: float, known: bool) -> None:
    turned = []
    for k in range(14):
        T = np.eye(4)
        T[:3, :3], T[2, 3] = rotation_exp(np.array([0.0, 0.03 * k, 0.0])), -0.4
        turned.append(replace(render(T, index=k), depth=None))
    with pytest.raises(TrackingError, match="only turns"):
        SfmReconstructor(camera_known=known)(turned, replace(CAMERA, fx=focal, fy=focal))


def test_a_build_that_places_no_camera_leaves_no_memory_and_gives_the_old_one_back(tmp_path: Path) -> None:
    folder, memory = save(tmp_path / "still", [3] * 6), tmp_path / "m.l3r"
    settings = BuildSettings("sfm", "estimate", device="cpu")
    message = r"any frame of .*still \(6 frames\); frames 0 to 5: the camera does not move"
    with pytest.raises(TrackingError, match=message):
        build(folder, memory, options=OPTIONS, settings=settings, run=RunOptions(workers=0))
    assert list(tmp_path.glob("m.l3r*")) == []
    with Store.create(memory) as store, store.transaction():
        write_small_room(store)
        before = [i.id for i in store.instances.all()]
    with pytest.raises(TrackingError):
        build(folder, memory, options=OPTIONS, settings=settings, run=RunOptions(workers=0, force=True))
    assert [p.name for p in tmp_path.glob("m.l3r*")] == ["m.l3r"]
    with Store.open(memory) as store:
        assert before and [i.id for i in store.instances.all()] == before


def test_one_frame_is_refused_in_one_line_by_the_program(tmp_path: Path) -> None:
    folder = save(tmp_path / "one", [0])
    words = ["build", str(folder), "-m", str(tmp_path / "m.l3r"), "--workers", "0"]
    done = subprocess.run([sys.executable, "-m", "list3r", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stdout == ""
    errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(errors) == 1 and "at least two frames" in errors[0] and "Traceback" not in done.stderr
    assert not (tmp_path / "m.l3r").exists()


def write_clip(
    path: Path, first_ms: int, size: tuple[int, int] = (96, 64), pixels: str = "yuv420p", step_ms: int = 40
) -> Path:
    """Twelve frames, the first at `first_ms`, as an encoder with a clock of its own writes them."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        stream.options = {"bf": "0"}
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for k in range(12):
            grey = np.full((size[1], size[0], 3), 20 * (k + 1), np.uint8)
            grey[: size[1] // 2, : size[0] // 2] = 250 - 15 * k
            frame = av.VideoFrame.from_ndarray(grey, format="rgb24")
            frame.pts, frame.time_base = first_ms + step_ms * k, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_frames_before_the_clock_begins_are_taken_and_what_was_cut_away_is_not(tmp_path: Path) -> None:
    phone = open_source(write_clip(tmp_path / "phone.mp4", -50))
    frames = [f for f in phone.read(0, 100) if isinstance(f, Frame)]
    assert phone.info.frame_count == len(frames) == 12
    assert [round(float(np.median(f.color[40:])) / 20) - 1 for f in frames] == list(range(12))
    np.testing.assert_allclose([f.time_s for f in frames], np.arange(12) * 0.04, atol=1e-3)
    assert [round(float(np.median(f.color[40:])) / 20) - 1 for f in phone.read(7, 9)] == [7, 8]
    trimmed = open_source(write_clip(tmp_path / "trimmed.mp4", -800, step_ms=100))
    assert trimmed.info.frame_count == len(list(trimmed.read(0, 100))) == 4
    assert not any("cut off" in note for note in trimmed.info.notes)


@pytest.mark.parametrize("size", [(96, 64), (202, 98)])
@pytest.mark.parametrize("pixels", ["yuv420p", "yuv444p"])
def test_small_pictures_from_the_luma_plane_are_those_of_the_picture(
    tmp_path: Path, size: tuple[int, int], pixels: str
) -> None:
    with av.open(str(write_clip(tmp_path / "a.mp4", 0, size, pixels))) as container:
        image = next(container.decode(video=0))
    whole = image.reformat(format="gray").to_ndarray().astype(float)
    small = small_gray(image, 48)
    assert max(small.shape) == 48
    shrunk = cv2.resize(whole, small.shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.corrcoef(shrunk.ravel(), small.ravel().astype(float))[0, 1] > 0.999


def test_more_windows_that_agree_make_the_focal_length_surer() -> None:
    def windows(*focals: float) -> list[tuple[MapProblem, SparseMap]]:
        return [(MapProblem({}), SparseMap({}, {}, Camera(640, 480, f, f, 320, 240))) for f in focals]

    s = CameraCalibrationSettings()
    assert _focal_sigma(windows(500.0), s) == pytest.approx(s.window_sigma)
    agreeing = _focal_sigma(windows(500.0, 505.0, 495.0, 500.0, 502.0), s)
    parted = _focal_sigma(windows(500.0, 600.0, 420.0, 560.0, 450.0), s)
    assert agreeing < 0.035 < parted < s.window_sigma


def test_what_is_said_of_the_camera_is_in_pixels_of_the_pictures_as_stored(tmp_path: Path) -> None:
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((120, 160, 3), np.uint8))
    job = Job(
        tmp_path, SourceOptions(max_side=80), BuildSettings("sfm"), open_source(tmp_path).info, RunOptions(workers=1)
    )
    with Store.create(tmp_path / "m.l3r") as store:
        with store.transaction():
            session = store.sessions.add("here", "", {}, 4)
        plan = plan_session(store, session, job, Watch())
        assert "focal length of 192 px is a guess" in camera_notes(store, session)[0]
    assert plan.first is not None and plan.first.options.intrinsics == pytest.approx((192.0, 192.0, 79.5, 59.5))


def test_runs_of_numbers_in_words() -> None:
    assert _runs([4]) == "4" and _runs([1, 2, 3, 7, 9, 10]) == "1 to 3, 7, 9 to 10"
    assert _runs(list(range(0, 20, 2)), most=2) == "0, 2 and 8 more stretches"


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_pictures_of_fewer_bits_in_sixteen_are_as_bright_as_they_were(tmp_path: Path, bits: int) -> None:
    for n in range(3):
        grey = cv2.cvtColor(picture(n), cv2.COLOR_RGB2GRAY).astype(np.uint16)
        grey[0, 0] = 255
        cv2.imwrite(str(tmp_path / f"{n}.png"), grey << (bits - 8))
    source = open_source(tmp_path)
    (first,) = (f for f in source.read(0, 1) if isinstance(f, Frame))
    expected = cv2.cvtColor(picture(0), cv2.COLOR_RGB2GRAY)
    np.testing.assert_array_equal(first.color[1:, :, 0], expected[1:])
    assert any(f"use {bits} of their 16 bits" in note for note in source.info.notes) == (bits < 16)


def test_a_folder_with_a_video_in_it_names_the_video(tmp_path: Path) -> None:
    write_clip(tmp_path / "my walk.mp4", 0)
    with pytest.raises(SourceError, match=r"folder with the video my walk\.mp4"):
        open_source(tmp_path)


def test_pictures_that_are_too_small_are_called_that() -> None:
    frames = [Frame(k, k / 30, np.full((24, 32, 3), 9, np.uint8), None, None) for k in range(3)]
    with pytest.raises(TrackingError, match="32x24 are too small"):
        SfmReconstructor()(frames, Camera(32, 24, 40.0, 40.0, 15.5, 11.5))
