"""VGGT: pictures (B, S, 3, H, W) in [0, 1] to pose_enc (t, quaternion xyzw, fov_h, fov_w, camera from world)."""

from __future__ import annotations

import math

import torch
from remembered import Remembered, gauge, moved
from scipy.spatial.transform import Rotation


class VGGT(Remembered):
    """The first camera is the frame of reference."""

    def forward(self, images: torch.Tensor, query_points: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        depth, poses, focal = self.recall(images[0])
        scale = gauge(poses, self.passes)[1]
        height, width = depth.shape[1:]
        world = moved(poses, scale)
        cam = torch.linalg.inv(world) @ world[0]
        quat = torch.from_numpy(Rotation.from_matrix(cam[:, :3, :3].cpu().numpy()).as_quat()).to(cam)
        fov = [2 * math.atan(side / 2 / focal) for side in (height, width)]
        encoding = torch.cat([cam[:, :3, 3], quat, torch.tensor(fov).to(cam).expand(len(cam), 2)], dim=1)
        confidence = torch.where(depth > 0, 1 + math.e**3, 1.0)
        return {
            "pose_enc": encoding[None],
            "depth": (depth * scale)[None, ..., None],
            "depth_conf": confidence[None],
            "images": images,
        }
