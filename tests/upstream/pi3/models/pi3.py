"""Pi3: pictures (B, N, 3, H, W) in [0, 1] to points, local_points, conf (logits) and camera-to-world poses."""

from __future__ import annotations

import torch
from remembered import Remembered, gauge, moved


class Pi3(Remembered):
    """No reference view: every pass has a frame and a scale of its own."""

    def forward(self, imgs: torch.Tensor) -> dict[str, torch.Tensor]:
        depth, poses, focal = self.recall(imgs[0])
        T, scale = gauge(poses, self.passes)
        height, width = depth.shape[1:]
        x = (torch.arange(width).to(depth) - (width - 1) / 2) / focal
        y = (torch.arange(height).to(depth) - (height - 1) / 2) / focal
        z = depth * scale
        local = torch.stack([z * x[None, None], z * y[None, :, None], z], dim=-1)
        camera = moved(poses, scale, T)
        points = torch.einsum("nij,nhwj->nhwi", camera[:, :3, :3], local) + camera[:, None, None, :3, 3]
        sure = torch.where(depth > 0, 3.0, -6.0)
        return {
            "points": points[None],
            "local_points": local[None],
            "conf": sure[None, ..., None],
            "camera_poses": camera[None],
        }
