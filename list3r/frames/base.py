"""What comes in: a frame, what is known of its source, and the protocol every reader keeps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from list3r.frames.selection import FrameSelection

Listing = Callable[[int, int], None]
"""Hears how far a recording is listed: parts looked at, and in all."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel (0, 0) is the centre of the upper left pixel."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """OpenCV's (k1, k2, p1, p2, k3), empty for none. Frames handed out by a source are already undistorted."""
    fisheye: bool = False
    """The distortion is that of OpenCV's fisheye, (k1, k2, k3, k4) of the angle from the axis (Kannala and Brandt)."""

    def matrix(self) -> NDArray[np.float64]:
        """Return the intrinsic matrix, px. Shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pinhole(self) -> Camera:
        """Return the same camera without lens distortion."""
        return replace(self, distortion=(), fisheye=False)

    def resized(self, height: int, width: int) -> Camera:
        """Return the camera of its pictures at another size."""
        if (height, width) == (self.height, self.width):
            return self
        x, y = width / self.width, height / self.height
        cx, cy = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return Camera(width, height, self.fx * x, self.fy * y, cx, cy, self.distortion, self.fisheye)

    def every(self, stride: int) -> Camera:
        """Return the camera of its pictures with every `stride`-th pixel kept, from the first."""
        height, width = -(-self.height // stride), -(-self.width // stride)
        return Camera(width, height, self.fx / stride, self.fy / stride, self.cx / stride, self.cy / stride)

    def shrunk(self, width: int) -> Camera:
        """Return the pinhole camera of its pictures at most `width` px wide, of the same shape."""
        return self.pinhole().shrunk_lens(width)

    def shrunk_lens(self, width: int) -> Camera:
        """Return the camera, with its lens, of its pictures at most `width` px wide, of the same shape."""
        width = min(width, self.width)
        return self.resized(max(1, round(self.height * width / self.width)), width)


@dataclass(frozen=True)
class Frame:
    """One frame as every later stage sees it: undistorted colour, depth registered into it, pose where given."""

    index: int
    """Number in the source, from 0 (before `every` thins it out, so that it names the same picture for ever)."""
    time_s: float
    """Seconds of the source's own clock; index / 30 where it has none."""
    color: NDArray[np.uint8]
    """RGB. Shape (H, W, 3)."""
    depth: NDArray[np.float32] | None
    """Depth along the colour camera's z, metres, 0 where unknown, on the colour image's pixels. Shape (H, W)."""
    T_source_cam: NDArray[np.float64] | None
    """Given pose of the colour camera in the source's own world, if the source has one. Shape (4, 4)."""

    def gray(self, width: int | None = None) -> NDArray[np.uint8]:
        """Return the picture in grey, shrunk to a longer side of at most `width` px. Shape (H, W)."""
        import cv2

        gray = np.asarray(cv2.cvtColor(self.color, cv2.COLOR_RGB2GRAY), np.uint8)
        scale = 1.0 if width is None else min(1.0, width / max(gray.shape))
        size = (max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale)))
        return gray if scale == 1.0 else np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True)
class SourceInfo:
    """What was recognised in a source, and what is missing from it."""

    kind: str
    """7scenes, tum, replica, images, video."""
    path: str
    frame_count: int
    """Frames that will be handed out, after `every`."""
    fps: float
    camera: Camera | None
    """Pinhole camera of the frames handed out, None where the intrinsics are unknown."""
    has_depth: bool
    has_poses: bool
    fingerprint: str
    """Changes when the source or the options that shape its frames change; guards `--resume`."""
    depth_camera: Camera | None = None
    """The depth sensor's own camera where it is not the colour camera; None when depth comes registered."""
    T_color_depth: NDArray[np.float64] | None = None
    """Rigid transform from depth to colour camera, metres. Shape (4, 4). None when depth comes registered."""
    depth_scale: float | None = None
    """Stored depth units per metre."""
    notes: tuple[str, ...] = field(default=())
    """What was assumed, one sentence each."""
    image_size: tuple[int, int] | None = None
    """Height and width of the frames handed out, px."""
    stored_size: tuple[int, int] | None = None
    """Height and width of the pictures as stored, upright, without bars, where frames are made smaller; None where they
    may not be.
    """
    corner: tuple[int, int] = (0, 0)
    """Row and column of the stored pictures, upright, where what is handed out begins: black bars are cut off."""
    poses_metric: bool = True
    """Whether given poses are in metres; a model of COLMAP has a unit of its own."""
    z_up: bool = False
    """Whether the recorder's gravity makes z of the given poses' world point up."""
    poses_drift: bool = False
    """Whether given poses were followed as the recording went on and never put right: they drift, and may jump."""
    camera_guess: Camera | None = None
    """What the files' own words (EXIF) say of an unknown camera: good to a few per cent, a start and no more."""

    @property
    def scale_kind(self) -> str:
        """metric or relative."""
        return "metric" if self.has_depth else "relative"

    @property
    def missing(self) -> tuple[str, ...]:
        """What is missing, and what then is done, one sentence each."""
        lacking = "there is no depth: build takes colour alone (--reconstruction sfm or a network)"
        out = [] if self.has_depth else [lacking]
        if self.camera is None:
            option = "--intrinsics fx,fy,cx,cy"
            done = f"give {option}" if self.has_depth else f"build estimates them; {option} is more accurate"
            out.append(f"the camera's intrinsics are unknown: {done}")
        return tuple(out)


GUESSED_FOCAL = 1.2
"""Focal length of an unknown camera by the longer side of its picture (a field of view of 45 degrees, between a
phone's main camera, 65, and its tele lens)."""


def guessed_camera(info: SourceInfo) -> Camera:
    """A pinhole camera for a source whose intrinsics are unknown, for models that find the focal length themselves."""
    if info.camera_guess is not None:
        return info.camera_guess
    assert info.image_size is not None
    height, width = info.image_size
    focal = GUESSED_FOCAL * max(width, height)
    return Camera(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)


@dataclass(frozen=True)
class BadFrame:
    """A frame that could not be decoded."""

    index: int
    reason: str


class LazyFrame(Frame):
    """A frame whose colour and depth are read when one of them is first asked for: of a slow video most never are.

    One that then cannot be decoded is black and has no depth.
    """

    def __init__(
        self,
        index: int,
        time_s: float,
        T_source_cam: NDArray[np.float64] | None,
        read: Callable[[], Frame | BadFrame],
    ) -> None:
        self.__dict__.update(index=index, time_s=time_s, T_source_cam=T_source_cam, _read=read)

    def __getattr__(self, name: str) -> Any:
        if name not in ("color", "depth"):
            raise AttributeError(name)
        frame = self.__dict__["_read"]()
        if isinstance(frame, BadFrame):
            frame = Frame(self.index, self.time_s, np.zeros((1, 1, 3), np.uint8), None, None)
        self.__dict__.update(color=frame.color, depth=frame.depth)
        return self.__dict__[name]

    def let_go(self) -> None:
        """Forget the picture, which is read again where it is asked for again."""
        for name in ("color", "depth"):
            self.__dict__.pop(name, None)


class FrameSource(ABC):
    """Frames by position. A source can be opened again in another process by `open_source` with the same options."""

    _info: SourceInfo
    _chosen: FrameSelection
    """The frames handed out; sources that hold others have their `position`."""

    @property
    def info(self) -> SourceInfo:
        """What was recognised. Cheap: nothing is decoded beyond a first frame."""
        return self._info

    def read(self, start: int, stop: int) -> Iterator[Frame | BadFrame]:
        """Frames at positions [start, stop) in order; one that cannot be decoded comes as a `BadFrame`."""
        return self.read_every(start, stop, 1)

    @abstractmethod
    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        """As `read`, but only each `step`-th frame from `start` on."""

    def position(self, index: int) -> int:
        """Return where a frame (Frame.index) is among those handed out."""
        return self._chosen.position(index)

    def read_some(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        """As `read`, but the pictures of frames at positions that are no multiple of `step` are read when looked at."""
        for position, frame in enumerate(self.read(start, stop), start):
            if position % step and isinstance(frame, Frame):
                again = partial(lambda at: next(iter(self.read(at, at + 1))), position)
                frame = LazyFrame(frame.index, frame.time_s, frame.T_source_cam, again)
            yield frame

    def read_poses(self) -> list[tuple[int, float, NDArray[np.float64]]]:
        """Frame.index, seconds and pose of the colour camera of every frame that has one; no picture is decoded."""
        return []

    def read_grays(self, start: int, stop: int) -> Iterator[NDArray[np.uint8] | None]:
        """Grey pictures at positions [start, stop), large enough for local features; None for one that is damaged."""
        for frame in self.read(start, stop):
            yield None if isinstance(frame, BadFrame) else frame.gray()

    def thumbnails(self) -> Iterator[NDArray[np.uint8] | None]:
        """Small grey pictures of all frames in order, in one pass; None for one that is damaged."""
        return self.read_grays(0, self.info.frame_count)

    def look(self, spots: int) -> Iterator[tuple[int, str]]:
        """Frame.index of frames at so many places and why each cannot be used, empty where it can.

        The steps between the places are not even, which misses no pattern.
        """
        count = self.info.frame_count
        places = np.linspace(0, 1, min(spots, count)) ** (1.0 if count < spots else 1.1)
        for position in np.unique((places * (count - 1)).round().astype(int)).tolist():
            for frame in self.read(position, position + 1):
                yield frame.index, frame.reason if isinstance(frame, BadFrame) else ""


def index_at(source: FrameSource, position: int) -> int:
    """Return the number in the source of the frame at a position."""
    return next((f.index for f in source.read(position, position + 1)), position)
