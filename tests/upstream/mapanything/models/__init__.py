"""MapAnything: a list of views in, a list of predictions out."""

from __future__ import annotations

import math
from typing import Any

import torch
from remembered import Remembered, gauge, moved

_ALLOWED = {"img", "data_norm_type", "intrinsics"}


class MapAnything(Remembered):
    """Checks its views as the real one does."""

    told: torch.Tensor | None = None

    @torch.inference_mode()
    def infer(
        self,
        views: list[dict[str, Any]],
        memory_efficient_inference: bool = True,
        minibatch_size: int | None = None,
        use_amp: bool = True,
        amp_dtype: str = "bf16",
        apply_mask: bool = True,
        mask_edges: bool = True,
    ) -> list[dict[str, torch.Tensor]]:
        for view in views:
            assert set(view) <= _ALLOWED and {"img", "data_norm_type"} <= set(view)
            assert view["data_norm_type"] == ["dinov2"] and view["img"].shape[:2] == (1, 3)
        type(self).told = views[0]["intrinsics"][0] if "intrinsics" in views[0] else None
        stack = torch.cat([view["img"] for view in views])
        mean, std = (stack.new_tensor(v).view(3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
        depth, poses, focal = self.recall((stack * std + mean).clamp(0, 1))
        scale = gauge(poses, self.passes)[1]
        camera = moved(poses, scale)
        camera = torch.linalg.inv(camera[0]) @ camera
        height, width = depth.shape[1:]
        K = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]).to(depth)
        return [
            {
                "depth_z": (depth[n] * scale)[None, ..., None],
                "conf": torch.where(depth[n] > 0, 1 + math.e**3, 1.0)[None],
                "non_ambiguous_mask": (depth[n] > 0)[None],
                "camera_poses": camera[n][None],
                "intrinsics": K[None],
            }
            for n in range(len(views))
        ]
