"""What a reader of a folder finds, before any image is decoded."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.files import MAX_LIST_BYTES, MAX_TEXT_BYTES, open_ordinary, read_file
from list3r.frames.listing import FrameFiles
from list3r.frames.options import Intrinsics, check_distortion, check_intrinsics, intrinsics_of_matrix
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.core.unpacking import parse_json

MAX_LENGTH_M = 1e6
"""No camera stands further from where its numbers begin; single precision is 6 cm there."""
_MOST_LINES, _LONGEST_LINE, _MOST_NUMBERS = 2**22, 2**22, 2**23
"""Of one list: lines, characters of a line, numbers. A line of COLMAP has every feature of a picture."""
IMAGE_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


@dataclass(frozen=True)
class Optics:
    """Cameras of a source as far as they are known."""

    intrinsics: Intrinsics | None = None
    """Colour camera, px."""
    distortion: tuple[float, ...] = ()
    """Colour camera, OpenCV."""
    depth_intrinsics: Intrinsics | None = None
    """Depth camera, px; None where depth lies on the colour pixels."""
    T_color_depth: NDArray[np.float64] | None = None
    """Depth to colour camera, metres; None where depth lies on the colour pixels. Shape (4, 4)."""
    depth_scale: float | None = None
    """Stored units per metre."""
    intrinsics_size: tuple[int, int] | None = None
    """(height, width) of the pictures that `intrinsics` are stated for; None for the pictures as stored."""
    depth_intrinsics_size: tuple[int, int] | None = None
    """(height, width) of the images that `depth_intrinsics` are stated for; None for depth as stored."""
    fisheye: bool = False
    """The distortion is that of OpenCV's fisheye, (k1, k2, k3, k4)."""
    shares_view: bool = False
    """Depth is of the colour camera itself, if at another size; `depth_intrinsics` say otherwise."""
    by_user: bool = False
    """`intrinsics` are the user's word, not that of a file: a centre far from the middle is taken as it is."""


@dataclass(frozen=True)
class FolderLayout:
    """A folder that was recognised."""

    kind: str
    files: FrameFiles
    optics: Optics
    poses_of: str = "color"
    """The camera whose poses are given: color or depth."""
    registered_intrinsics: Intrinsics | None = None
    """Colour camera to use when the user says that depth is registered after all, px."""
    notes: tuple[str, ...] = field(default=())
    least_confidence: int | None = None
    """Depth whose confidence (0, 1, 2) is less than this is unknown; None where there is no confidence."""
    poses_metric: bool = True
    """Whether given poses are in metres."""
    z_up: bool = False
    """Whether the recorder's gravity makes z of the given poses' world point up."""
    poses_drift: bool = False
    """Whether given poses were followed as the recording went on and never put right: they drift, and may jump."""
    read: tuple[str, ...] = ()
    """Names in the folder, beside the files of frames, that were read."""
    upright_tags: bool = True
    """Whether pictures are turned as their EXIF says; not where intrinsics and poses are those of the stored pixels."""


VARIES = 0.003
"""Frames whose focal lengths differ by a larger share have each a camera of its own; 1 % is a centimetre 2 m away."""


def varies_note(spread: float, carried: bool) -> str:
    """Return what is by_user of frames whose focal lengths differ by a share."""
    what = "all frames are resampled to one camera" if carried else "one camera serves all of them"
    return f"focal lengths of frames differ by {100 * spread:.1f} %: {what}"


def usual_camera(cameras: Sequence[Camera]) -> Camera:
    """Return the camera that stands for all: the only one, or the median pinhole of those of the most usual size."""
    if len(cameras) == 1:
        return cameras[0]
    width, height = Counter((c.width, c.height) for c in cameras).most_common(1)[0][0]
    same = [(c.fx, c.fy, c.cx, c.cy) for c in cameras if (c.width, c.height) == (width, height)]
    return Camera(width, height, *np.median(np.array(same), axis=0).tolist())


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key under which `frame2` comes before `frame10`."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name.lower()) if part]


def read_numbers(path: Path) -> list[list[float]]:
    """Rows of numbers of a text file; `#` starts a comment. Raises `SourceError` naming file and line."""
    rows = []
    count = 0
    for row in iter_numbers(path):
        count += len(row)
        if count > _MOST_NUMBERS:
            raise SourceError(f"{path} holds over {_MOST_NUMBERS:,} numbers, more than a list of poses has")
        rows.append(row)
    return rows


def iter_numbers(path: Path) -> Iterator[list[float]]:
    """As `read_numbers`, row by row."""
    for number, line in enumerate(read_lines(path), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        try:
            row = [float(word) for word in words]
        except ValueError:
            raise SourceError(f"{path}: line {number} is not numbers; fix or remove it") from None
        if row:
            yield row


def read_text(path: Path) -> str:
    """Return the text of a file. Raises `SourceError`."""
    try:
        return read_file(path, MAX_TEXT_BYTES).decode("utf-8", "replace")
    except OSError as error:
        raise SourceError(f"{path} cannot be read ({error.strerror}); check its permissions") from None


def read_lines(path: Path, *, whole: bool = False) -> Iterator[str]:
    """Lines of a text file, one by one; with `whole` a last one that has no end is left out.

    Raises `SourceError`, also for more and longer ones than any list has.
    """
    try:
        with TextIOWrapper(open_ordinary(path, MAX_LIST_BYTES), "utf-8", "replace") as file:
            _check_lines(path, file)
            yield from (line.rstrip("\n") for line in file if not whole or line.endswith("\n"))
    except OSError as error:
        raise SourceError(f"{path} cannot be read ({error.strerror}); check its permissions") from None


def _check_lines(path: Path, file: TextIOWrapper) -> None:
    """Raise `SourceError` for more and longer lines than any list has, counted before one is taken out."""
    count = unended = 0
    for block in iter(lambda: file.read(_LONGEST_LINE), ""):
        first, last = block.find("\n"), block.rfind("\n")
        count += block.count("\n")
        unended += len(block) if first < 0 else first
        if count > _MOST_LINES:
            raise SourceError(f"{path} has over {_MOST_LINES:,} lines; give a part of it")
        if unended > _LONGEST_LINE:
            raise SourceError(f"{path} has a line of over {_LONGEST_LINE >> 20} MiB; is it damaged?")
        unended = unended if first < 0 else len(block) - 1 - last
    file.seek(0)


def pose_matrix(values: Iterable[float]) -> NDArray[np.float64] | None:
    """A 4x4 rigid pose of 12 or 16 numbers row by row, None when they are no rigid motion (NaN, zeros, mirrored)."""
    v = np.array(list(values), dtype=np.float64)
    if len(v) not in (12, 16) or not np.isfinite(v).all() or np.abs(v).max() > MAX_LENGTH_M:
        return None
    if not np.allclose(v[12:], [0.0, 0.0, 0.0, 1.0][: len(v) - 12], atol=1e-3):
        return None
    matrix = np.eye(4)
    matrix[:3] = v.reshape(-1, 4)[:3]
    u, scales, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(scales - 1.0).max() > 0.05 or np.linalg.det(matrix[:3, :3]) < 0:
        return None
    matrix[:3, :3] = u @ vt
    return matrix


def read_calibration(root: Path) -> tuple[Intrinsics, tuple[float, ...]] | None:
    """Intrinsics and distortion from `calibration.txt`, one line `fx fy cx cy [k1 k2 p1 p2 k3]`, if it is there.

    Raises `SourceError` when it is there and says something else.
    """
    path = root / "calibration.txt"
    if not path.is_file():
        return None
    values = [v for row in read_numbers(path) for v in row]
    if not 4 <= len(values) <= 9:
        raise SourceError(f"{path} has {len(values)} numbers; one line fx fy cx cy [k1 k2 p1 p2 k3] is needed")
    try:
        return check_intrinsics(values[:4]), check_distortion(values[4:]) if values[4:] else ()
    except OptionError as error:
        raise SourceError(f"{path}: {error}") from None


def read_camera_matrix(path: Path) -> Intrinsics:
    """fx, fy, cx, cy of a text file that holds a camera matrix. Raises `SourceError`."""
    try:
        return intrinsics_of_matrix([v for row in read_numbers(path) for v in row])
    except OptionError as error:
        raise SourceError(f"{path}: {error}; fix it, or give --intrinsics fx,fy,cx,cy") from None


def inside(root: Path, name: str, stated_in: Path) -> Path:
    """Return the path of a name, also as Windows writes it, within a folder.

    Raises `SourceError` for one that leads out of it.
    """
    path = root / name.replace("\\", "/")
    led = path.name == ".." or path.is_symlink()
    if not (path.resolve().is_relative_to(root.resolve()) if led else _lies_in(path.parent, root)):
        raise SourceError(f"{stated_in} names {name}, which lies outside of {root}; copy it there or correct the name")
    return path


@lru_cache(maxsize=64)
def _lies_in(folder: Path, root: Path) -> bool:
    """Return whether a folder lies in another; lists of a million names have few folders."""
    return folder.resolve().is_relative_to(root.resolve())


def read_json(path: Path) -> object:
    """Parsed JSON. Raises `SourceError`."""
    try:
        return parse_json(read_text(path))
    except ValueError as error:
        where = f"line {error.lineno}" if isinstance(error, json.JSONDecodeError) else str(error)
        raise SourceError(f"{path} is not valid JSON ({where}); fix or remove it") from None
