"""DUSt3R and CUT3R, whose packages have one name: dictionaries of pictures (B, 3, H, W) in [-1, 1] to point maps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from remembered import Remembered, expp1, gauge, moved, placed, points
from scipy.spatial.transform import Rotation


class AsymmetricCroCo3DStereo(Remembered):
    """Each pair has a scale of its own."""

    patch = 16

    def forward(self, view1: dict[str, Any], view2: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        (z1, T1, focal), (z2, T2, _) = (self.recall((v["img"] + 1) / 2) for v in (view1, view2))
        assert view1["true_shape"].tolist() == [list(z1.shape[1:])] * len(z1)
        scale = torch.tensor([gauge(T1, 100 * self.passes + k)[1] for k in range(len(z1))])[:, None, None, None]
        second = placed(torch.linalg.inv(T1) @ T2, points(z2, focal))
        first = {"pts3d": scale * points(z1, focal), "conf": expp1(z1)}
        return first, {"pts3d_in_other_view": scale * second, "conf": expp1(z2)}


class ARCroco3DStereo(Remembered):
    """The first camera is the frame of reference; CUT3R and, with one word more, TTT3R."""

    patch = 16
    config_class = SimpleNamespace

    def __init__(self, config: SimpleNamespace | None = None, **sizes: int) -> None:
        told = sizes if config is None else vars(config)
        super().__init__(told["pictures"], told["height"], told["width"])
        self.config = SimpleNamespace(model_update_type="cut3r")

    def forward(self, views: list[dict[str, Any]]) -> SimpleNamespace:
        assert all(v["img_mask"] and v["update"] and not v["ray_mask"] and not v["reset"] for v in views)
        depth, poses, focal = self.recall(torch.cat([(v["img"] + 1) / 2 for v in views]))
        scale = gauge(poses, self.passes)[1]
        T = moved(torch.linalg.inv(poses[0]) @ poses, scale)
        quat = torch.from_numpy(Rotation.from_matrix(T[:, :3, :3].numpy()).as_quat(scalar_first=True)).to(T)
        rows = zip(scale * points(depth, focal), expp1(depth), torch.cat([T[:, :3, 3], quat], dim=1), strict=True)
        said = [{"pts3d_in_self_view": p[None], "conf_self": c[None], "camera_pose": e[None]} for p, c, e in rows]
        return SimpleNamespace(ress=said, views=views)

    def forward_recurrent_lighter(self) -> None:
        """Another way that only the package of TTT3R has."""
        raise NotImplementedError
