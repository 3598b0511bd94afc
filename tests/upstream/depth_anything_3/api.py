"""DepthAnything3: the outer class holds the network as `model`, which takes normalised pictures."""

from __future__ import annotations

import math
from typing import Any

import torch
from remembered import Remembered, gauge, moved
from torch import nn


class Inner(Remembered):
    """Camera-from-world poses (1, n, 3, 4), depth (1, n, h, w)."""

    def forward(
        self,
        x: torch.Tensor,
        extrinsics: Any = None,
        intrinsics: Any = None,
        export_feat_layers: list[int] | None = None,
    ) -> dict[str, torch.Tensor]:
        assert export_feat_layers == []
        mean, std = (x.new_tensor(v).view(3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
        depth, poses, focal = self.recall((x[0] * std + mean).clamp(0, 1))
        scale = gauge(poses, self.passes)[1]
        height, width = depth.shape[1:]
        cam = torch.linalg.inv(moved(poses, scale))
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).to(depth)
        return {
            "depth": (depth * scale)[None],
            "depth_conf": torch.where(depth > 0, 1 + math.e**3, 1.0)[None],
            "extrinsics": cam[None, :, :3],
            "intrinsics": K.expand(1, len(cam), 3, 3),
        }


class DepthAnything3(Remembered):
    """The outer class; only its inner network has weights."""

    def __init__(self, pictures: int = 2, height: int = 56, width: int = 56) -> None:
        nn.Module.__init__(self)
        self.model = Inner(pictures, height, width)

    def __getattr__(self, name: str) -> Any:
        if name in ("thumbnail", "depth_seen", "pose_seen", "focal_share"):
            return getattr(self.model, name)
        return super().__getattr__(name)
