"""Of a container the colour stream is the picture, and of a picture what lies between its black bars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.core.records import SessionCamera
from list3r.pipeline.chunks.calibration import stated_camera
from tests.frames_scenes import write_png

COUNT = 12


def scene(k: int, width: int, height: int, dark: float = 1.0) -> NDArray[np.uint8]:
    """A picture of a place that moves by."""
    rng = np.random.default_rng(0)
    wide = cv2.resize(
        rng.integers(0, 255, (12, 24, 3), dtype=np.uint8), (2 * width, height), interpolation=cv2.INTER_CUBIC
    )
    return np.asarray(dark * wide[:, 3 * k : 3 * k + width], np.uint8)


def barred(k: int, size: tuple[int, int], inner: tuple[int, int], dark: float = 1.0) -> NDArray[np.uint8]:
    """A picture of `inner` (width, height) in the middle of a black one of `size`."""
    (W, H), (w, h) = size, inner
    out = np.zeros((H, W, 3), np.uint8)
    out[(H - h) // 2 : (H + h) // 2, (W - w) // 2 : (W + w) // 2] = scene(k, w, h, dark)
    return out


def write_film(path: Path, pictures: Sequence[NDArray[np.uint8]]) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode())
    return path


BARS = {
    "pillarbox": ((320, 180), (102, 180)),
    "letterbox": ((240, 180), (240, 136)),
    "both": ((320, 240), (240, 180)),
    "reduced": ((1600, 900), (1200, 900)),
}


@pytest.mark.parametrize("name", BARS)
@pytest.mark.parametrize("as_video", [True, False])
def test_black_bars_are_cut_off_and_the_camera_with_them(name: str, as_video: bool, tmp_path: Path) -> None:
    size, inner = BARS[name]
    pictures = [barred(k, size, inner, dark=0.0 if k == 0 else 1.0) for k in range(COUNT)]
    if as_video:
        path = write_film(tmp_path / "walk.mp4", pictures)
    else:
        path = tmp_path / "walk"
        for k, picture in enumerate(pictures):
            write_png(path / f"{k}.png", picture[:, :, ::-1])
    given = SourceOptions(intrinsics=(300.0, 300.0, (size[0] - 1) / 2 + 4, (size[1] - 1) / 2))
    source = open_source(path, given)
    info, camera = source.info, source.info.camera
    scale = min(1.0, 960 / max(inner))
    assert info.image_size == (round(inner[1] * scale), round(inner[0] * scale)) and camera is not None
    assert any("black bars are cut off" in note for note in info.notes)
    assert np.allclose([camera.fx, camera.fy], 300 * scale, rtol=0.01)
    assert abs(camera.cx - scale * ((inner[0] - 1) / 2 + 4)) < 1 and abs(camera.cy - scale * (inner[1] - 1) / 2) < 1
    frame = next(f for f in source.read(5, 6) if isinstance(f, Frame))
    truth = cv2.resize(scene(5, *inner), info.image_size[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(frame.color.astype(int) - truth).mean() < 8
    assert info.stored_size == (inner[1], inner[0])
    assert info.corner == ((size[1] - inner[1]) // 2, (size[0] - inner[0]) // 2)


def test_pictures_without_bars_stay_whole(tmp_path: Path) -> None:
    night = [scene(k, 160, 120, dark=0.05) for k in range(COUNT)]
    door = [scene(k, 160, 120) for k in range(COUNT)]
    for picture in door:  # dark on both sides, but not up to one line
        cv2.fillPoly(picture, [np.array([[0, 0], [60, 0], [10, 119], [0, 119]])], (0, 0, 0))
        cv2.fillPoly(picture, [np.array([[159, 0], [100, 0], [149, 119], [159, 119]])], (0, 0, 0))
    once = [barred(k, (160, 120), (80, 120)) if k < 6 else scene(k, 160, 120) for k in range(COUNT)]
    for name, pictures in {"night": night, "door": door, "once": once}.items():
        info = open_source(write_film(tmp_path / f"{name}.mp4", pictures)).info
        assert info.image_size == (120, 160) and not any("bars" in note for note in info.notes), name


def test_an_estimated_camera_is_that_of_the_whole_picture_again(tmp_path: Path) -> None:
    path = write_film(tmp_path / "walk.mp4", [barred(k, (320, 180), (102, 180)) for k in range(COUNT)])
    (y, x), found = open_source(path).info.corner, (90.0, 90.0, 50.5, 89.5)
    options = stated_camera(SourceOptions(), SessionCamera((*found[:2], found[2] + x, found[3] + y), (), ()))
    camera = open_source(path, options).info.camera
    assert camera is not None and np.allclose([camera.fx, camera.fy, camera.cx, camera.cy], found)


def write_container(path: Path, colour: tuple[int, int] | None, depth: tuple[int, int], title: str) -> Path:
    """A recording of colour and of 16-bit grey, the depth first."""
    with av.open(str(path), "w") as container:
        streams = []
        deep = container.add_stream("ffv1", rate=30)
        deep.width, deep.height, deep.pix_fmt = *depth, "gray16le"
        deep.metadata["title"] = title
        streams.append((deep, "gray16le", lambda k: np.full(depth[::-1], 1000 + k, np.uint16)))
        if colour is not None:
            seen = container.add_stream("mjpeg", rate=30)
            seen.width, seen.height, seen.pix_fmt = *colour, "yuvj420p"
            streams.append((seen, "rgb24", lambda k: scene(k, *colour)))
        for stream, form, picture in streams:
            for k in range(COUNT):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k), form)))
            container.mux(stream.encode())
    return path


@pytest.mark.parametrize("title", ["DEPTH", ""])
@pytest.mark.parametrize("depth", [(64, 48), (256, 256)])
def test_the_colour_stream_is_the_picture_and_depth_is_said(depth: tuple[int, int], title: str, tmp_path: Path) -> None:
    path = write_container(tmp_path / "k4a.mkv", (160, 90), depth, title)
    info = open_source(path).info
    assert info.image_size == (90, 160)
    (said,) = [note for note in info.notes if "depth and infrared are not read" in note]
    assert f"{depth[0]}x{depth[1]}" in said and "images" in said
    with pytest.raises(OptionError, match="no depth that is read"):
        SourceOptions(depth_scale=1000.0).check_fits(info)


def test_a_container_of_depth_alone_is_refused(tmp_path: Path) -> None:
    for name, title in (("walk.mkv", "DEPTH"), ("depth.mkv", "")):
        with pytest.raises(SourceError, match="holds depth and no colour"):
            open_source(write_container(tmp_path / name, None, (64, 48), title))


def test_the_case_of_a_stranger_shows_its_colour(shared_data: Path) -> None:
    path = shared_data / "cases/depth_stream_taken_as_picture/k4a.mkv"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    assert open_source(path).info.image_size == (180, 320)
