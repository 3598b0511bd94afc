"""Folders of pictures of any kind: order, EXIF, depth of colour, size; and which of them are handed out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from list3r.frames.base import Frame, guessed_camera
from list3r.frames.decoding.exif import exif_focal
from list3r.frames.inspection import SourceReport
from list3r.frames.selection import select, sharpness, working_size
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import OptionError
from tests.frames_scenes import color_image, depth_image, write_png

EXIF_IFD = 0x8769


def write_photo(path: Path, size: tuple[int, int] = (400, 300), orientation: int = 1, **tags: object) -> Path:
    """A JPEG whose upper left quarter is bright, as stored, with EXIF tags by their PIL names."""
    names = {
        "focal_35mm": 0xA405,
        "focal_mm": 0x920A,
        "density": 0xA20E,
        "unit": 0xA210,
        "wide": 0xA002,
        "high": 0xA003,
    }
    picture = np.full((size[1], size[0], 3), 40, np.uint8)
    picture[: size[1] // 2, : size[0] // 2] = 220
    exif = Image.Exif()
    exif[0x0112] = orientation
    ifd = exif.get_ifd(EXIF_IFD)
    for name, value in tags.items():
        ifd[names[name]] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, exif=exif, quality=95)
    return path


def first(folder: Path, **options: object) -> np.ndarray:
    frame = next(iter(open_source(folder, SourceOptions(**options)).read(0, 1)))  # type: ignore[arg-type]
    assert isinstance(frame, Frame)
    return frame.color


def test_the_focal_length_of_exif_is_a_start_and_no_camera(tmp_path: Path) -> None:
    path = write_photo(tmp_path / "p" / "img1.jpg", focal_35mm=26)
    diagonal_px, diagonal_mm = 500.0, np.hypot(36.0, 24.0)
    assert exif_focal(path) == pytest.approx(26 * diagonal_px / diagonal_mm)
    info = open_source(tmp_path / "p").info
    assert info.camera is None and info.image_size == (300, 400)
    camera = guessed_camera(info)
    assert camera.fx == pytest.approx(300.46, abs=0.1) and (camera.cx, camera.cy) == (199.5, 149.5)
    report = SourceReport(info)
    assert report.as_dict()["size"] == [400, 300] and "EXIF" in "\n".join(report.lines())
    known = open_source(tmp_path / "p", SourceOptions(intrinsics=(310, 310, 200, 150))).info
    assert known.camera_guess is None and known.camera is not None and known.camera.fx == 310


def test_the_focal_length_from_the_sensor(tmp_path: Path) -> None:
    # 4 mm before 1/100 mm pixels is 400 px, of a picture twice as wide as what is stored now.
    path = write_photo(tmp_path / "a.jpg", focal_mm=4.0, density=1000.0, unit=3, wide=800, high=600)
    assert exif_focal(path) == pytest.approx(200.0)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {"focal_35mm": 0},
        {"focal_mm": 4.0},
        {"focal_35mm": 2000},
        {"focal_35mm": 26, "wide": 4000, "high": 2000},
        {"focal_mm": 4.0, "density": 1000.0, "unit": 9},
    ],
)
def test_exif_that_says_nothing_that_can_be_believed(tmp_path: Path, tags: dict[str, object]) -> None:
    assert exif_focal(write_photo(tmp_path / "a.jpg", **tags)) is None


def test_files_without_exif(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", color_image(1))
    (tmp_path / "b.jpg").write_bytes(b"\xff\xd8 not a picture")
    assert exif_focal(tmp_path / "a.png") is None and exif_focal(tmp_path / "b.jpg") is None
    assert exif_focal(tmp_path / "absent.jpg") is None


def test_the_orientation_of_exif_is_obeyed_and_the_guess_turns_with_it(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg", orientation=6, focal_35mm=26)
    info = open_source(tmp_path).info
    assert info.image_size == (400, 300)
    shown = first(tmp_path)
    assert shown.shape == (400, 300, 3) and shown[50, 250].mean() > 200 and shown[50, 50].mean() < 60
    assert guessed_camera(info).cx == 149.5


def test_natural_order(tmp_path: Path) -> None:
    for number in (10, 2, 1, 30):
        write_png(tmp_path / f"img{number}.png", np.full((20, 30, 3), number, np.uint8))
    found = [int(f.color[0, 0, 0]) for f in open_source(tmp_path).read(0, 9) if isinstance(f, Frame)]
    assert found == [1, 2, 10, 30]


def test_grey_sixteen_bits_alpha_and_odd_sizes_become_rgb(tmp_path: Path) -> None:
    write_png(tmp_path / "grey/1.png", np.full((21, 31), 77, np.uint8))
    write_png(tmp_path / "deep/1.png", np.full((21, 31, 3), 77 * 256, np.uint16))
    write_png(tmp_path / "deepgrey/1.png", np.full((21, 31), 77 * 256, np.uint16))
    write_png(tmp_path / "alpha/1.png", np.full((21, 31, 4), 77, np.uint8))
    Image.fromarray(np.full((21, 31, 2), 77, np.uint8), mode="LA").save(tmp_path / "la.png")
    for name in ("grey", "deep", "deepgrey", "alpha"):
        picture = first(tmp_path / name)
        assert picture.shape == (21, 31, 3) and picture.dtype == np.uint8 and (picture == 77).all(), name


def test_large_pictures_are_reduced_and_registered_depth_with_them(tmp_path: Path) -> None:
    for k in range(2):
        write_png(tmp_path / f"rgb/{k}.png", color_image(k, 1600, 1200))
        write_png(tmp_path / f"depth/{k}.png", depth_image(1.0 + k, 1000, 1600, 1200))
    options = {"depth_scale": 1000.0, "intrinsics": (1500, 1500, 799.5, 599.5)}
    source = open_source(tmp_path, SourceOptions(**options))  # type: ignore[arg-type]
    frame = next(iter(source.read(1, 2)))
    assert isinstance(frame, Frame) and frame.depth is not None
    assert frame.color.shape == (960, 1280, 3) and frame.depth.shape == (960, 1280) and (frame.depth == 2.0).all()
    camera = source.info.camera
    assert camera is not None and (camera.width, camera.fx, camera.cx) == (1280, 1200.0, 639.5)
    assert first(tmp_path, max_side=0, **options).shape == (1200, 1600, 3)


def test_a_reduced_point_lands_where_the_reduced_camera_projects_it(tmp_path: Path) -> None:
    picture = np.zeros((900, 1200, 3), np.uint8)
    cv2.circle(picture, (700, 300), 12, (255, 255, 255), -1)
    write_png(tmp_path / "1.png", picture)
    source = open_source(tmp_path, SourceOptions(intrinsics=(1000, 1000, 599.5, 449.5), max_side=400))
    frame, camera = next(iter(source.read(0, 1))), source.info.camera
    assert isinstance(frame, Frame) and camera is not None
    y, x = np.nonzero(frame.color[..., 0] > 127)
    ray = ((700 - 599.5) / 1000, (300 - 449.5) / 1000)
    assert x.mean() == pytest.approx(camera.fx * ray[0] + camera.cx, abs=0.15)
    assert y.mean() == pytest.approx(camera.fy * ray[1] + camera.cy, abs=0.15)


def test_the_sharpest_of_a_folder_where_asked_for(tmp_path: Path) -> None:
    still = color_image(104, 60, 45).repeat(6, 0).repeat(6, 1)
    for k in range(9):
        write_png(tmp_path / f"{k}.png", still if k in (1, 5, 6) else cv2.GaussianBlur(still, (0, 0), 4))
    options = {"every": 3, "sharpest": True}
    source = open_source(tmp_path, SourceOptions(**options))  # type: ignore[arg-type]
    assert [f.index for f in source.read(0, 9)] == [1, 5, 6] and [source.position(n) for n in (1, 5, 6)] == [0, 1, 2]
    assert [f.index for f in source.read(2, 3)] == [6]
    assert [f.index for f in open_source(tmp_path, SourceOptions(every=3)).read(0, 9)] == [0, 3, 6]


def test_blur_and_black_are_less_sharp() -> None:
    gray = color_image(105, 640, 480)[..., 0]
    levels = [sharpness(cv2.GaussianBlur(gray, (0, 0), s)) for s in (1.0, 2.0, 4.0, 8.0)]
    assert levels == sorted(levels, reverse=True) and sharpness(np.zeros((480, 640), np.uint8)) == 0.0


@given(st.integers(1, 9000), st.integers(1, 9000), st.integers(32, 2000))
def test_working_sizes_keep_the_shape(height: int, width: int, limit: int) -> None:
    h, w = working_size((height, width), limit)
    assert max(h, w) == min(max(height, width), limit) and abs(h * width - w * height) <= max(height, width)


@given(
    gaps=st.lists(st.floats(0.005, 1.0), min_size=1, max_size=60),
    rate=st.floats(0.2, 50.0),
    sharpest=st.booleans(),
)
def test_rates_are_kept_whatever_the_clock(gaps: list[float], rate: float, sharpest: bool) -> None:
    times = np.cumsum([5.0, *gaps])
    options = SourceOptions(fps=rate, sharpest=sharpest)
    chosen = select(times, options, Path("x"), clock=True, video=True)
    assert (
        chosen.starts[0] == 0 and (np.diff(chosen.starts) > 0).all() and (chosen.stops[:-1] <= chosen.starts[1:]).all()
    )
    assert len(chosen) <= (times[-1] - times[0]) * rate + 1 + 1e-3
    for number in range(len(times)):
        position = chosen.position(number)
        assert chosen.starts[position] <= number and (not chosen.sharpest or number < chosen.stops[position])


def test_nothing_left_is_said_in_the_words_of_the_options(tmp_path: Path) -> None:
    write_png(tmp_path / "1.png", color_image(1))
    for options, word in ((SourceOptions(start_s=3.0), "seconds 3"), (SourceOptions(start=4), "frames 4:")):
        with pytest.raises(OptionError, match=word):
            open_source(tmp_path, options)
