"""A tiny network that remembers a few pictures with their depth and pose: real weights whose geometry is known.

The packages beside this file give it the names, inputs and outputs of networks whose own packages are not on every
machine, so that import paths, `from_pretrained`, device moves and conventions are run.
"""

from __future__ import annotations

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
        assert pictures.shape[-1] % 14 == 0 and pictures.shape[-2] % 14 == 0
        assert float(pictures.min()) >= 0.0 and float(pictures.max()) <= 1.0
        small = functional.adaptive_avg_pool2d(pictures, SIDE).flatten(1)
        nearest = torch.cdist(small, self.thumbnail).argmin(dim=1)
        size = pictures.shape[-2:]
        depth = functional.interpolate(self.depth_seen[nearest][:, None], size=size, mode="nearest-exact")[:, 0]
        return depth, self.pose_seen[nearest], float(self.focal_share) * size[1]


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


def teach(
    cls: type[Remembered], folder: Path, colors: np.ndarray, depth: np.ndarray, poses: np.ndarray, focal: float
) -> Path:
    """Save a network that remembers pictures (n, H, W, 3), as its authors' packages save theirs; the folder."""
    model = cls(pictures=len(colors), height=depth.shape[1], width=depth.shape[2])
    stack = torch.from_numpy(colors).permute(0, 3, 1, 2).float() / 255.0
    with torch.no_grad():
        model.thumbnail.copy_(functional.adaptive_avg_pool2d(stack, SIDE).flatten(1))
        model.depth_seen.copy_(torch.from_numpy(depth))
        model.pose_seen.copy_(torch.from_numpy(poses).float())
        model.focal_share.copy_(torch.tensor(focal / colors.shape[2]))
    model.save_pretrained(folder, config={"pictures": len(colors), "height": depth.shape[1], "width": depth.shape[2]})
    return folder
