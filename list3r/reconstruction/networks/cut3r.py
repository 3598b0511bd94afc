"""Reconstruction `cut3r` (Wang et al., "Continuous 3D Perception Model with Persistent State", CVPR 2025).

Pictures one after another, in [-1, 1], the longer side 512, cut to whole patches of 16. For each come back
`pts3d_in_self_view` (1, h, w, 3) in its own camera, `conf_self` = 1 + exp(x) (1, h, w), and `camera_pose` (1, 7):
translation and quaternion (wxyz) of the camera *to* world pose with OpenCV axes, near the identity for the first.
About metric; taken as relative like the others. Its weights come as a pickle, which docs/models.md converts to a file
of tensors alone; the network's parameters are set here, or in a `config.json` next to them.

The pose has a token of its own, at position -1. The package's own code for machines without its CUDA extension has no
such position, so there all positions are shifted by one, to which attention is invariant.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from list3r.models.upstream import load_upstream
from list3r.reconstruction.feedforward.network import FeedforwardReconstructor, Network, numpy, sigmoid_of_expp1
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.pictures import CutSize
from list3r.reconstruction.feedforward.points import from_points, views
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


PUBLISHED: dict[str, Any] = {
    "state_size": 768,
    "state_pe": "2d",
    "pos_embed": "RoPE100",
    "rgb_head": True,
    "pose_head": True,
    "patch_embed_cls": "PatchEmbedDust3R",
    "img_size": (512, 512),
    "head_type": "dpt",
    "output_mode": "pts3d+pose",
    "depth_mode": ("exp", -math.inf, math.inf),
    "conf_mode": ("exp", 1, math.inf),
    "pose_mode": ("exp", -math.inf, math.inf),
    "enc_embed_dim": 1024,
    "enc_depth": 24,
    "enc_num_heads": 16,
    "dec_embed_dim": 768,
    "dec_depth": 12,
    "dec_num_heads": 12,
    "landscape_only": False,
}
"""The parameters of the published weights' network."""


def load(cls: Any, path: Path, device: torch.device) -> Any:
    """Return the network. Raises `OptionError` in one line."""
    own = path / "config.json"
    config = PUBLISHED | (json.loads(own.read_text(encoding="utf-8")) if own.is_file() else {})

    def make_network() -> Any:
        return cls(cls.config_class(**config))

    make_network.__name__ = cls.__name__
    file = path / "model.safetensors"
    model = load_upstream(make_network, file if file.is_file() else path, device)
    rope: Any = getattr(model, "rope", None)
    if hasattr(rope, "get_cos_sin"):
        rope.register_forward_pre_hook(lambda _module, asked: (asked[0], asked[1] + 1))
    return model


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`; the network takes no intrinsics (it could take rays)."""
    import torch

    yes, no = (pictures.new_full((1,), value).bool() for value in (1, 0))
    asked = views(pictures)
    for view in asked:
        no_rays = pictures.new_full((1, *pictures.shape[-2:], 6), torch.nan)
        view |= {"ray_map": no_rays, "img_mask": yes, "ray_mask": no, "update": yes, "reset": no}
    said = model(asked).ress
    return from_points(
        decode_poses(np.concatenate([numpy(s["camera_pose"]) for s in said])),
        np.concatenate([numpy(s["pts3d_in_self_view"]) for s in said]),
        sigmoid_of_expp1(np.concatenate([numpy(s["conf_self"]) for s in said])),
    )


def decode_poses(encoding: np.ndarray) -> np.ndarray:
    """Camera-to-world poses (n, 4, 4) of encodings (n, 7); NaN for invalid ones."""
    e = encoding.astype(np.float64)
    whole = np.isfinite(e).all(axis=1) & (np.linalg.norm(e[:, 3:], axis=1) > 1e-6)
    T = np.full((len(e), 4, 4), np.nan)
    T[whole] = np.eye(4)
    T[whole, :3, :3] = Rotation.from_quat(e[whole][:, [4, 5, 6, 3]]).as_matrix()
    T[whole, :3, 3] = e[whole, :3]
    return T


NETWORK = Network("cut3r", "dust3r.model", "ARCroco3DStereo", CutSize(longest=512), answer, load, half=False)
