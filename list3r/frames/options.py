"""What a user may say about a source, and how the words of the command line become numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.files import MAX_TEXT_BYTES, read_file
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.frames.base import SourceInfo

KINDS = (
    "auto",
    "record3d",
    "stray",
    "polycam",
    "scannerapp",
    "arkitscenes",
    "scannet",
    "scannetpp",
    "rosbag",
    "lerobot",
    "aria",
    "euroc",
    "nerfstudio",
    "7scenes",
    "tum",
    "replica",
    "colmap",
    "images",
    "video",
)
"""Kinds of sources; docs/sources.md says what each is made of."""

ROLES = ("color", "depth", "pose")
"""What topics of a ROS recording, and cameras of LeRobot, can be."""

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, px."""
Rows = tuple[tuple[float, ...], ...]
"""A 4x4 matrix as nested tuples, so that options can be compared and hashed."""


@dataclass(frozen=True)
class SourceOptions:
    """What is known of a source. What is left out is read from the source or known for its layout."""

    kind: str = "auto"
    """One of `KINDS`."""
    every: int = 1
    """Hand out every n-th frame."""
    start: int | None = None
    """First frame number handed out, counted in the source from 0, before `every`."""
    stop: int | None = None
    """Frame number to stop before."""
    intrinsics: Intrinsics | None = None
    """fx, fy, cx, cy of the colour camera, px."""
    distortion: tuple[float, ...] | None = None
    """k1, k2, p1, p2, k3 of the colour camera (OpenCV); trailing zeros may be left out."""
    depth_intrinsics: Intrinsics | None = None
    """fx, fy, cx, cy of the depth camera, px, where it is not the colour camera."""
    T_color_depth: Rows | None = None
    """Rigid transform from the depth to the colour camera, metres. Shape (4, 4)."""
    registered: bool = False
    """Depth already lies on the colour image's pixels, whatever the layout usually means."""
    depth_scale: float | None = None
    """Stored depth units per metre."""
    topics: tuple[tuple[str, str], ...] | None = None
    """For a ROS recording (role, topic) with the roles color, depth and pose; by default those that fit. For a LeRobot
    data set (role, key of a camera)."""
    fps: float | None = None
    """Frames per second to hand out; for a source without a clock, the rate it was filmed at."""
    max_depth_m: float | None = None
    """Depth beyond this counts as unknown, metres."""
    start_s: float | None = None
    """Hand out frames from this time on, seconds after the source's first frame."""
    end_s: float | None = None
    """Hand out frames before this time, seconds after the source's first frame."""
    sharpest: bool | None = None
    """Hand out the sharpest frame of each group instead of the first; None: for videos only."""
    max_side: int | None = None
    """Longest side of the frames handed out, px; larger pictures are reduced. 0 for as stored; None: 960, 1280 with
    depth. Intrinsics are given for pictures as stored."""
    more: tuple[str, ...] | None = None
    """Further video files of the same recording, in order."""
    episode: int | None = None
    """Number of the episode of a LeRobot data set."""

    def check_fits(self, info: SourceInfo) -> None:
        """Raise `OptionError` for what is said of a depth camera that the source has not got."""
        options = {
            "--depth-scale": self.depth_scale is not None,
            "--depth-intrinsics": self.depth_intrinsics is not None,
            "--depth-to-color": self.T_color_depth is not None,
            "--registered": self.registered,
        }
        given = [option for option, is_given in options.items() if is_given]
        if given and not info.has_depth:
            why = next((f" that is read ({n})" for n in info.notes if "not read" in n and "depth" in n), "")
            raise OptionError(f"{info.path} has no depth{why}; leave out {' and '.join(given)}")

    def topics_by_role(self) -> dict[str, str]:
        """Return the topics that were chosen, by role."""
        return dict(self.topics or ())

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise OptionError(f"source kind {self.kind!r} is unknown; choose one of {', '.join(KINDS)}")
        if unknown := sorted(set(self.topics_by_role()) - set(ROLES)):
            raise OptionError(f"topics of {', '.join(unknown)}: the roles are {', '.join(ROLES)}")
        if self.every < 1:
            raise OptionError(f"every {self.every}: give 1 or more")
        if (self.start or 0) < 0 or (self.stop is not None and self.stop <= (self.start or 0)):
            raise OptionError(f"frames {self.start} to {self.stop}: start must be 0 or more and stop greater than it")
        for name in ("depth_scale", "fps", "max_depth_m"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise OptionError(f"{name.replace('_', ' ')} {value}: give a positive number")
        _check_seconds(self.start_s, self.end_s)
        if self.max_side is not None and self.max_side != 0 and self.max_side < _LEAST_SIDE:
            raise OptionError(f"max side {self.max_side}: at least {_LEAST_SIDE} px, or 0 for pictures as they are")
        for name in ("intrinsics", "depth_intrinsics"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, check_intrinsics(getattr(self, name), name.replace("_", " ")))
        if self.distortion is not None:
            object.__setattr__(self, "distortion", check_distortion(self.distortion))
        if self.T_color_depth is not None:
            rows = check_rigid(np.asarray(self.T_color_depth, dtype=np.float64), "depth to color")
            object.__setattr__(self, "T_color_depth", tuple(tuple(float(v) for v in row) for row in rows))
        if self.registered and (self.depth_intrinsics or self.T_color_depth):
            raise OptionError(
                "registered depth has no camera of its own: leave out --depth-intrinsics and --depth-to-color"
            )


_LEAST_SIDE = 32


def _check_seconds(start: float | None, end: float | None) -> None:
    """Raises `OptionError` for seconds that leave nothing of any source."""
    given = [v for v in (start, end) if v is not None]
    if not all(math.isfinite(v) for v in given) or (start or 0.0) < 0 or (end is not None and end <= (start or 0.0)):
        last = "the end" if end is None else f"{end:g}"
        raise OptionError(f"seconds {start or 0:g} to {last}: start must be 0 or more and end greater than it")


def check_intrinsics(values: Sequence[float], name: str = "intrinsics") -> Intrinsics:
    """Four finite numbers with positive focal lengths, px. Raises `OptionError`."""
    if len(values) != 4 or not all(math.isfinite(v) for v in values) or values[0] <= 0 or values[1] <= 0:
        raise OptionError(f"{name} {_show(values)}: give four numbers fx,fy,cx,cy in px, such as 525,525,320,240")
    return (float(values[0]), float(values[1]), float(values[2]), float(values[3]))


def intrinsics_of_matrix(numbers: Sequence[float]) -> Intrinsics:
    """fx, fy, cx, cy of a camera matrix of 9 or 16 numbers, row by row or column by column. Raises `OptionError`."""
    side = {9: 3, 16: 4}.get(len(numbers))
    if side is None:
        raise OptionError(f"a camera matrix of {len(numbers)} numbers: give 3x3 or 4x4")
    m = np.array(numbers, np.float64).reshape(side, side)
    if not m[0, 2] and not m[1, 2]:
        m = m.T
    return check_intrinsics([float(m[0, 0]), float(m[1, 1]), float(m[0, 2]), float(m[1, 2])])


_MOST_DISTORTION = 100.0


def check_distortion(values: Sequence[float]) -> tuple[float, ...]:
    """OpenCV's k1, k2, p1, p2, k3, filled up with zeros; empty when all are zero. Raises `OptionError`."""
    if len(values) > 5 or not all(math.isfinite(v) for v in values):
        raise OptionError(f"distortion {_show(values)}: give up to five numbers k1,k2,p1,p2,k3")
    if any(abs(v) > _MOST_DISTORTION for v in values):
        raise OptionError(f"distortion {_show(values)}: no lens has more than {_MOST_DISTORTION:g}")
    full = tuple(float(v) for v in values) + (0.0,) * (5 - len(values))
    return full if any(full) else ()


def check_rigid(matrix: NDArray[np.float64], name: str = "transform") -> NDArray[np.float64]:
    """Return a rigid 4x4 matrix with its rotation made exact. Raises `OptionError` for anything else."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise OptionError(f"{name}: give a 4x4 rigid matrix with last row 0,0,0,1")
    u, scales, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(scales - 1.0).max() > 0.01 or np.linalg.det(matrix[:3, :3]) < 0:
        raise OptionError(f"{name}: the upper left 3x3 block is not a rotation")
    out = matrix.copy()
    out[:3, :3] = u @ vt
    return out


def parse_numbers(text: str, name: str) -> list[float]:
    """Numbers separated by commas, semicolons or white space. Raises `OptionError` naming the word that is none."""
    words = text.replace(",", " ").replace(";", " ").split()
    out = []
    for word in words:
        try:
            out.append(float(word))
        except ValueError:
            raise OptionError(f"{name} {text!r}: {word!r} is not a number") from None
    return out


def parse_intrinsics(text: str, name: str = "intrinsics") -> Intrinsics:
    """`fx,fy,cx,cy` in px. Raises `OptionError`."""
    return check_intrinsics(parse_numbers(text, name), name)


def parse_distortion(text: str) -> tuple[float, ...]:
    """`k1,k2,p1,p2,k3`, trailing zeros may be left out. Raises `OptionError`."""
    return check_distortion(parse_numbers(text, "distortion"))


def parse_transform(text: str, name: str = "depth to color", quaternion: Literal["xyzw", "wxyz"] = "xyzw") -> Rows:
    """Return a rigid transform from text, or from a text file that is named.

    16 numbers are a 4x4 matrix row by row, 12 its upper three rows, 7 are `tx,ty,tz` in metres and a quaternion in
    the order that `quaternion` says, 3 a translation. Raises `OptionError`.
    """
    words = _file_text(text)
    if words is None and _names_a_file(text):
        raise OptionError(f"{name} {text!r}: there is no such file, and it is not a row of numbers such as tx,ty,tz")
    v = np.array(parse_numbers(words or text, name))
    if len(v) not in (3, 7, 12, 16):
        order = ",".join("q" + letter for letter in quaternion)
        raise OptionError(f"{name} {text!r}: give 16 numbers (4x4) or tx,ty,tz,{order}, not {len(v)}")
    matrix = np.eye(4)
    if len(v) >= 12:
        matrix[: len(v) // 4] = v.reshape(-1, 4)
    else:
        matrix[:3, 3] = v[:3]
    if len(v) == 7:
        xyzw = v[3:] if quaternion == "xyzw" else np.roll(v[3:], -1)
        if not abs(np.linalg.norm(xyzw) - 1.0) < 0.01:
            raise OptionError(f"{name} {text!r}: the last four numbers must be a unit quaternion {quaternion}")
        matrix[:3, :3] = Rotation.from_quat(xyzw).as_matrix()
    return tuple(tuple(float(x) for x in row) for row in check_rigid(matrix, name))


def parse_topics(text: str) -> tuple[tuple[str, str], ...]:
    """`color=/a,depth=/b,pose=/c`, any of them. Raises `OptionError`."""
    pairs = [tuple(part.strip() for part in word.partition("=")[::2]) for word in text.split(",") if word.strip()]
    if not pairs or any(not role or not topic for role, topic in pairs):
        raise OptionError(f"topics {text!r}: write them as color=/camera/color/image_raw,depth=/camera/depth/image_raw")
    return tuple((role, topic) for role, topic in pairs)


def parse_range(text: str) -> tuple[int | None, int | None]:
    """`start:stop` frame numbers, either may be left out. Raises `OptionError`."""
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first) if first.strip() else None, int(last) if last.strip() else None
    except ValueError:
        start, colon, stop = None, "", None
    if not colon or (start or 0) < 0 or (stop is not None and stop <= (start or 0)):
        raise OptionError(f"frames {text!r}: give start:stop with start below stop, such as 100:400")
    return start, stop


def _file_text(text: str) -> str | None:
    """Return the contents of the file that `text` names, None if it names none."""
    if any(sign in text for sign in ",;\n") or not text.strip():
        return None
    try:
        path = Path(text)
        return read_file(path, MAX_TEXT_BYTES).decode("utf-8") if path.is_file() else None
    except (OSError, ValueError):
        return None


def _names_a_file(text: str) -> bool:
    """Return whether text that is no number can only be meant as a file: it has letters and no comma."""
    try:
        float(text)
    except ValueError:
        return not any(sign in text for sign in ",; \n") and bool(text.strip())
    return False


def _show(values: Sequence[float]) -> str:
    return ",".join(f"{v:g}" for v in values)
