"""Fast3R: dictionaries of pictures (1, 3, H, W) in [-1, 1] to points in the first camera, without poses."""

from __future__ import annotations

from typing import Any

import torch
from remembered import Remembered, expp1, gauge, placed, points


class Fast3R(Remembered):
    """The first camera is the frame of reference."""

    patch = 16

    def forward(self, views: list[dict[str, Any]]) -> list[dict[str, torch.Tensor]]:
        depth, poses, focal = self.recall(torch.cat([(v["img"] + 1) / 2 for v in views]))
        scale = gauge(poses, self.passes)[1]
        local = points(depth, focal)
        common = placed(torch.linalg.inv(poses[0]) @ poses, local)
        rows = zip(scale * common, expp1(depth), 0.8 * local, strict=True)
        return [{"pts3d_in_other_view": p[None], "conf": c[None], "pts3d_local": q[None]} for p, c, q in rows]
