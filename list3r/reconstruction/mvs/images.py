"""Frames of a chunk as inputs of the stereo: small grey pictures, cameras and poses as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame

Tensor = torch.Tensor
Poses = NDArray[np.float64]


@dataclass(frozen=True)
class Pictures:
    """Every frame of a chunk at one size."""

    gray: Tensor
    """Brightness in [0, 1]. Shape (F, h, w)."""
    camera: Camera
    """Pinhole camera of that size."""


def make_pictures(frames: Sequence[Frame], camera: Camera, width: int, device: str) -> Pictures:
    """All frames in grey at `width` px."""
    small = camera.shrunk(width)
    out = np.empty((len(frames), small.height, small.width), np.float32)
    for number, frame in enumerate(frames):
        gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        out[number] = cv2.resize(gray, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return Pictures(torch.from_numpy(out / 255.0).to(device), small)


def sharpness(gray: NDArray[np.float32]) -> float:
    """Return the sharpness of a picture: variance of its Laplacian."""
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


@dataclass(frozen=True)
class Warp:
    """Projection of one picture's pixels into another: x ~ rotated + inverse depth * shift, homogeneous pixels."""

    rotated: Tensor
    """Shape (3, h, w)."""
    shift: Tensor
    """Shape (3,)."""

    @staticmethod
    def between(T_chunk_ref: Poses, T_chunk_other: Poses, camera: Camera, device: str) -> Warp:
        """From the pixels of `ref` into `other`; both have the same camera."""
        T = np.linalg.inv(T_chunk_other) @ T_chunk_ref
        K = camera.matrix()
        turned = K @ T[:3, :3] @ np.linalg.inv(K)
        rotated = (turned @ _pixels(camera.height, camera.width)).reshape(3, camera.height, camera.width)
        return Warp(
            torch.from_numpy(rotated.astype(np.float32)).to(device),
            torch.from_numpy((K @ T[:3, 3]).astype(np.float32)).to(device),
        )

    def place(self, inverse_depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x and y in px and z over depth in the other picture for inverse depths that broadcast to (..., h, w)."""
        ratio = self.rotated[2] + inverse_depth * self.shift[2]
        safe = ratio.clamp_min(1e-4)
        x = (self.rotated[0] + inverse_depth * self.shift[0]) / safe
        y = (self.rotated[1] + inverse_depth * self.shift[1]) / safe
        outside = torch.full((), -1e4, device=x.device)
        return torch.where(ratio > 1e-4, x, outside), y, ratio


@lru_cache(maxsize=4)
def _pixels(height: int, width: int) -> NDArray[np.float64]:
    """Homogeneous coordinates of the pixels of a picture. Shape (3, height * width)."""
    v, u = np.mgrid[:height, :width].astype(np.float64)
    return np.stack([u, v, np.ones_like(u)]).reshape(3, -1)


def stacked(images: Sequence[Tensor]) -> NDArray[np.float32]:
    """Return tensors of one shape as one array, in the memory of the processor."""
    return np.stack([image.cpu().numpy() for image in images])


def look_up(image: Tensor, x: Tensor, y: Tensor, mode: str = "bilinear") -> tuple[Tensor, Tensor]:
    """Values of an image (h, w) at positions (..., h', w'), and which of these are inside it."""
    height, width = image.shape
    grid = torch.stack([x * (2.0 / max(width - 1, 1)) - 1.0, y * (2.0 / max(height - 1, 1)) - 1.0], dim=-1)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    flat = grid.reshape(1, -1, grid.shape[-2], 2)
    values = torch.nn.functional.grid_sample(
        image[None, None], flat, mode=mode, padding_mode="border", align_corners=True
    )
    return values.reshape(x.shape), inside


def box_sum(values: Tensor, radius: int) -> Tensor:
    """Sums over windows of 2 radius + 1 squared, the picture replicated beyond its border. Shape (..., h, w)."""
    if radius == 0:
        return values
    shape = values.shape
    padded = torch.nn.functional.pad(values.reshape(1, -1, *shape[-2:]), (radius,) * 4, mode="replicate")[0]
    rows = _run_sum(padded, 2 * radius + 1, -1)
    return _run_sum(rows, 2 * radius + 1, -2).reshape(shape)


def greatest_around(values: Tensor, reach: int) -> Tensor:
    """Return the greatest of values (h, w) in a square window. Shape (h, w)."""
    size = 2 * reach + 1
    if values.device.type == "cpu":
        return torch.from_numpy(cv2.dilate(values.numpy(), np.ones((size, size), np.uint8)))
    return torch.nn.functional.max_pool2d(values[None, None], size, 1, reach)[0, 0]


def _run_sum(values: Tensor, length: int, dim: int) -> Tensor:
    count = values.shape[dim] - length + 1
    out = values.narrow(dim, 0, count).clone()
    for start in range(1, length):
        out += values.narrow(dim, start, count)
    return out
