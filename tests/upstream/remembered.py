"""A tiny network that remembers a few pictures with their depth and pose: real weights whose geometry is known.

The packages beside this file give it the names, inputs and outputs of networks whose own packages are not on every
machine, so that import paths, `from_pretrained`, device moves and conventions are run.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from huggingface_hub import PyTorchModelHubMixin
from torch import nn
from torch.nn import functional

SIDE = 12
"""Pictures are known again by thumbnails of this side."""


class Remembered(nn.Module, PyTorchModelHubMixin):
    """Looks pictures up among `pictures` that it remembers at `height` x `width`."""

    most = 10_000
    """Pictures of one pass; more run out of memory."""
    patch = 14
    """Side of the patches, px."""
    largest_pass = 0
    passes = 0

    def __init__(self, pictures: int = 2, height: int = 56, width: int = 56) -> None:
        super().__init__()
        self.thumbnail = nn.Parameter(torch.zeros(pictures, 3 * SIDE * SIDE))
        self.depth_seen = nn.Parameter(torch.ones(pictures, height, width))
        self.pose_seen = nn.Parameter(torch.eye(4).repeat(pictures, 1, 1))
        self.focal_share = nn.Parameter(torch.ones(()))

    def recall(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, float]:
        """Depth (n, h, w), camera-to-world poses (n, 4, 4) and focal length, px, of pictures (n, 3, h, w)."""
        cls = type(self)
        cls.passes += 1
        if len(pictures) > cls.most:
            raise torch.OutOfMemoryError(f"out of memory: {len(pictures)} pictures")
        cls.largest_pass = max(cls.largest_pass, len(pictures))
        assert pictures.dtype == torch.float32 and pictures.device == self.thumbnail.device
        assert pictures.shape[-1] % self.patch == 0 and pictures.shape[-2] % self.patch == 0
        assert float(pictures.min()) >= 0.0 and float(pictures.max()) <= 1.0
        small = functional.adaptive_avg_pool2d(pictures, SIDE).flatten(1)
        nearest = torch.cdist(small, self.thumbnail).argmin(dim=1)
        rows, columns = pictures.shape[-2:]
        covers = columns / self.depth_seen.shape[2]  # what was seen has the width of the pictures, and as much height
        height = rows if self.patch == 14 else round(self.depth_seen.shape[1] * covers)
        seen = self.depth_seen[nearest][:, None]
        depth = functional.interpolate(seen, size=(height, columns), mode="nearest-exact")[:, 0]
        cut = height // 2 - rows // 2
        return depth[:, cut : cut + rows], self.pose_seen[nearest], float(self.focal_share) * columns


def gauge(like: torch.Tensor, seed: int) -> tuple[torch.Tensor, float]:
    """A frame of reference and a scale of its own for each pass, as networks without a reference view choose them."""
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = q * np.linalg.det(q), rng.normal(size=3)
    return torch.from_numpy(T).to(like), float(rng.uniform(0.3, 3.0))


def moved(poses: torch.Tensor, scale: float, T: torch.Tensor | None = None) -> torch.Tensor:
    """Camera-to-world poses at another scale, in another frame."""
    out = poses.clone()
    out[:, :3, 3] *= scale
    return out if T is None else T @ out


def points(depth: torch.Tensor, focal: float) -> torch.Tensor:
    """Points (n, h, w, 3) in the cameras of depth images (n, h, w), whose pixels are square."""
    rows, columns = depth.shape[1:]
    x = (torch.arange(columns) - (columns - 1) / 2) / focal
    y = (torch.arange(rows) - (rows - 1) / 2) / focal
    slopes = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(rows, columns)], dim=-1)
    return torch.where(depth > 0, depth, 1.0)[..., None] * slopes


def placed(T: torch.Tensor, local: torch.Tensor) -> torch.Tensor:
    """Points (n, h, w, 3) moved by (n, 4, 4)."""
    return torch.einsum("nij,nhwj->nhwi", T[:, :3, :3], local) + T[:, None, None, :3, 3]


def expp1(depth: torch.Tensor) -> torch.Tensor:
    """Confidence 1 + exp(3) where depth is known, and 1 elsewhere."""
    return torch.where(depth > 0, 1 + math.e**3, 1.0)


def teach(
    cls: type[Remembered], folder: Path, colors: np.ndarray, depth: np.ndarray, poses: np.ndarray, focal: float
) -> Path:
    """Save a network that remembers pictures (n, H, W, 3), as its authors' packages save theirs; the folder."""
    model = cls(pictures=len(colors), height=depth.shape[1], width=depth.shape[2])
    stack = torch.from_numpy(colors).permute(0, 3, 1, 2).float() / 255.0
    cut = stack.shape[2] // 30 if cls.patch == 16 else 0  # pictures of 160 x 112 for frames of 4:3
    with torch.no_grad():
        seen = stack[:, :, cut : stack.shape[2] - cut]
        model.thumbnail.copy_(functional.adaptive_avg_pool2d(seen, SIDE).flatten(1))
        model.depth_seen.copy_(torch.from_numpy(depth))
        model.pose_seen.copy_(torch.from_numpy(poses).float())
        model.focal_share.copy_(torch.tensor(focal / colors.shape[2]))
    model.save_pretrained(folder, config={"pictures": len(colors), "height": depth.shape[1], "width": depth.shape[2]})
    return folder
