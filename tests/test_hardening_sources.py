"""What a source of a stranger may hold: pipes and devices, pictures and archives that unfold, wrong numbers."""

from __future__ import annotations

import bz2
import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from list3r.cli.app import run
from list3r.frames import layout
from list3r.frames.decoding.decode import read_color, read_raw_depth
from list3r.frames.files import too_many_pixels
from list3r.frames.recordings import bag_chunks, stored
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import FrameError, OptionError, SourceError
from list3r.memory.core.unpacking import open_archive, parse_json
from list3r.reconstruction.precomputed_files import check_archives, read_piece
from tests import recordings
from tests.frames_scenes import write_png, write_replica, write_seven_scenes, write_tum

LIMIT_BYTES = 1500 * 2**20
"""Of address space, of which the libraries take up to 900 MB before anything is read."""


def picture_bomb(width: int, height: int, *, gray16: bool = False) -> bytes:
    """A PNG that unfolds to width x height, a thousandth as large itself."""

    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    line = 1 + width * (2 if gray16 else 3)
    packer = zlib.compressobj(9)
    zeros = bytes(line * max(1, 2**20 // line))
    data = b"".join(packer.compress(zeros) for _ in range(min(40, line * height // len(zeros)))) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 16 if gray16 else 8, 0 if gray16 else 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", data) + part(b"IEND", b"")


def jpeg_bomb() -> bytes:
    frame = b"\xff\xc0\x00\x11\x08" + struct.pack(">HH", 65500, 65500) + b"\x03\x01\x11\x00\x02\x11\x00\x03\x11\x00"
    return b"\xff\xd8\xff\xe0\x00\x04ab" + frame + b"\xff\xda\x00\x02" + bytes(64) + b"\xff\xd9"


@pytest.mark.parametrize("data", [picture_bomb(20000, 20000), picture_bomb(30000, 30000, gray16=True), jpeg_bomb()])
def test_pictures_that_unfold_are_refused_by_their_heads(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / ("a.jpg" if data[:2] == b"\xff\xd8" else "a.png")
    path.write_bytes(data)
    for read in (read_color, read_raw_depth):
        with pytest.raises(FrameError, match="megapixels"):
            read(path)


def test_what_is_of_use_is_read_whatever_its_kind(tmp_path: Path) -> None:
    for ending in (".png", ".bmp", ".tiff", ".ppm", ".webp", ".jpg"):
        write_png(tmp_path / f"a{ending}", np.full((48, 64, 3), 90, np.uint8))
        assert too_many_pixels((tmp_path / f"a{ending}").read_bytes()) is None
        assert read_color(tmp_path / f"a{ending}").shape == (48, 64, 3)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "a picture", "a depth picture", "groundtruth.txt"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_pipes_and_devices_of_a_source_are_not_waited_for(kind: str, name: str, tmp_path: Path) -> None:
    root = write_tum(tmp_path / "tum")
    place = {"a picture": next((root / "rgb").iterdir()), "a depth picture": next((root / "depth").iterdir())}.get(
        name, root / name
    )
    place.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(place)
    else:
        place.symlink_to("/dev/zero")
    assert run(["inspect", str(root)]) in (0, 2)


@pytest.fixture
def impatient() -> Iterator[None]:
    """A wait of a minute is one without end."""
    signal.alarm(60)
    yield
    signal.alarm(0)


RECORDINGS: dict[str, tuple[Callable[[Path], object], str]] = {
    "record3d": (recordings.write_record3d, "lzfse"),
    "rosbag": (recordings.write_bag, "rosbags.highlevel"),
    "sens": (recordings.write_sens, ""),
    "stray": (recordings.write_stray, ""),
    "polycam": (recordings.write_polycam, ""),
    "arkitscenes": (recordings.write_arkitscenes, ""),
    "nerfstudio": (recordings.write_nerfstudio, ""),
    "scannet": (recordings.write_scannet, ""),
    "colmap": (recordings.write_colmap, ""),
    "euroc": (recordings.write_euroc, ""),
    "replica": (write_replica, ""),
}


@pytest.mark.parametrize("kind", RECORDINGS)
def test_no_file_of_a_recording_is_waited_for(kind: str, tmp_path: Path, impatient: None) -> None:
    write, package = RECORDINGS[kind]
    if package:
        pytest.importorskip(package)
    root = write(tmp_path / "walk")
    root = root if isinstance(root, Path) else tmp_path / "walk"
    files = [root] if root.is_file() else [p for p in sorted(root.rglob("*")) if p.is_file()]
    for path in {(p.parent, p.suffix): p for p in files}.values():
        kept = path.rename(tmp_path / "kept")
        os.mkfifo(path)
        assert run(["inspect", str(root)]) in (0, 2), path
        path.unlink()
        kept.rename(path)


def archive_bomb(path: Path) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, frames=np.arange(2), depth=np.zeros((4, 4000, 4000)))


def test_an_archive_that_unfolds_is_refused(tmp_path: Path) -> None:
    archive_bomb(tmp_path / "a.npz")
    with pytest.raises(OptionError, match="claims"):
        read_piece(tmp_path / "a.npz")
    with pytest.raises(OptionError, match="claims"):
        check_archives(tmp_path)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"camera": ' * 5000, "1" * 10_000, '{"camera": {"fx": "a"}}', "\x00"])
def test_strange_json_beside_a_source_is_wrong_input(text: str, tmp_path: Path) -> None:
    root = write_replica(tmp_path / "replica")
    (root / "cam_params.json").write_text(text)
    assert run(["inspect", str(root)]) == 2


@pytest.mark.parametrize("array", [np.array(1.0), np.zeros(4), np.zeros((2, 3, 4)), np.zeros((0, 0)), np.array(["a"])])
def test_depth_of_another_shape_is_refused(array: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(FrameError):
        found = read_raw_depth(tmp_path / "a.npy")
        if not found.size:
            raise FrameError("nothing")


def notes(root: Path, **options: object) -> str:
    info = open_source(root, SourceOptions(**options)).info  # type: ignore[arg-type]
    return json.dumps([*info.notes, *info.missing])


WRONG: dict[str, Callable[[np.ndarray], None]] = {
    "mirrored": lambda T: T.__setitem__((slice(3), 0), -T[:3, 0]),
    "stretched": lambda T: T.__setitem__((slice(3), slice(3)), 1.3 * T[:3, :3]),
    "far": lambda T: T.__setitem__((0, 3), 1e200),
    "last row": lambda T: T.__setitem__((3, 3), 2.0),
    "not finite": lambda T: T.__setitem__((1, 1), np.nan),
}


@pytest.mark.parametrize("case", WRONG)
def test_poses_that_are_none_are_noted(case: str, tmp_path: Path) -> None:
    root = write_seven_scenes(tmp_path / "seven")
    assert "rigid" not in notes(root)
    for path in root.rglob("*.pose.txt"):
        T = np.eye(4)
        WRONG[case](T)
        np.savetxt(path, T)
    assert "4 of 4 poses looked at are not rigid motions" in notes(root)


@pytest.mark.parametrize("value", [0, 65535, 1, 40000])
def test_depth_that_cannot_be_is_noted(value: int, tmp_path: Path) -> None:
    root = write_seven_scenes(tmp_path / "seven")
    for path in root.rglob("*.depth.png"):
        write_png(path, np.full((480, 640), value, np.uint16))
    assert ("unknown everywhere" if value in (0, 65535) else "unlikely indoors") in notes(root)


def test_a_source_of_which_half_cannot_be_read_is_noted(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "tum", count=8)
    assert "cannot be used" not in notes(root, intrinsics=(70.0, 70.0, 39.5, 29.5))
    for path in sorted((root / "rgb").iterdir())[1::2]:
        path.write_bytes(path.read_bytes()[:100])
    assert "4 of 8 frames looked at cannot be used" in notes(root, intrinsics=(70.0, 70.0, 39.5, 29.5))


def test_a_depth_scale_that_is_not_of_the_layout_is_noted(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "tum")
    assert "depth-scale" not in notes(root, depth_scale=5000.0, intrinsics=(70.0, 70.0, 39.5, 29.5))
    assert "makes depth 5 times larger: the tum layout has 5000 units" in notes(
        root, depth_scale=1000.0, intrinsics=(70.0, 70.0, 39.5, 29.5)
    )


@pytest.mark.parametrize(
    "words", [["build", "walk", "-m", "m.l3r"], ["export", "m.l3r", "--to", "usd", "--out", "x.usda"]]
)
def test_too_little_address_space_is_one_line(
    words: list[str], make_memory: Callable[..., Path], tmp_path: Path
) -> None:
    write_tum(tmp_path / "walk")
    make_memory("m.l3r")

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (600 * 2**20, 600 * 2**20))

    command = [sys.executable, "-m", "list3r", *words]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    message = subprocess.run(
        command, capture_output=True, text=True, check=False, preexec_fn=limit, cwd=tmp_path, env=environment
    )
    assert message.returncode == 2 and message.stderr.count("\n") == 1 and "limited to 600 MiB" in message.stderr


def test_times_that_stand_still_are_noted(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "tum")
    for name in ("rgb.txt", "depth.txt"):
        lines = (root / name).read_text().splitlines()
        same = [line if line.startswith("#") else f"1.0 {line.split()[1]}" for line in lines]
        (root / name).write_text("\n".join(same) + "\n")
    (root / "depth.txt").unlink()
    shutil.rmtree(root / "depth")
    assert "do not ascend" in notes(root, intrinsics=(70.0, 70.0, 39.5, 29.5))


def test_distortion_that_no_lens_has_is_refused(tmp_path: Path) -> None:
    root = write_seven_scenes(tmp_path / "seven")
    assert run(["inspect", str(root), "--distortion", "1e10,0,0,0"]) == 2


@pytest.mark.parametrize("name", ["stsz", "trun"])
def test_a_video_whose_index_claims_too_much_is_refused(name: str, tmp_path: Path) -> None:
    table = struct.pack(">I4sIII", 20, name.encode(), 0, 2**31, 2**31)
    outer = ("moov", "trak", "mdia", "minf", "stbl") if name == "stsz" else ("moof", "traf")
    for box in reversed(outer):
        table = struct.pack(">I4s", 8 + len(table), box.encode()) + table
    (tmp_path / "walk.mp4").write_bytes(struct.pack(">I4sI4s", 16, b"ftyp", 0, b"isom") + table)
    with pytest.raises(SourceError, match="claims over 8,000,000"):
        open_source(tmp_path / "walk.mp4")


@pytest.mark.parametrize("text", ["[" + "[]," * 4_000_000 + "[]]", "[" * 100_000], ids=["many", "deep"])
def test_json_that_takes_much_memory_is_not_read(text: str) -> None:
    with pytest.raises(ValueError, match=r"takes? about|nested"):
        parse_json(text)


def test_archives_that_unpack_in_leaps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("metadata", bytes(1000))
    with pytest.raises(zipfile.BadZipFile, match="deflate"):
        open_archive(path)


def test_chunks_of_recordings_unpack_within_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_chunks, "MOST_BYTES", 1000)
    unpack = bag_chunks.bounded(bz2.BZ2Decompressor)
    assert unpack(bz2.compress(bytes(999))) == bytes(999)
    for data in (bz2.compress(bytes(2000)), bz2.compress(bytes(9))[:-4], b"no chunk at all"):
        with pytest.raises(ValueError, match="chunk"):
            unpack(data)


@pytest.mark.parametrize("hidden", [False, True])
def test_depth_of_lzfse_unpacks_within_bounds(hidden: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    lzfse = pytest.importorskip("lzfse")
    if hidden:
        monkeypatch.setattr(stored, "_filling", lambda library: None)
    depth = np.random.default_rng(0).normal(2.0, 0.01, 192 * 256).astype("<f4").tobytes()
    packed = lzfse.compress(depth)
    assert stored._unpacked(packed, len(depth), "lzfse") == depth
    blocks = lzfse.compress(bytes(2_000_000))[:-4] * 40 + b"bvx$"
    for data in (packed[:-100], b"no blocks", b"", blocks):
        raw = stored._unpacked(data, len(depth), "lzfse")
        assert raw is None if hidden or data is not blocks else raw is not None and len(raw) == len(depth) + 1


def test_bombs_take_no_memory(tmp_path: Path) -> None:
    """Within bounded address space, so that what unfolds would end in an error of memory."""
    root = tmp_path / "images"
    root.mkdir()
    for n in range(3):
        (root / f"{n}.png").write_bytes(picture_bomb(20000, 20000))
    command = [sys.executable, "-m", "list3r", "inspect", str(root)]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))

    message = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, preexec_fn=limit)
    assert message.returncode == 2 and "megapixels" in message.stderr, message.stderr


@given(st.text("ab\r\né", max_size=60), st.booleans())
def test_lists_are_read_or_refused_by_the_number_and_length_of_their_lines(text: str, whole: bool) -> None:
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(layout, "_MOST_LINES", 9)
        patch.setattr(layout, "_LONGEST_LINE", 8)
        path = Path(folder) / "list.txt"
        path.write_bytes(text.encode())
        ended = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        lines = ended[:-1] if whole or not ended[-1] else ended
        if len(ended) - 1 > 9 or max(map(len, ended)) > 8:
            with pytest.raises(SourceError, match=r"over 9 lines|line of over"):
                list(layout.read_lines(path, whole=whole))
        else:
            assert list(layout.read_lines(path, whole=whole)) == lines
