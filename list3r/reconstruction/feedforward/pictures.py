"""How a frame becomes a network's picture, as in each network's own loader, and the frame's placement in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from list3r.frames.base import Camera

PATCH = 14
"""Side of the patches into which networks after DINOv2 cut a picture, px."""
Picture = NDArray[np.uint8]
Resample = Callable[[Picture, int, int], Picture]
"""A picture (H, W, 3) at another height and width."""


@dataclass(frozen=True)
class Placement:
    """A frame scaled to `inner` and then cropped or padded to `size`; both are height and width, px."""

    inner: tuple[int, int]
    size: tuple[int, int]
    top: int = 0
    left: int = 0
    """Row and column of the picture at which the scaled frame begins; below zero where it is cropped."""

    def camera_matrix(self, camera: Camera) -> NDArray[np.float64]:
        """Return the intrinsic matrix of the picture, pixel centres at whole numbers, px. Shape (3, 3)."""
        K = camera.resized(*self.inner).matrix()
        K[:2, 2] += (self.left, self.top)
        return K

    def whole(self, maps: NDArray[np.float32]) -> NDArray[np.float32]:
        """Maps of the picture (n, h, w) as maps of the scaled frame, 0 where it was cropped. Shape (n, *inner)."""
        if self.inner == self.size:
            return maps
        out = np.zeros((len(maps), *self.inner), maps.dtype)
        inside, outside = self._spans()
        out[:, outside[0], outside[1]] = maps[:, inside[0], inside[1]]
        return out

    def picture(self, scaled: Picture) -> Picture:
        """Crop a scaled frame, or pad it with white. Shape (*size, 3)."""
        if self.inner == self.size:
            return scaled
        out = np.full((*self.size, 3), 255, np.uint8)
        inside, outside = self._spans()
        out[inside] = scaled[outside]
        return out

    def _spans(self) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Return the rows and columns of the picture that show the frame, and the corresponding ones of the frame."""
        inside, outside = [], []
        for first, full, has in zip((self.top, self.left), self.inner, self.size, strict=True):
            start, stop = max(first, 0), min(first + full, has)
            inside.append(slice(start, stop))
            outside.append(slice(start - first, stop - first))
        return (inside[0], inside[1]), (outside[0], outside[1])


class Loader(Protocol):
    """The preprocessing of a network's own loader."""

    def place(self, height: int, width: int) -> Placement:
        """Return the placement of a frame of a size in its picture."""
        ...

    @property
    def resample(self) -> Resample:
        """The filter with which it scales."""
        ...


def pictures(colors: Sequence[Picture], placement: Placement, resample: Resample) -> Picture:
    """Return the pictures that a network sees of frames (H, W, 3). Shape (n, *size, 3)."""
    return np.stack([placement.picture(resample(c, *placement.inner)) for c in colors])


def by_pillow(smaller: Image.Resampling, larger: Image.Resampling, color: Picture, height: int, width: int) -> Picture:
    """Scale as Pillow does, by one filter for shrinking and one for enlarging."""
    chosen = smaller if max(height, width) < max(color.shape[:2]) else larger
    return np.asarray(Image.fromarray(color).resize((width, height), chosen))


def by_area(longest: int, color: Picture, height: int, width: int) -> Picture:
    """Scale as OpenCV does, first the longer side to `longest`, then to whole patches."""
    scale = longest / max(color.shape[:2])
    for rows, columns in ((round(color.shape[0] * scale), round(color.shape[1] * scale)), (height, width)):
        grows = rows > color.shape[0] or columns > color.shape[1]
        size = (max(1, columns), max(1, rows))
        color = np.asarray(
            cv2.resize(color, size, interpolation=cv2.INTER_CUBIC if grows else cv2.INTER_AREA), np.uint8
        )
    return color


LANCZOS: Resample = partial(by_pillow, Image.Resampling.LANCZOS, Image.Resampling.LANCZOS)
BICUBIC: Resample = partial(by_pillow, Image.Resampling.BICUBIC, Image.Resampling.BICUBIC)
LANCZOS_OR_BICUBIC: Resample = partial(by_pillow, Image.Resampling.LANCZOS, Image.Resampling.BICUBIC)


@dataclass(frozen=True)
class PictureSize:
    """The whole frame, stretched to whole patches (the loaders of pi3 and Depth Anything 3)."""

    max_pixels: int | None = None
    """Most pixels, or None."""
    longest: int | None = None
    """Longest side, px, or None."""
    resample: Resample = LANCZOS

    def of(self, height: int, width: int) -> tuple[int, int]:
        """Height and width, multiples of `PATCH`, for frames of a size."""
        scale = 1.0 if self.longest is None else self.longest / max(height, width)
        if self.max_pixels is not None:
            scale = math.sqrt(self.max_pixels / (height * width))
        rows, columns = (max(1, round(side * scale / PATCH)) for side in (height, width))
        while self.max_pixels is not None and rows * columns * PATCH * PATCH > self.max_pixels:
            if columns / rows > width / height:
                columns -= 1
            else:
                rows -= 1
        return max(1, rows) * PATCH, max(1, columns) * PATCH

    def place(self, height: int, width: int) -> Placement:
        size = self.of(height, width)
        return Placement(size, size)


@dataclass(frozen=True)
class PaddedSize:
    """The longer side of one length; pictures taller than wide are padded to a square with white (VGGT, "pad")."""

    longest: int
    resample: Resample = BICUBIC

    def place(self, height: int, width: int) -> Placement:
        short = max(1, round(min(height, width) * self.longest / max(height, width) / PATCH)) * PATCH
        if width >= height:
            return Placement((short, self.longest), (short, self.longest))
        return Placement((self.longest, short), (self.longest, self.longest), left=(self.longest - short) // 2)


@dataclass(frozen=True)
class WidthSize:
    """One width; pictures taller than wide are cropped to their middle (VGGT, "crop", used by its own programs)."""

    width: int
    resample: Resample = BICUBIC

    def place(self, height: int, width: int) -> Placement:
        inner = max(1, round(height * self.width / width / PATCH)) * PATCH, self.width
        shown = min(inner[0], self.width)
        return Placement(inner, (shown, self.width), -((inner[0] - shown) // 2))


@dataclass(frozen=True)
class CutSize:
    """The longer side of one length, then the middle of whole patches; squares are cut to 4:3 (DUSt3R and after it)."""

    longest: int
    patch: int = 16
    resample: Resample = LANCZOS_OR_BICUBIC

    def place(self, height: int, width: int) -> Placement:
        scale = self.longest / max(height, width)
        inner = round(height * scale), round(width * scale)
        rows, columns = (max(1, 2 * (side // 2) // self.patch) * self.patch for side in inner)
        if inner[0] == inner[1]:
            rows = 3 * columns // 4
        top, left = inner[0] // 2 - rows // 2, inner[1] // 2 - columns // 2
        return Placement(inner, (rows, columns), -top, -left)


@dataclass(frozen=True)
class TabledSize:
    """The size of a table whose shape is nearest, covered by the frame, whose middle it shows (MapAnything)."""

    shapes: tuple[tuple[float, int, int], ...]
    """Width by height, and the corresponding width and height, px."""
    resample: Resample = LANCZOS_OR_BICUBIC

    def place(self, height: int, width: int) -> Placement:
        _, columns, rows = min(self.shapes, key=lambda shape: abs(shape[0] - width / height))
        scale = max(columns / width, rows / height) + 1e-8
        inner = math.floor(height * scale), math.floor(width * scale)
        return Placement(inner, (rows, columns), -((inner[0] - rows) // 2), -((inner[1] - columns) // 2))


def fitted(camera: Camera, size: tuple[int, int]) -> Placement:
    """The placement of frames of a camera in the middle of pictures of another size, padded with white."""
    scale = min(size[0] / camera.height, size[1] / camera.width)
    inner = min(size[0], round(camera.height * scale)), min(size[1], round(camera.width * scale))
    return Placement(inner, size, (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2)
