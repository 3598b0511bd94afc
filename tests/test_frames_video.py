"""Video: the file's own clock, sides and damage, from any start, without holding it."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from list3r.frames.base import BadFrame, Frame
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.errors import OptionError, SourceError


def write_video(path: Path, stamps_ms: list[int], size: tuple[int, int] = (96, 64), **codec: str) -> Path:
    """Frames whose brightness tells their number: 10 + 4 k. `stamps_ms` are their times."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264" if path.suffix != ".avi" else "mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = codec
        for k, stamp in enumerate(stamps_ms):
            picture = np.full((size[1], size[0], 3), 10 + 4 * k, np.uint8)
            picture[: size[1] // 2, : size[0] // 2] = 250
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def number_in(frame: Frame) -> int:
    height, width = frame.color.shape[:2]
    return round((float(np.median(frame.color[height // 2 + 4 :, width // 2 + 4 :])) - 10) / 4)


STAMPS = [0, 40, 70, 100, 200, 210, 300, 330, 400, 433, 466, 500, 600, 650, 700, 733, 766, 800, 900, 1000]


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty frames at uneven times, key frames every 6, with B-frames."""
    return write_video(tmp_path_factory.mktemp("v") / "uneven.mp4", STAMPS, g="6", bf="2")


def test_frames_come_in_order_at_the_times_of_the_stream(uneven: Path) -> None:
    source = open_source(uneven)
    frames = [f for f in source.read(0, 100) if isinstance(f, Frame)]
    assert source.info.kind == "video" and source.info.frame_count == 20
    assert [number_in(f) for f in frames] == list(range(20)) == [f.index for f in frames]
    np.testing.assert_allclose([f.time_s for f in frames], np.array(STAMPS) / 1000.0, atol=1e-3)
    assert any("--intrinsics" in what for what in source.info.missing)


@pytest.mark.parametrize("start", range(20))
def test_reading_from_any_start_is_the_same_as_from_the_first(uneven: Path, start: int) -> None:
    found = [f for f in open_source(uneven).read(start, start + 3) if isinstance(f, Frame)]
    assert [number_in(f) for f in found] == list(range(start, min(start + 3, 20)))
    assert found[0].time_s == pytest.approx(STAMPS[start] / 1000.0, abs=1e-3)


def test_every_start_stop_and_rate(uneven: Path) -> None:
    source = open_source(uneven, SourceOptions(every=4, start=3, stop=17, fps=10.0, intrinsics=(90, 90, 48, 32)))
    frames = [f for f in source.read(1, 4) if isinstance(f, Frame)]
    assert [f.index for f in frames] == [7, 11, 15] == [number_in(f) for f in frames]
    assert frames[0].time_s == pytest.approx(0.7)
    assert source.info.camera is not None and source.info.camera.width == 96 and not source.info.missing[1:]


def test_a_file_without_times_is_counted(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "a.avi", [33 * k for k in range(8)]))
    frames = [f for f in source.read(5, 8) if isinstance(f, Frame)]
    assert [number_in(f) for f in frames] == [5, 6, 7]


def test_a_turned_video_is_put_upright(tmp_path: Path) -> None:
    path = write_video(tmp_path / "turned.mp4", [33 * k for k in range(4)])
    data = bytearray(path.read_bytes())
    # The display matrix is the 36 bytes 40 after the track header's version; a quarter turn is (0 1 0 -1 0 0 0 0 1).
    at = data.index(b"tkhd") + 4 + 40
    one = 0x00010000
    matrix = [0, one, 0, -one, 0, 0, 0, 0, 0x40000000]
    data[at : at + 36] = b"".join(v.to_bytes(4, "big", signed=True) for v in matrix)
    path.write_bytes(bytes(data))
    source = open_source(path)
    frame = next(iter(source.read(0, 1)))
    assert isinstance(frame, Frame) and frame.color.shape == (96, 64, 3)
    # Shown turned by 90 degrees clockwise, the bright upper left corner stands at the upper right.
    assert frame.color[20, 50].mean() > 200 and frame.color[20, 10].mean() < 100
    assert any("turned" in note for note in source.info.notes)


def test_a_damaged_stretch_is_bad_and_the_rest_goes_on(tmp_path: Path) -> None:
    path = write_video(tmp_path / "d.mkv", [33 * k for k in range(40)], g="8", bf="0")
    whole = path.read_bytes()
    source = open_source(path)
    assert source.info.frame_count == 40
    path.write_bytes(whole[: int(len(whole) * 0.6)])
    found = list(source.read(0, 40))
    assert [f.index for f in found] == list(range(40))
    assert isinstance(found[0], Frame) and isinstance(found[39], BadFrame)


def test_a_file_cut_before_its_index_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "c.mp4", [33 * k for k in range(10)])
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(SourceError):
        open_source(path)


def test_depth_options_make_no_sense_for_a_video(uneven: Path) -> None:
    with pytest.raises(OptionError):
        open_source(uneven, SourceOptions(depth_intrinsics=(1, 1, 1, 1)))
    with pytest.raises(SourceError):
        open_source(uneven, SourceOptions(kind="tum"))
