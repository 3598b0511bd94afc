"""Video: the file's own clock, sides and damage, from any start, without holding it."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from list3r.frames.base import BadFrame, Frame
from list3r.frames.chunking.cuts import find_cuts
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import OptionError, SourceError


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


@pytest.mark.parametrize(("start", "stop", "step"), [(0, 20, 1), (3, 17, 4), (1, 20, 7), (18, 20, 5), (5, 5, 2)])
def test_reading_some_is_reading_all_and_leaving_out_the_rest(uneven: Path, start: int, stop: int, step: int) -> None:
    found = [number_in(f) for f in open_source(uneven).read_every(start, stop, step) if isinstance(f, Frame)]
    assert found == list(range(start, stop, step))


def test_every_start_stop_and_rate(uneven: Path) -> None:
    options = SourceOptions(every=4, start=3, stop=17, intrinsics=(90, 90, 48, 32), sharpest=False)
    source = open_source(uneven, options)
    frames = [f for f in source.read(1, 4) if isinstance(f, Frame)]
    assert [f.index for f in frames] == [7, 11, 15] == [number_in(f) for f in frames]
    assert frames[0].time_s == pytest.approx(STAMPS[7] / 1000.0, abs=1e-3)
    assert [source.position(n) for n in (3, 7, 15)] == [0, 1, 3]
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
    assert open_source(path, SourceOptions(intrinsics=(80.0, 80.0, 31.5, 47.5))).info.camera is not None
    with pytest.raises(OptionError, match=r"the middle of pictures of 96x64, but these are 64x96"):
        open_source(path, SourceOptions(intrinsics=(80.0, 80.0, 47.5, 31.5)))


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


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("a.mp4", "libx264", {"g": "7", "bf": "3", "x264-params": "open-gop=1:scenecut=0"}),
        ("b.mov", "libx264", {"g": "5", "bf": "2"}),
        ("c.mkv", "libx265", {"x265-params": "keyint=8:bframes=3:open-gop=1:log-level=none"}),
        ("d.webm", "libvpx-vp9", {"g": "6", "auto-alt-ref": "1", "lag-in-frames": "8"}),
        ("e.mp4", "mpeg4", {"g": "6", "bf": "2"}),
        ("f.avi", "mjpeg", {}),
        ("g.avi", "mpeg4", {"g": "6", "bf": "0"}),
    ],
)
def test_seeking_gives_exactly_the_frames_of_reading_through(
    tmp_path: Path, name: str, codec: str, options: dict[str, str]
) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg has no {codec}")
    source = open_source(write_moving(tmp_path / name, codec, options))
    through = [f for f in source.read(0, 30) if isinstance(f, Frame)]
    assert len(through) == 30 and [f.index for f in through] == list(range(30))
    for start in range(30):
        found = next(iter(source.read(start, start + 1)))
        assert isinstance(found, Frame) and found.index == start
        np.testing.assert_array_equal(found.color, through[start].color)
        assert found.time_s == through[start].time_s


def write_moving(path: Path, codec: str, options: dict[str, str], **more: object) -> Path:
    """Thirty frames of a noisy picture that moves, 30 a second."""
    world = np.random.default_rng(101).integers(0, 255, (80, 200, 3), dtype=np.uint8).repeat(2, 0).repeat(2, 1)
    pictures = [world[10 : 10 + 64, 4 * k : 4 * k + 96] for k in range(30)]
    return encode(path, codec, pictures, options, **more)


def encode(
    path: Path,
    codec: str,
    pictures: list[np.ndarray],
    options: dict[str, str],
    *,
    rotation: int = 0,
    mirrored: bool = False,
    aspect: Fraction | None = None,
    pixels: str | None = None,
) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixels or ("yuvj420p" if codec == "mjpeg" else "yuv420p")
        stream.options = options
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if rotation or mirrored:
            stream.set_display_rotation(rotation, hflip=mirrored)
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24" if picture.ndim == 3 else "gray")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.skipif(not hasattr(av.VideoFrame, "side_data"), reason="this PyAV reads no display matrix")
@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [False, True])
def test_all_eight_orientations_are_put_upright(tmp_path: Path, rotation: int, mirrored: bool) -> None:
    picture = np.full((64, 96, 3), 60, np.uint8)
    picture[:24, :40] = 220
    path = encode(tmp_path / "o.mp4", "libx264", [picture] * 3, {}, rotation=rotation, mirrored=mirrored)
    with av.open(str(path)) as container:
        matrix = np.frombuffer(bytes(next(container.decode(video=0)).side_data.get("DISPLAYMATRIX") or b""), np.int32)
    expected = picture if not len(matrix) else displayed(picture, matrix)
    frame = next(iter(open_source(path).read(0, 1)))
    assert isinstance(frame, Frame) and frame.color.shape == expected.shape
    assert np.abs(frame.color.astype(int) - expected).mean() < 8


def displayed(picture: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """A picture as ISO 14496-12 shows it: every pixel (x, y) goes to (a x + c y, b x + d y), moved into view."""
    a, b, _, c, d = matrix[:5].astype(int) // 65536
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    to_x, to_y = a * x + c * y, b * x + d * y
    to_x, to_y = to_x - to_x.min(), to_y - to_y.min()
    out = np.zeros((to_y.max() + 1, to_x.max() + 1, 3), np.uint8)
    out[to_y, to_x] = picture
    return out


def test_seconds_and_rates_follow_the_clock(uneven: Path) -> None:
    times = np.array(STAMPS) / 1000.0
    found = open_source(uneven, SourceOptions(start_s=0.2, end_s=0.7))
    assert [f.index for f in found.read(0, 99)] == np.flatnonzero((times >= 0.2) & (times < 0.7)).tolist()
    slow = open_source(uneven, SourceOptions(fps=5.0, sharpest=False))
    assert [f.index for f in slow.read(0, 99)] == [0, 4, 8, 12, 17, 19]
    assert open_source(uneven, SourceOptions(fps=1000.0)).info.frame_count == 20
    for options in (SourceOptions(start_s=5.0), SourceOptions(every=2, fps=5.0)):
        with pytest.raises(OptionError):
            open_source(uneven, options)
    for seconds in ({"start_s": -1.0}, {"end_s": 0.0}, {"start_s": 2.0, "end_s": 1.0}, {"start_s": float("nan")}):
        with pytest.raises(OptionError):
            SourceOptions(**seconds)


def test_the_sharpest_frame_of_each_window_is_taken_from_any_start(tmp_path: Path) -> None:
    sharp = [2, 3, 8, 14, 15, 21]
    still = np.random.default_rng(102).integers(0, 255, (32, 48, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    pictures = [still if k in sharp else cv2.blur(still, (1, 15 + k)) for k in range(22)]
    path = encode(tmp_path / "blurred.mp4", "libx264", pictures, {"g": "6", "bf": "2", "qp": "4"})
    source = open_source(path, SourceOptions(every=4))
    whole = list(source.read(0, 99))
    assert whole[2].index == 8
    assert whole[0].index in (2, 3) and whole[3].index in (14, 15) and whole[5].index == 21
    assert source.info.frame_count == 6 and any("sharpest" in note for note in source.info.notes)
    for position, frame in enumerate(whole):
        again = next(iter(source.read(position, position + 1)))
        assert isinstance(frame, Frame) and isinstance(again, Frame) and again.index == frame.index
        assert source.position(frame.index) == position
        np.testing.assert_array_equal(again.color, frame.color)
    assert [f.index for f in open_source(path, SourceOptions(every=4, sharpest=False)).read(0, 9)] == [
        0,
        4,
        8,
        12,
        16,
        20,
    ]


@pytest.mark.parametrize(("size", "pixels"), [((63, 95), "yuv444p"), ((64, 96), "gray"), ((64, 96), "yuv420p10le")])
def test_odd_sizes_grey_and_ten_bits(tmp_path: Path, size: tuple[int, int], pixels: str) -> None:
    picture = np.full((*size, 3), 40, np.uint8)
    picture[:30] = 200
    path = encode(tmp_path / "p.mkv", "ffv1", [picture] * 3, {}, pixels=pixels)
    frame = next(iter(open_source(path).read(0, 1)))
    assert isinstance(frame, Frame) and frame.color.shape == (*size, 3)
    assert np.abs(frame.color.astype(int) - picture).max() <= 12


def test_large_pictures_are_reduced_with_their_camera(tmp_path: Path) -> None:
    picture = np.zeros((1080, 1920, 3), np.uint8)
    picture[:, 960:] = 240
    path = encode(tmp_path / "large.mp4", "libx264", [picture] * 2, {"preset": "ultrafast"})
    source = open_source(path, SourceOptions(intrinsics=(1500, 1500, 959.5, 539.5)))
    camera = source.info.camera
    assert camera is not None and (camera.width, camera.height, camera.fx) == (960, 540, 750.0)
    assert (camera.cx, camera.cy) == (479.5, 269.5) and source.info.image_size == (540, 960)
    frame = next(iter(source.read(1, 2)))
    assert isinstance(frame, Frame) and frame.color.shape == (540, 960, 3)
    assert frame.color[:, :476].max() < 30 and frame.color[:, 484:].min() > 210
    assert any("--max-side" in note for note in source.info.notes)
    assert open_source(path, SourceOptions(max_side=0)).info.image_size == (1080, 1920)
    assert open_source(path, SourceOptions(max_side=100)).info.image_size == (56, 100)
    with pytest.raises(OptionError):
        SourceOptions(max_side=3)


def test_wide_pixels_are_made_square(tmp_path: Path) -> None:
    picture = np.full((64, 96, 3), 99, np.uint8)
    source = open_source(encode(tmp_path / "w.mkv", "libx264", [picture] * 2, {}, aspect=Fraction(4, 3)))
    assert source.info.image_size == (64, 128) and any("square" in note for note in source.info.notes)


def test_a_file_that_breaks_off_says_so_and_keeps_what_is_there(tmp_path: Path) -> None:
    path = write_moving(tmp_path / "whole.mp4", "libx264", {"g": "5", "movflags": "+faststart"})
    with (
        av.open(str(path)) as container,
        av.open(str(tmp_path / "fast.mp4"), "w", options={"movflags": "+faststart"}) as out,
    ):
        stream = out.add_stream_from_template(container.streams.video[0])
        for packet in container.demux(video=0):
            if packet.size:
                packet.stream = stream
                out.mux(packet)
    data = (tmp_path / "fast.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: int(len(data) * 0.6)])
    source = open_source(tmp_path / "cut.mp4")
    assert any("cut off" in note for note in source.info.notes)
    frames = list(source.read(0, 30))
    assert 10 <= sum(isinstance(f, Frame) for f in frames) < 30
    (tmp_path / "headless.mp4").write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    with pytest.raises(SourceError, match="complete"):
        open_source(tmp_path / "headless.mp4")


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), format="fltp", layout="stereo")
        frame.rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(SourceError, match="sound"):
        open_source(path)


def test_a_video_without_pictures_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "none.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.start_encoding()
    with pytest.raises(SourceError):
        open_source(path)


def test_thumbnails_tell_a_cut_in_one_pass(tmp_path: Path) -> None:
    rng = np.random.default_rng(103)
    worlds = [cv2.resize(rng.integers(0, 255, (30, 120, 3), np.uint8), (960, 240)) for _ in range(2)]
    pictures = [w[:, 8 * k : 8 * k + 320] for w in worlds for k in range(20)]
    source = open_source(encode(tmp_path / "cut.mp4", "libx264", pictures, {"g": "12"}))
    heard: list[tuple[int, int]] = []
    assert find_cuts(source, progress=lambda done, total: heard.append((done, total))) == (20,)
    assert heard == [(k + 1, 40) for k in range(40)]


def test_a_clip_as_phones_write_it(tmp_path: Path) -> None:
    """Uneven times, stored lying, shown upright, with the lens's 35 mm equivalent beside it."""
    path = tmp_path / "IMG_1.mov"
    stamps = np.cumsum([0, 33, 33, 50, 17, 33, 100, 33, 33, 33])
    tags = {"movflags": "use_metadata_tags"}
    with av.open(str(path), "w", options=tags) as container:
        container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = "26"
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = {"bf": "2", "g": "4"}
        stream.set_display_rotation(-90)
        for k, stamp in enumerate(stamps.tolist()):
            picture = np.full((64, 96, 3), 10 + 20 * k, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    source = open_source(path)
    frames = [f for f in source.read(0, 99) if isinstance(f, Frame)]
    np.testing.assert_allclose([f.time_s for f in frames], stamps / 1000.0, atol=1e-3)
    assert all(f.color.shape == (96, 64, 3) for f in frames) and source.info.image_size == (96, 64)
    assert [round((float(f.color.mean()) - 10) / 20) for f in frames] == list(range(10))
    guess = source.info.camera_guess
    assert source.info.camera is None and guess is not None
    assert guess.fx == pytest.approx(26 * np.hypot(64, 96) / np.hypot(36, 24)) and (guess.cx, guess.cy) == (31.5, 47.5)
