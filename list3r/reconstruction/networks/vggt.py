"""Reconstruction `vggt` (Wang et al., "VGGT: Visual Geometry Grounded Transformer", CVPR 2025).

Pictures (1, n, 3, h, w) in [0, 1], the longer side 518, bicubic; pictures taller than wide are padded with white to a
square, one of the two modes of its loader (the other crops top and bottom). Out come `depth` (1, n, h,
w, 1), `depth_conf` = 1 + exp(x), and `pose_enc` (1, n, 9): translation and quaternion (xyzw) of the camera *from*
world pose with OpenCV axes, then the vertical and the horizontal field of view in radians. The first camera is the
frame of reference; there is no scale. The heads for world points and for tracks are not needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from list3r.models.upstream import load_upstream
from list3r.reconstruction.feedforward.network import (
    FeedforwardReconstructor,
    Network,
    inverted,
    numpy,
    sigmoid_of_expp1,
)
from list3r.reconstruction.feedforward.output import WindowOutput, middles
from list3r.reconstruction.feedforward.pictures import PaddedSize
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def load(cls: Any, path: Path, device: torch.device) -> Any:
    """Return the network without the heads whose outputs are not read: a quarter of a pass and of its weights."""
    model = load_upstream(cls, path, device)
    model.point_head = model.track_head = None
    return model


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`; the network takes no intrinsics."""
    output = model(pictures[None])
    T_cam_world, focal = decode_poses(numpy(output["pose_enc"][0]), *pictures.shape[-2:])
    depth = numpy(output["depth"][0, ..., 0]).astype(np.float32)
    return WindowOutput(
        T_window_cam=inverted(T_cam_world),
        depth=depth,
        confidence=sigmoid_of_expp1(numpy(output["depth_conf"][0])),
        focal=focal,
        principal=middles(depth),
    )


NETWORK = Network("vggt", "vggt.models.vggt", "VGGT", PaddedSize(longest=518), answer, load)


def decode_poses(encoding: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Camera-from-world poses (n, 3, 4) and focal lengths (n, 2), px, of encodings (n, 9)."""
    e = encoding.astype(np.float64)
    length = np.linalg.norm(e[:, 3:7], axis=1)
    whole = np.isfinite(e).all(axis=1) & (length > 1e-6)
    quat_xyzw = np.where(whole[:, None], e[:, 3:7], (0.0, 0.0, 0.0, 1.0))
    T = np.concatenate([Rotation.from_quat(quat_xyzw).as_matrix(), e[:, :3, None]], axis=2)
    T[~whole] = np.nan
    half = np.tan(np.clip(e[:, [8, 7]] / 2.0, 1e-6, None))
    return T, np.array([width, height]) / 2.0 / half
