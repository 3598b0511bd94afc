"""Lists of very many frames: what is packed comes out again, names that lead out are refused wherever they stand."""

from __future__ import annotations

import pathlib
import threading
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from list3r.frames.base import Camera
from list3r.frames.folder import fingerprint
from list3r.frames.layout import inside
from list3r.frames.listing import DEPTH, POSE, POSE_FILE, FrameFile, FrameFiles
from list3r.frames.options import SourceOptions
from list3r.frames.recordings.stored import CodedArray, FileSlice, Stored, ZipMember
from list3r.memory.core.errors import SourceError


@pytest.mark.parametrize("name", ["../a.jpg", "p/../../a.jpg", "/etc/passwd", "..", "p/..", "p/out.jpg", "q/a.jpg"])
def test_a_name_or_link_that_leads_out_is_refused(name: str, tmp_path: Path) -> None:
    root = tmp_path / "walk"
    (root / "p").mkdir(parents=True)
    (root / "p/a.jpg").write_bytes(b"x")
    (tmp_path / "other").mkdir()
    (root / "q").symlink_to(tmp_path / "other")
    (root / "p/out.jpg").symlink_to(tmp_path / "other/a.jpg")
    (root / "p/within.jpg").symlink_to(root / "p/a.jpg")
    assert inside(root, "p/a.jpg", root) == root / "p/a.jpg"
    assert inside(root, "p/within.jpg", root) == root / "p/within.jpg"
    if name == "p/..":
        assert inside(root, name, root).resolve() == root
        return
    with pytest.raises(SourceError, match="outside"):
        inside(root, name, root)


def test_names_sizes_and_options_shape_the_fingerprint() -> None:
    rows, given = [("a'b.jpg", 3), ("ü.png", -1)], SourceOptions()
    assert fingerprint("tum", iter(rows), given) == fingerprint("tum", rows, SourceOptions(kind="tum"))
    cases = [(rows, given), (rows[:1], given), ([], given), (rows[::-1], given), (rows, SourceOptions(fps=5.0))]
    assert len({fingerprint("tum", listing, options) for listing, options in cases}) == 5


def frame_files(count: int) -> Iterator[FrameFile]:
    """Frames of every kind of what can be stored."""
    for k in range(count):
        T = np.eye(4)
        T[:3, 3] = k / 3, -k, 1e-17
        member: Stored = ZipMember(Path("a b.zip"), f"rgbd/{k}.jpg")
        part: Stored = FileSlice(Path("x.sens"), k * 10**6, 5, f"{k}.jpg")
        coded = CodedArray(part, "zlib", "|u1", (3, 4))
        lens = Camera(4, 3, 2.5, 2.0 + k, 1.5, 1.0, (0.1, k / 7), fisheye=True)
        yield (
            FrameFile(Path(f"rgb/\udcff{k}.png"), Path(f"d/{k}.png"), Path("p.txt"), None, k / 3, mask=Path("m.png")),
            FrameFile(member, CodedArray(member, "lzfse", "<f4", (3, 4)), None, T, None, coded),
            FrameFile(part, time_s=float(k), lens=lens),
        )[k % 3]  # fmt: skip


def same(a: FrameFile, b: FrameFile) -> bool:
    plain = [(f.color, f.depth, f.pose, f.time_s, f.confidence, f.mask, f.lens) for f in (a, b)]
    T_a, T_b = a.T_source_camera, b.T_source_camera
    return plain[0] == plain[1] and (
        T_a is T_b is None or (T_a is not None and T_b is not None and bool((T_a == T_b).all()))
    )


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, 1000])
def test_packed_frames_come_out_as_they_went_in(count: int) -> None:
    given, packed = list(frame_files(count)), FrameFiles(frame_files(count))
    assert len(packed) == count and all(map(same, packed, given))
    order = np.random.default_rng(0).permutation(count)
    assert all(same(packed[int(k)], given[k]) for k in order)
    assert [f.color for f in packed[5:300:7]] == [f.color for f in given[5:300:7]]
    for what, has in ((DEPTH, "depth"), (POSE_FILE, "pose"), (POSE, "T_source_camera")):
        assert packed.that_hold(what).tolist() == [k for k, f in enumerate(given) if getattr(f, has) is not None]
    assert np.array_equal(np.isnan(packed.times_s), [f.time_s is None for f in given])
    with pytest.raises(IndexError):
        packed[count]


def test_frames_are_asked_for_by_several_threads() -> None:
    given, packed = list(frame_files(2000)), FrameFiles(frame_files(2000))
    wrong: list[int] = []

    def ask(seed: int) -> None:
        numbers = np.random.default_rng(seed).integers(0, 2000, 200).tolist()
        wrong.extend(k for k in numbers if not same(packed[k], given[k]))

    threads = [threading.Thread(target=ask, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_memory_hardly_grows_with_the_frames() -> None:
    rng = np.random.default_rng(0)
    tracemalloc.start()
    many = FrameFiles(FrameFile(Path(f"rgb/{k}.png"), T_source_camera=rng.random((4, 4))) for k in range(40_000))
    # The interpreter's own table of names, which pathlib fills, doubles at whatever test is running.
    held = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(False, pathlib.__file__)])
    tracemalloc.stop()
    grown = sum(trace.size for trace in held.traces)
    assert grown < 60 * len(many)
