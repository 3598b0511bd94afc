"""The cameras of one source: raw colour and depth in, undistorted colour and registered metric depth out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.decoding.decode import clean_depth
from list3r.frames.decoding.shown import ShownPart
from list3r.frames.layout import FolderLayout, Optics
from list3r.frames.options import Intrinsics, SourceOptions
from list3r.frames.registration.reprojection import DepthReprojection, Undistortion
from list3r.frames.selection import working_size
from list3r.memory.core.errors import FrameError, OptionError, SourceError


def merge_optics(layout: FolderLayout, options: SourceOptions) -> tuple[Optics, tuple[str, ...]]:
    """Return what the layout knows, overruled by what the user says, with notes on what that leaves to assume."""
    optics, notes = layout.optics, []
    if options.registered:
        optics = replace(optics, depth_intrinsics=None, T_color_depth=None, shares_view=False)
        if layout.registered_intrinsics is not None:
            optics = replace(optics, intrinsics=layout.registered_intrinsics, distortion=())
    given: dict[str, Any] = {
        "intrinsics": options.intrinsics,
        "distortion": options.distortion,
        "depth_intrinsics": options.depth_intrinsics,
        "T_color_depth": None if options.T_color_depth is None else np.array(options.T_color_depth),
        "depth_scale": options.depth_scale,
    }
    optics = replace(optics, **{name: value for name, value in given.items() if value is not None})
    if options.distortion is not None:
        optics = replace(optics, fisheye=False)
    if options.intrinsics is not None:
        optics = replace(optics, intrinsics_size=None, by_user=True)
    if options.depth_intrinsics is not None:
        optics = replace(optics, depth_intrinsics_size=None)
    if optics.T_color_depth is not None and optics.depth_intrinsics is None:
        optics = replace(optics, depth_intrinsics=optics.intrinsics)
        notes.append("the depth camera is assumed to have the intrinsics of colour; --depth-intrinsics changes that")
    if optics.depth_intrinsics is not None and optics.T_color_depth is None:
        optics = replace(optics, T_color_depth=np.eye(4))
        notes.append("depth and colour camera are assumed to be at the same place; --depth-to-color changes that")
    return optics, tuple(notes)


@dataclass(frozen=True)
class Rig:
    """The cameras, ready to work."""

    camera: Camera | None
    """Pinhole camera of the frames handed out, None where intrinsics are unknown."""
    stored_size: tuple[int, int]
    """(height, width) of the colour pictures as stored, upright, px."""
    color_size: tuple[int, int]
    """(height, width) of the frames handed out, px."""
    depth_size: tuple[int, int] | None
    """(height, width) of the depth files, px."""
    depth_scale: float
    max_depth_m: float | None
    undistortion: Undistortion | None
    registration: DepthReprojection | None
    shares_view: bool = False
    """Depth is of the colour camera itself, so that a picture with a camera of its own has depth of that camera."""
    shown: ShownPart | None = None
    """The part of the pictures as stored that is handed out; None for all."""

    @property
    def shown_size(self) -> tuple[int, int]:
        """(height, width) of what is handed out, in pixels as stored."""
        return self.stored_size if self.shown is None else self.shown.size

    @property
    def whole_size(self) -> tuple[int, int]:
        """(height, width) of the whole pictures at the scale of what is handed out, px."""
        return _whole_size(self.stored_size, self.shown, self.color_size)

    def cut(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return what is handed out of a picture of `whole_size`. Shape (H, W, 3)."""
        y, x = _corner(self.stored_size, self.shown, self.color_size)
        return image[y : y + self.color_size[0], x : x + self.color_size[1]]

    def color(self, image: NDArray[np.uint8], lens: Camera | None = None) -> NDArray[np.uint8]:
        """Undistorted colour of a picture, which may have a camera of its own. Shape (H, W, 3).

        Raises `FrameError` for another size than the first frame's, or than its own camera states.
        """
        if lens is not None and self.camera is not None:
            return self._carried(image, lens, self.camera)
        if image.shape[:2] != self.stored_size:
            raise FrameError(f"colour is {_size(image.shape)}, most frames {_size(self.stored_size)}")
        if self.whole_size != self.stored_size:
            image = np.asarray(cv2.resize(image, self.whole_size[::-1], interpolation=cv2.INTER_AREA))
        return self.straight(np.ascontiguousarray(self.cut(image)))

    def _carried(self, image: NDArray[np.uint8], lens: Camera, camera: Camera) -> NDArray[np.uint8]:
        """What a camera of its own saw, as the camera of the source would have seen it. Shape (H, W, 3)."""
        if image.shape[:2] != (lens.height, lens.width):
            raise FrameError(f"colour is {_size(image.shape)}, its camera is stated for {lens.width}x{lens.height}")
        if lens.width > camera.width:
            lens = lens.shrunk_lens(camera.width)
            image = np.asarray(cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA))
        return Undistortion(lens, camera).color(image)

    def straight(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistorted colour of a picture that has the size of the frames handed out. Shape (H, W, 3)."""
        return image if self.undistortion is None else self.undistortion.color(image)

    def depth(self, raw: NDArray[Any], lens: Camera | None = None) -> NDArray[np.float32]:
        """Metric depth on the pixels of `camera`, seen by a camera of its own where the picture has one. Shape (H, W).

        Raises `FrameError` for another size.
        """
        if raw.shape != self.depth_size:
            raise FrameError(f"depth is {_size(raw.shape)}, most frames {_size(self.depth_size or (0, 0))}")
        depth = clean_depth(raw, self.depth_scale, self.max_depth_m)
        if lens is not None and self.shares_view and self.camera is not None:
            own = lens.pinhole().resized(*raw.shape)
            return depth if own == self.camera else DepthReprojection(own, self.camera, np.eye(4))(depth)
        if self.registration is not None:
            depth = self.registration(depth)
            return depth if self.undistortion is None else depth * self.undistortion.seen
        if depth.shape != self.color_size:
            depth = np.asarray(cv2.resize(depth, self.color_size[::-1], interpolation=cv2.INTER_NEAREST_EXACT))
        return depth if self.undistortion is None else self.undistortion.depth(depth)


WORKING_SIDES = (960, 1280)
"""Longest side of the frames handed out unless said otherwise, px: without depth, with depth."""


def build_rig(
    optics: Optics,
    stored_size: tuple[int, int],
    depth_size: tuple[int, int] | None,
    max_depth_m: float | None,
    max_side: int | None = None,
    shown: ShownPart | None = None,
) -> Rig:
    """Check the cameras against the first images and tabulate. Raises `SourceError` and `OptionError`.

    Frames larger than `max_side` are reduced, and the camera with them; see `SourceOptions.max_side`. Of pictures
    without depth the part that is `shown` is handed out; cameras are stated for the whole.
    """
    if optics.distortion and optics.intrinsics is None:
        raise SourceError("a lens distortion needs a camera; give --intrinsics fx,fy,cx,cy")
    limit = WORKING_SIDES[depth_size is not None] if max_side is None else max_side
    color_size = working_size(stored_size if shown is None else shown.size, limit)
    if optics.intrinsics is not None and not optics.by_user:
        _check_size(optics.intrinsics, optics.intrinsics_size or stored_size)
    stated = _camera(optics.intrinsics, optics.intrinsics_size or stored_size, "intrinsics", optics.distortion)
    if stated is not None and optics.fisheye:
        stated = replace(stated, fisheye=True)
    whole = _of_size(stated, stored_size, "the colour pictures")
    lens = None if whole is None else whole.resized(*_whole_size(stored_size, shown, color_size))
    if lens is not None and shown is not None:
        y, x = _corner(stored_size, shown, color_size)
        lens = replace(lens, width=color_size[1], height=color_size[0], cx=lens.cx - x, cy=lens.cy - y)
    camera = lens.pinhole() if lens else None
    undistortion = Undistortion(lens) if lens and (lens.distortion or lens.fisheye) else None
    registration = None
    if depth_size is not None:
        if optics.depth_scale is None:
            raise SourceError(
                "the units of the depth images are unknown; give --depth-scale UNITS_PER_METRE (1000: mm)"
            )
        registration = _registration(optics, whole, camera, (depth_size, stored_size))
    scale, shared = optics.depth_scale or 1.0, _is_shared(optics)
    return Rig(
        camera, stored_size, color_size, depth_size, scale, max_depth_m, undistortion, registration, shared, shown
    )


def _whole_size(stored: tuple[int, int], shown: ShownPart | None, size: tuple[int, int]) -> tuple[int, int]:
    if shown is None:
        return size
    scale = size[0] / shown.size[0], size[1] / shown.size[1]
    return round(stored[0] * scale[0]), round(stored[1] * scale[1])


def _corner(stored: tuple[int, int], shown: ShownPart | None, size: tuple[int, int]) -> tuple[int, int]:
    """Row and column of the whole pictures where what is handed out begins."""
    if shown is None:
        return 0, 0
    height, width = _whole_size(stored, shown, size)
    y, x = round(shown.top * height / stored[0]), round(shown.left * width / stored[1])
    return min(y, height - size[0]), min(x, width - size[1])


def _is_shared(optics: Optics) -> bool:
    return optics.shares_view and optics.depth_intrinsics is None and optics.intrinsics is not None


def _registration(
    optics: Optics, whole: Camera | None, camera: Camera | None, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> DepthReprojection | None:
    depth_size, color_size = sizes
    if whole is not None and camera is not None and _is_shared(optics):
        own = _of_size(whole.pinhole(), depth_size, "the depth images")
        return None if own is None or own == camera else DepthReprojection(own, camera, np.eye(4))
    if optics.depth_intrinsics is None:
        if depth_size != color_size:
            raise SourceError(
                f"depth images are {_size(depth_size)} but colour images {_size(color_size)}; give the depth camera by "
                "--depth-intrinsics fx,fy,cx,cy and its place by --depth-to-color"
            )
        return None
    if camera is None:
        raise SourceError("depth has a camera of its own but the colour camera has none; give --intrinsics fx,fy,cx,cy")
    given = _camera(optics.depth_intrinsics, optics.depth_intrinsics_size or depth_size, "depth intrinsics", ())
    depth_camera = _of_size(given, depth_size, "the depth images")
    assert depth_camera is not None and optics.T_color_depth is not None
    same = camera.pinhole() == depth_camera and np.allclose(optics.T_color_depth, np.eye(4), atol=1e-9)
    return None if same else DepthReprojection(depth_camera, camera, optics.T_color_depth)


def _of_size(camera: Camera | None, size: tuple[int, int], what: str) -> Camera | None:
    """Return the camera for images of another size and the same shape. Raises `SourceError` for another shape."""
    if camera is None or (camera.height, camera.width) == size:
        return camera
    if abs(camera.width * size[0] - camera.height * size[1]) > _MOST_SHEAR * camera.width * size[0]:
        stated = f"{camera.width}x{camera.height}"
        turned = "; they are turned" if (camera.height > camera.width) != (size[0] > size[1]) else ""
        raise SourceError(
            f"{what} are {_size(size)}, but the source states its camera for {stated}{turned}; give --intrinsics "
            "fx,fy,cx,cy for the pictures as they are"
        )
    return camera.resized(*size)


_MOST_SHEAR = 0.02
"""Most that two sizes of one camera's pictures differ in shape: 256 x 192 and 1920 x 1440 are alike, 640 x 360 not."""


def _camera(
    intrinsics: Intrinsics | None, size: tuple[int, int], name: str, distortion: tuple[float, ...]
) -> Camera | None:
    if intrinsics is None:
        return None
    height, width = size
    fx, fy, cx, cy = intrinsics
    if not (0 <= cx < width and 0 <= cy < height):
        raise OptionError(
            f"{name}: centre ({cx:g}, {cy:g}) lies outside pictures of {_size(size)}: give the intrinsics for "
            "pictures of this size"
        )
    if _off_middle(cx, cy, width, height) > _OFF_MIDDLE and _off_middle(cx, cy, height, width) < _IN_MIDDLE:
        raise OptionError(
            f"{name}: centre ({cx:g}, {cy:g}) is the middle of pictures of {height}x{width}, but these are "
            f"{_size(size)}: give the camera of the pictures as they stand upright"
        )
    return Camera(width, height, fx, fy, cx, cy, distortion)


def _check_size(intrinsics: Intrinsics, size: tuple[int, int]) -> None:
    """Raise `OptionError` for a camera whose centre is plainly the middle of pictures of another size."""
    (fx, fy, cx, cy), (height, width) = intrinsics, size
    x, y = (2 * cx + 1) / width, (2 * cy + 1) / height
    if not (min(x, y) > 0 and abs(x / y - 1) <= _ALIKE and (x <= 1 / _OTHER_SIZE or x >= _OTHER_SIZE)):
        return
    fitting = ",".join(f"{v:.6g}" for v in (fx / x, fy / y, (cx + 0.5) / x - 0.5, (cy + 0.5) / y - 0.5))
    raise OptionError(
        f"the source states a camera for pictures of {width}x{height}, but its centre ({cx:g}, {cy:g}) is the middle "
        f"of {round(x * width)}x{round(y * height)}; if it is the camera of those, give --intrinsics {fitting}"
    )


_ALIKE, _OTHER_SIZE = 0.05, 1.6
"""A centre that is as many times too far in x and y, within a share, is that of another size; from this factor on."""
_OFF_MIDDLE, _IN_MIDDLE = 0.1, 0.05
"""A camera's centre from the middle, as a share of the side: of pictures turned by a quarter, and of its own."""


def _off_middle(cx: float, cy: float, width: int, height: int) -> float:
    return max(abs(cx / width - 0.5), abs(cy / height - 0.5))


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
