"""Shot cuts: chunks that end where a video jumps, jumps that are found, and what is no jump."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.feedforward_sim.cuts import cuts_by_descriptor
from list3r.frames.chunking.chunks import ChunkSettings, even_chunks, plan_chunks
from list3r.frames.chunking.cuts import find_cuts
from list3r.frames.source import open_source

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@given(st.integers(1, 700), st.lists(st.integers(-5, 720), max_size=6), st.integers(2, 60), st.data())
def test_no_chunk_spans_a_cut_and_no_frame_is_lost(
    count: int, cuts: list[int], length: int, data: st.DataObject
) -> None:
    settings = ChunkSettings(length, data.draw(st.integers(1, length - 1)))
    spans = plan_chunks(count, settings, cuts)
    assert [s.index for s in spans] == list(range(len(spans)))
    assert set().union(*(range(s.start, s.stop) for s in spans)) == set(range(count))
    for span in spans:
        assert 0 < span.stop - span.start <= length
        assert not any(span.start < cut < span.stop for cut in cuts)
    for before, after in itertools.pairwise(spans):
        at_cut = after.start in cuts and after.start == before.stop
        assert at_cut or before.stop - after.start == settings.overlap


def test_the_plan_without_cuts_is_as_ever() -> None:
    spans = plan_chunks(250, ChunkSettings())
    assert [(s.start, s.stop) for s in spans] == [(0, 100), (70, 170), (140, 240), (210, 250)]
    assert plan_chunks(250, ChunkSettings(), ()) == spans
    assert [(s.start, s.stop) for s in plan_chunks(20, ChunkSettings())] == [(0, 20)]


def test_a_short_shot_is_a_chunk_of_its_own() -> None:
    spans = plan_chunks(200, ChunkSettings(), (100, 108))
    assert [(s.start, s.stop) for s in spans] == [(0, 100), (100, 108), (108, 200)]


def walk(seed: int, count: int = 120) -> np.ndarray:
    """Unit descriptors that change slowly. Shape (count, 32)."""
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.normal(size=(count, 32)) * 0.1, axis=0) + rng.normal(size=32) * 2
    return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True), np.float32)


def test_descriptors_tell_a_jump_and_look_past_a_spoilt_frame() -> None:
    there, elsewhere = walk(101), walk(102)
    assert cuts_by_descriptor(np.concatenate([there, elsewhere, walk(103)])) == (120, 240)
    spoilt = there.copy()
    spoilt[60:62] = elsewhere[:2]
    assert cuts_by_descriptor(spoilt) == cuts_by_descriptor(there) == ()
    assert cuts_by_descriptor(there[:0]) == cuts_by_descriptor(there[:1]) == ()


def picture(world: np.ndarray, shift: float) -> np.ndarray:
    x = round(shift)
    return world[40:280, x : x + 320]


def write_video(folder: Path, pictures: list[np.ndarray]) -> Path:
    folder.mkdir()
    for k, image in enumerate(pictures):
        assert cv2.imwrite(str(folder / f"{k:04d}.png"), image)
    return folder


def world(seed: int) -> np.ndarray:
    """A wide picture with detail at all sizes."""
    rng = np.random.default_rng(seed)
    out = np.zeros((320, 1200), np.float32)
    for size in (4, 12, 40):
        coarse = rng.normal(size=(320 // size + 2, 1200 // size + 2)).astype(np.float32)
        out += cv2.resize(coarse, (1200, 320), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 35 * out, 0, 255).astype(np.uint8)


def test_pictures_tell_a_jump(tmp_path: Path) -> None:
    shots = [picture(world(k), 8 * i) for k in (101, 102) for i in range(25)]
    assert find_cuts(open_source(write_video(tmp_path / "video", shots))) == (25,)


def test_turning_fast_black_frames_and_exposure_are_no_jumps(tmp_path: Path) -> None:
    here = world(103)
    shots = [picture(here, x) for x in np.cumsum([*([6] * 15), *([45] * 10), *([6] * 15)])]
    shots[8] = np.zeros_like(shots[8])
    shots[30:] = [cv2.convertScaleAbs(s, alpha=0.5) for s in shots[30:]]
    folder = write_video(tmp_path / "video", shots)
    (folder / "0020.png").write_bytes(b"\x89PNG broken")
    assert find_cuts(open_source(folder)) == ()


@pytest.mark.data
@pytest.mark.parametrize("name", ["redkitchen", "cabinet"])
def test_real_walks_have_no_jump(name: str) -> None:
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA / name} is absent")
    assert find_cuts(open_source(DATA / name)) == ()


@given(count=st.integers(1, 700), length=st.integers(2, 90), data=st.data())
def test_even_chunks_are_no_more_and_no_longer_than_others_and_about_equal(
    count: int, length: int, data: st.DataObject
) -> None:
    settings = ChunkSettings(length, data.draw(st.integers(1, length - 1)))
    usual, even = plan_chunks(count, settings), even_chunks(count, settings)
    lengths = [s.stop - s.start for s in even]
    assert len(even) == len(usual) and (even[0].start, even[-1].stop) == (0, count)
    assert all(a.stop - b.start == settings.overlap for a, b in itertools.pairwise(even))
    assert max(lengths) <= length and max(lengths) - min(lengths) < len(even)
