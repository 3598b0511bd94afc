"""Reconstruction `mapanything` (Keetha et al., "MapAnything: Universal Feed-Forward Metric 3D Reconstruction").

A list of views, each a dictionary with `img` (1, 3, h, w) normalised as for DINOv2, the word for that, and, where the
user knows them, `intrinsics` (1, 3, 3). For each view come back `depth_z` (1, h, w, 1), `conf` = 1 + exp(x) (1, h, w),
`camera_poses` (1, 4, 4) camera to world with OpenCV axes, `intrinsics` (1, 3, 3), and `non_ambiguous_mask` (1, h, w).
Depth is about metric; its users find factors of up to three, so it is taken as relative.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from list3r.models.cards import ModelCard
from list3r.models.images import IMAGENET_MEAN, IMAGENET_STD
from list3r.models.upstream import load_upstream, upstream_class
from list3r.reconstruction.feedforward import (
    FeedforwardReconstructor,
    PictureSize,
    card_of,
    numpy,
    sigmoid_of_expp1,
)
from list3r.reconstruction.feedforward_output import WindowOutput
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """The model with the weights that the options name."""
    return FeedforwardReconstructor(MapAnything(), options)


@dataclass(frozen=True)
class MapAnything:
    """The network mapanything."""

    @property
    def card(self) -> ModelCard:
        """What it is."""
        return card_of("mapanything")

    @property
    def size(self) -> PictureSize:
        """How large its pictures are."""
        return PictureSize(longest=518)

    def load(self, path: Path, device: torch.device) -> Any:
        """The network of the package `mapanything`."""
        return load_upstream(upstream_class(self.card, "mapanything.models", "MapAnything"), path, device)

    def answer(self, model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
        """See `feedforward.Network`."""
        mean = pictures.new_tensor(IMAGENET_MEAN).view(3, 1, 1)
        std = pictures.new_tensor(IMAGENET_STD).view(3, 1, 1)
        views: list[dict[str, Any]] = [
            {"img": ((p - mean) / std)[None], "data_norm_type": ["dinov2"]}
            | ({} if K is None else {"intrinsics": K[None]})
            for p in pictures
        ]
        cuda = pictures.is_cuda
        said = model.infer(views, memory_efficient_inference=True, use_amp=cuda, apply_mask=False, mask_edges=False)
        confidence = np.stack([sigmoid_of_expp1(numpy(view["conf"][0])) for view in said])
        solid = np.stack([numpy(view["non_ambiguous_mask"][0]) > 0.5 for view in said])
        K_found = np.stack([numpy(view["intrinsics"][0]) for view in said]).astype(np.float64)
        return WindowOutput(
            T_window_cam=np.stack([numpy(view["camera_poses"][0]) for view in said]).astype(np.float64),
            depth=np.stack([numpy(view["depth_z"][0, ..., 0]) for view in said]).astype(np.float32),
            confidence=np.where(solid, confidence, np.float32(0)),
            focal=K_found[:, [0, 1], [0, 1]],
        )
