"""Video and pictures as strangers' programs write them: broken clocks, other sizes, several streams, odd names."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from list3r.frames.base import BadFrame, Frame
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import SourceError

COUNT = 16


def picture(k: int, width: int = 96, height: int = 64) -> np.ndarray:
    """A grey value that tells the number."""
    out = np.full((height, width, 3), 20 + 12 * k, np.uint8)
    out[: height // 4, : width // 4] = 250
    return out


def number_in(frame: Frame) -> int:
    height, width = frame.color.shape[:2]
    return round((float(np.median(frame.color[height // 2 :, width // 2 :])) - 20) / 12)


def encode(
    path: Path, stamps_ms: list[int], first: int = 0, codec: str = "libx264", size: int = 1, **options: str
) -> Path:
    """Frames `first`, `first` + 1, ... at these times, B-frames among them; their sides divided by `size`."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = 96 // size, 64 // size, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = {"g": "5", "bf": "2", "crf": "12"} | options
        for k, stamp in enumerate(stamps_ms, start=first):
            frame = av.VideoFrame.from_ndarray(picture(k, 96 // size, 64 // size), format="rgb24")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def check_all(path: Path, count: int = COUNT) -> list[float]:
    """Every frame is there, in order, from any start; their times."""
    source = open_source(path)
    frames = [f for f in source.read(0, 99) if isinstance(f, Frame)]
    assert [number_in(f) for f in frames] == [f.index for f in frames] == list(range(count))
    for start in range(0, count, 3):
        (found,) = source.read(start, start + 1)
        assert isinstance(found, Frame) and number_in(found) == start and found.time_s == frames[start].time_s
    return [f.time_s for f in frames]


@pytest.mark.parametrize("bf", ["0", "2"])
def test_pictures_of_one_stamp_share_the_time_up_to_the_next(tmp_path: Path, bf: str) -> None:
    stamps = [40 * k - (40 if k in (7, 15) else 0) for k in range(COUNT)]
    times = check_all(encode(tmp_path / "twice.mkv", stamps, bf=bf))
    expected = [0.04 * k for k in range(COUNT)]
    expected[6:8] = 0.24, 0.28
    np.testing.assert_allclose(times[:15], expected[:15], atol=2e-3)
    assert times[14] < times[15] and np.all(np.diff(times) > 0)


def test_pictures_out_of_order_in_an_avi_are_counted(tmp_path: Path) -> None:
    """AVI has no time of showing, and FFmpeg makes up one that follows the order of decoding."""
    path = tmp_path / "b.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.options = {"g": "5", "bf": "2", "crf": "12"}
        for k in range(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k), format="rgb24")))
        container.mux(stream.encode())
    np.testing.assert_allclose(check_all(path), np.arange(COUNT) / 30, atol=1e-3)


def test_files_put_together_have_one_clock(tmp_path: Path) -> None:
    halves = [encode(tmp_path / f"{n}.ts", [40 * k for k in range(8)], first=8 * n) for n in range(2)]
    (tmp_path / "both.ts").write_bytes(b"".join(half.read_bytes() for half in halves))
    assert any("restarts" in note for note in open_source(tmp_path / "both.ts").info.notes)
    np.testing.assert_allclose(check_all(tmp_path / "both.ts"), 0.04 * np.arange(COUNT), atol=0.05)


def test_a_stream_that_goes_on_smaller_is_enlarged_and_one_of_another_shape_is_bad(tmp_path: Path) -> None:
    large = encode(tmp_path / "large.h264", [40 * k for k in range(8)])
    small = encode(tmp_path / "small.h264", [40 * k for k in range(8)], first=8, size=2)
    (tmp_path / "call.h264").write_bytes(large.read_bytes() + small.read_bytes())
    check_all(tmp_path / "call.h264")
    with av.open(str(tmp_path / "square.h264"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width = stream.height = 64
        stream.pix_fmt, stream.options = "yuv420p", {"bf": "0"}
        for k in range(8):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k, 64, 64), format="rgb24")))
        container.mux(stream.encode())
    (tmp_path / "turned.h264").write_bytes(large.read_bytes() + (tmp_path / "square.h264").read_bytes())
    found = list(open_source(tmp_path / "turned.h264").read(0, COUNT))
    assert [isinstance(f, BadFrame) for f in found] == [False] * 8 + [True] * 8
    assert isinstance(found[8], BadFrame) and "64x64" in found[8].reason


def test_the_largest_of_several_streams_is_taken_and_said(tmp_path: Path) -> None:
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("libx264", rate=30) for _ in range(2)]
        for n, stream in enumerate(streams):
            stream.width, stream.height, stream.pix_fmt = 48 * (n + 1), 32 * (n + 1), "yuv420p"
            stream.options = {"crf": "12"}
        for k in range(COUNT):
            for n, stream in enumerate(streams):
                shown = picture(k) if n else np.zeros((32, 48, 3), np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")))
        for stream in streams:
            container.mux(stream.encode())
    check_all(path)
    assert any("2 video streams; the largest, 96x64" in note for note in open_source(path).info.notes)


@pytest.mark.parametrize("name", ["12:30:00.mp4", "file:x.mp4", "-dash.mp4", "a %03d ü'.mp4"])
def test_names_are_names_and_not_protocols(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    encode(tmp_path / "plain.mp4", [40 * k for k in range(COUNT)]).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    check_all(Path(name))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("list.ffconcat", "ffconcat version 1.0\nfile plain.mp4\n"),
        ("list.m3u8", "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:1,\nplain.ts\n#EXT-X-ENDLIST\n"),
    ],
)
def test_a_playlist_is_refused(tmp_path: Path, name: str, text: str) -> None:
    for ending in ("mp4", "ts"):
        encode(tmp_path / f"plain.{ending}", [40 * k for k in range(COUNT)])
    (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match="playlist"):
        open_source(tmp_path / name)


def test_the_code_of_hdr10_becomes_that_of_ordinary_video(tmp_path: Path) -> None:
    if "libx265" not in av.codecs_available:
        pytest.skip("this FFmpeg has no libx265")
    path = tmp_path / "hdr.mov"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p10le"
        stream.options = {"crf": "8", "x265-params": "log-level=none"}
        stream.codec_context.color_trc = 16
        for nits in (0.1, 20.0, 203.0, 1000.0):
            y = (nits / 10000) ** 0.1593017578125
            code = ((0.8359375 + 18.8515625 * y) / (1 + 18.6875 * y)) ** 78.84375
            grey = av.VideoFrame.from_ndarray(np.full((64, 96, 3), round(code * 65535), np.uint16), format="rgb48le")
            frame = grey.reformat(format="yuv420p10le")
            frame.color_trc = 16
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    source = open_source(path)
    found = [float(np.median(f.color)) for f in source.read(0, 4) if isinstance(f, Frame)]
    assert any("HDR10" in note for note in source.info.notes)
    np.testing.assert_allclose(found, [1.6, 89.2, 255, 255], atol=4)  # sRGB of 20 of 203 nits is 0.35


def folder_of(root: Path, sizes: list[tuple[int, int]]) -> Path:
    root.mkdir()
    for k, (width, height) in enumerate(sizes):
        cv2.imwrite(str(root / f"{k:02d}.jpg"), picture(k, width, height))
    return root


def test_the_size_that_most_pictures_have_is_that_of_a_folder(tmp_path: Path) -> None:
    found = list(open_source(folder_of(tmp_path / "cover", [(50, 90), *[(96, 64)] * 9])).read(0, 99))
    assert isinstance(found[0], BadFrame) and "most frames 96x64" in found[0].reason
    assert all(isinstance(f, Frame) for f in found[1:]) and len(found) == 10


def test_a_film_behind_a_jpeg_is_no_damage_and_half_a_jpeg_is(tmp_path: Path) -> None:
    root = folder_of(tmp_path / "phone", [(96, 64)] * 4)
    small = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    for path in sorted(root.iterdir()):
        data = path.read_bytes()
        exif = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small  # a small picture in front, as in EXIF
        path.write_bytes(data[:2] + exif + data[2:] + bytes(50_000))
    whole = (root / "03.jpg").read_bytes()[:-50_000]
    (root / "03.jpg").write_bytes(whole[: len(whole) // 2 + len(small) // 2])
    found = list(open_source(root).read(0, 4))
    assert all(isinstance(f, Frame) for f in found[:3])
    assert isinstance(found[3], BadFrame) and found[3].reason == "03.jpg is cut off"


def test_folders_without_pictures_that_can_be_read_say_what_to_do(tmp_path: Path) -> None:
    folder_of(tmp_path / "walk", [(96, 64)] * 3)
    with pytest.raises(SourceError, match="its folder walk does"):
        open_source(tmp_path)
    phone = tmp_path / "phone"
    phone.mkdir()
    (phone / "IMG_1.HEIC").write_bytes(b"ftypheic")
    with pytest.raises(SourceError, match=r"IMG_1\.HEIC, which cannot be read here; convert"):
        open_source(phone, SourceOptions())
