"""Frames of a slow video that are not looked at: their poses lie between those of their neighbours."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from list3r.cli.app import run
from list3r.frames.base import BadFrame, Frame, LazyFrame
from list3r.frames.chunking.chunks import ChunkSettings, ChunkSpan
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.geometry import Sim3, rotation_exp
from list3r.memory.library.evidence import EvidenceSettings, weigh
from list3r.memory.library.overlap.pair_scores import pair_scores
from list3r.memory.library.overlap.voxels import ChunkShapes, chunk_shapes, read_every
from list3r.memory.store.store import Store
from list3r.pipeline.chunks.chunk import ChunkTask, process_parts
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor, _pose_passed
from tests.memory_scenes import IMAGE, MUG, node, surface
from tests.rgbd_scenes import CAMERA, render

COUNT = 22


def pose(k: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = rotation_exp(np.array([0.0, 0.003 * k, 0.0]))
    T[:3, 3] = -0.3 + 0.008 * k, 0.02 * np.sin(k / 8), -0.4
    return T


class Reels:
    """Frames of a camera at some poses, which tell whether they were looked at."""

    def __init__(self, poses: list[np.ndarray]) -> None:
        self.poses, self.read = poses, [0] * len(poses)

    def frame(self, k: int) -> Frame:
        self.read[k] += 1
        return replace(render(self.poses[k], index=k), T_source_cam=None)

    def frames(self, step: int) -> list[Frame]:
        def later(k: int) -> Frame:
            return LazyFrame(k, k / 30, None, lambda: self.frame(k))

        return [later(k) if k % step else self.frame(k) for k in range(len(self.poses))]


def errors_m(T_chunk_cam: np.ndarray, poses: list[np.ndarray]) -> np.ndarray:
    there = np.linalg.inv(poses[0]) @ np.stack(poses)
    return np.linalg.norm((T_chunk_cam - there)[:, :3, 3], axis=1)


def test_a_frame_is_read_when_it_is_looked_at_and_let_go() -> None:
    reels = Reels([pose(0)])
    frame = LazyFrame(0, 0.0, None, lambda: reels.frame(0))
    assert frame.index == 0 and reels.read == [0]
    assert frame.color.shape == (240, 320, 3) and frame.depth is not None and reels.read == [1]
    frame.let_go()
    assert frame.depth is not None and reels.read == [2]
    assert LazyFrame(3, 0.1, None, lambda: BadFrame(3, "cut off")).depth is None
    with pytest.raises(AttributeError):
        _ = frame.colour  # type: ignore[attr-defined]


def test_a_slow_camera_is_followed_without_most_frames() -> None:
    reels = Reels([pose(k) for k in range(COUNT)])
    made = RgbdReconstructor().thinned(reels.frames(3), CAMERA, set(range(0, COUNT, 3)))
    assert made.frame_indices.tolist() == list(range(0, COUNT, 3)) and made.posed.all() and len(made.keyframes)
    assert made.between is not None and made.between.posed.all()
    looked_at = [k for k in range(COUNT) if k % 3 and reels.read[k]]
    assert looked_at == [1, 2]  # until it is known how the camera moves
    order = np.argsort([*made.frame_indices, *made.between.frame_indices])
    T = np.concatenate([made.T_chunk_cam, made.between.T_chunk_cam])[order]
    assert errors_m(T, reels.poses).max() < 0.006


def test_where_a_clock_stands_still_what_is_passed_over_lies_in_the_middle() -> None:
    T, posed = np.stack([pose(0), np.eye(4), pose(2)]), np.array([True, False, True])
    _pose_passed(T, posed, [[1]], [0.5, 0.5, 0.5])
    assert posed.all() and np.allclose(T[1, :3, 3], (T[0] + T[2])[:3, 3] / 2, atol=1e-5)


def test_what_is_passed_over_is_looked_at_where_the_camera_is_lost_without_it() -> None:
    fast = [pose(0.4 * k if k < 8 else 3.2 + 6.0 * (k - 8)) for k in range(14)]
    reels = Reels(fast)
    made = RgbdReconstructor().thinned(reels.frames(4), CAMERA, set(range(0, 14, 4)))
    assert made.posed.all() and made.between is not None and made.between.posed.all()
    assert all(reels.read[k] for k in (9, 10, 11, 13)) and not any(reels.read[k] for k in (5, 6, 7))
    assert errors_m(made.T_chunk_cam, fast[::4]).max() < 0.015


def test_all_frames_is_the_same_as_no_number() -> None:
    frames = Reels([pose(k) for k in range(6)]).frames(1)
    a, b = RgbdReconstructor()(frames, CAMERA), RgbdReconstructor().thinned(frames, CAMERA, set(range(6)))
    assert a.between is b.between is None and np.array_equal(a.T_chunk_cam, b.T_chunk_cam)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("slow") / "walk"
    folder.mkdir()
    rows = [[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]]
    (folder / "camera-intrinsics.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    for k in range(COUNT):
        frame = render(pose(k), index=k)
        assert frame.depth is not None
        cv2.imwrite(str(folder / f"frame-{k:06d}.color.png"), frame.color[..., ::-1])
        cv2.imwrite(str(folder / f"frame-{k:06d}.depth.png"), np.rint(1000 * frame.depth).astype(np.uint16))
    return folder


def test_a_source_reads_every_third_frame_now_and_the_others_later(walk: Path) -> None:
    frames = list(open_source(walk).read_some(2, 9, 3))
    assert [f.index for f in frames] == list(range(2, 9))
    assert [isinstance(f, LazyFrame) for f in frames] == [True, False, True, True, False, True, True]
    whole = [f for f in open_source(walk).read(2, 9) if isinstance(f, Frame)]
    for some, all_ in zip(frames, whole, strict=True):
        assert isinstance(some, Frame) and some.time_s == all_.time_s and np.array_equal(some.color, all_.color)


def test_where_a_frame_cannot_be_decoded_all_are_read(walk: Path, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(walk, tmp_path / "walk"))
    for k in (4, 7):
        (broken / f"frame-{k:06d}.color.png").write_bytes(b"cut off")
    settings = BuildSettings("rgbd", "estimate", chunks=ChunkSettings(COUNT, 4))
    (made,) = process_parts(ChunkTask(str(broken), SourceOptions(), ChunkSpan(0, 0, COUNT), settings, depth_every=2))
    assert [index for index, _ in made.bad_frames] == [4, 7]
    assert made.frame_indices[made.posed].tolist() == [k for k in range(COUNT) if k not in (4, 7)]


@pytest.mark.slow
def test_a_build_is_the_same_with_any_number_of_processes(walk: Path, tmp_path: Path) -> None:
    found = []
    for workers in ("0", "2"):
        memory = tmp_path / f"{workers}.l3r"
        words = ["build", str(walk), "-m", str(memory), "--chunk", "6", "--overlap", "2", "--depth-every", "2"]
        assert run([*words, "--workers", workers]) == 0
        with Store.open(memory) as store:
            rows = store.trajectory.poses(1)
            seen = {f for c in store.chunks.all() for f in store.chunks.samples(c.chunk_id).frame.tolist()}
            found.append((np.stack([S.as_matrix() for _, S in rows]), sorted(seen), store.chunks.checksums()))
    assert len(found[0][0]) == COUNT and found[0][1] == list(range(0, COUNT, 2))
    assert np.array_equal(found[0][0], found[1][0]) and found[0][1:] == found[1][1:]


def seen_in(chunk_id: int, frames: np.ndarray, step: int) -> ChunkShapes:
    """A chunk that sees a mug in some frames, of which every `step`-th was to be read."""
    nodes = [node(chunk_id, 0, surface(MUG, chunk_id), frames=frames)]
    return read_every(chunk_shapes(nodes, IMAGE, chunk_id=chunk_id), step)


def test_a_frame_counts_for_those_that_were_passed_over_beside_it() -> None:
    every, third = np.arange(300, 336), np.arange(300, 336, 3)
    assert seen_in(1, every, 1).seen_for(0) == seen_in(1, third, 3).seen_for(0) == 36
    assert seen_in(1, every, 3).seen_for(0) == 36  # where all frames had to be read
    assert seen_in(1, third, 1).seen_for(0) == 12


def test_evidence_counts_the_time_of_the_recording_not_what_was_read_of_it() -> None:
    groups = [[(1, 0), (2, 0)]]

    def told(step: int) -> tuple[int, float, int]:
        chunks = {k: seen_in(k, np.arange(first, first + 36, step), step) for k, first in ((1, 300), (2, 318))}
        pairs = {(1, 2): pair_scores(chunks[1], chunks[2], Sim3.identity())}
        found = weigh(groups, chunks, pairs, EvidenceSettings())[0]
        return found.frames, found.confidence, int(pairs[1, 2].shared[0])

    assert told(1) == told(2) == told(3) and told(1)[0] == 54 and told(1)[2] == 18
