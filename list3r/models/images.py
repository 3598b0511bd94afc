"""Pictures as networks want them: resized, normalised, padded. No torchvision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
HALF = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class InputShape:
    """How a picture is brought to a network's size."""

    height: int
    width: int
    """Size of the network's input, px."""
    keep_aspect: bool = False
    """Scale by one factor, fill up at the right and at the bottom; else stretch both sides."""
    black: bool = False
    """Fill up with black instead of the mean colour."""
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[float, float, float] = IMAGENET_STD

    def inner(self, height: int, width: int) -> tuple[int, int]:
        """Height and width, in network pixels, that a picture of the given size covers."""
        if not self.keep_aspect:
            return self.height, self.width
        scale = min(self.height / height, self.width / width)
        return max(1, round(height * scale)), max(1, round(width * scale))


def sam_input(model: str, size: int) -> InputShape:
    """Return what the networks of the SAM family take: a square, normalised otherwise since SAM 3."""
    mean, std = (HALF, HALF) if model == "sam3" else (IMAGENET_MEAN, IMAGENET_STD)
    return InputShape(size, size, mean=mean, std=std)


def normalised(
    pictures: torch.Tensor, mean: Sequence[float] = IMAGENET_MEAN, std: Sequence[float] = IMAGENET_STD
) -> torch.Tensor:
    """Pictures (..., 3, h, w) in [0, 1], each channel shifted and scaled; by default as for DINOv2."""
    return (pictures - pictures.new_tensor(mean).view(3, 1, 1)) / pictures.new_tensor(std).view(3, 1, 1)


def network_input(
    color: NDArray[np.uint8], shape: InputShape, device: torch.device, dtype: torch.dtype
) -> torch.Tensor:
    """Return a picture (H, W, 3) as a batch of one, normalised. Shape (1, 3, height, width)."""
    import torch
    from torch.nn import functional

    picture = torch.from_numpy(np.ascontiguousarray(color)).to(device).permute(2, 0, 1)[None].float() / 255.0
    inner = shape.inner(*color.shape[:2])
    if inner != tuple(color.shape[:2]):
        picture = functional.interpolate(picture, size=inner, mode="bilinear", align_corners=False, antialias=True)
    pad = (0, shape.width - inner[1], 0, shape.height - inner[0])
    if any(pad) and shape.black:
        picture = functional.pad(picture, pad)
    picture = normalised(picture, shape.mean, shape.std)
    return functional.pad(picture, pad).to(dtype) if any(pad) and not shape.black else picture.to(dtype)


def to_picture(maps: torch.Tensor, shape: InputShape, height: int, width: int) -> torch.Tensor:
    """Maps of the network (N, h, w), over its whole input, cut to the picture and resized to it. (N, height, width)."""
    from torch.nn import functional

    inner = shape.inner(height, width)
    rows = max(1, round(maps.shape[-2] * inner[0] / shape.height))
    columns = max(1, round(maps.shape[-1] * inner[1] / shape.width))
    cut = maps[None, :, :rows, :columns].float()
    if len(maps) == 0:
        return cut.new_zeros((0, height, width))
    return functional.interpolate(cut, size=(height, width), mode="bilinear", align_corners=False)[0]
