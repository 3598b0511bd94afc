"""Reconstruction `mapanything` (Keetha et al., "MapAnything: Universal Feed-Forward Metric 3D Reconstruction").

A list of views, each a dictionary with `img` (1, 3, h, w) normalised as for DINOv2, the name of that, and, where the
user knows them, `intrinsics` (1, 3, 3). For each view come back `depth_z` (1, h, w, 1), `conf` = 1 + exp(x) (1, h, w),
`camera_poses` (1, 4, 4) camera to world with OpenCV axes, `intrinsics` (1, 3, 3), and `non_ambiguous_mask` (1, h, w).
Depth is about metric; its users find factors of up to three, so it is taken as relative. Its constructor fetches the
code and the weights of DINOv2 by `torch.hub`, from another host than the hub's; the package holds that code itself.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from list3r.models.images import normalised
from list3r.models.upstream import load_upstream
from list3r.reconstruction.feedforward.network import (
    FeedforwardReconstructor,
    Network,
    numpy,
    sigmoid_of_expp1,
)
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.pictures import TabledSize
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


AT_ONCE = 4
"""Pictures that go through its dense head together, 0.7 GB each by its authors; left to itself it takes all memory."""


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def load(cls: Any, path: Path, device: torch.device) -> Any:
    """Return the network from its own weights and code alone; nothing is fetched."""
    with _backbones_of_the_package():
        return load_upstream(cls, path, device)


@contextlib.contextmanager
def _backbones_of_the_package() -> Iterator[None]:
    """DINOv2 without weights, from the copy of its code in the package, wherever `torch.hub` is asked for it.

    The checkpoint brings the weights of the whole network; those of DINOv2 would be overwritten.
    """
    hub: Any = import_module("torch.hub")
    fetch = hub.load

    def own(repository: str, name: str, *more: Any, **options: Any) -> Any:
        if repository != "facebookresearch/dinov2":
            return fetch(repository, name, *more, **options)
        return getattr(import_module("mapanything.models.external.dinov2.hub.backbones"), name)(pretrained=False)

    hub.load = own
    try:
        yield
    finally:
        hub.load = fetch


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`."""
    views: list[dict[str, Any]] = [
        {"img": p[None], "data_norm_type": ["dinov2"]} | ({} if K is None else {"intrinsics": K[n][None]})
        for n, p in enumerate(normalised(pictures))
    ]
    cuda = pictures.is_cuda
    said = model.infer(
        views, memory_efficient_inference=True, minibatch_size=AT_ONCE, use_amp=cuda, apply_mask=False, mask_edges=False
    )
    confidence = np.stack([sigmoid_of_expp1(numpy(view["conf"][0])) for view in said])
    solid = np.stack([numpy(view["non_ambiguous_mask"][0]) > 0.5 for view in said])
    K_found = np.stack([numpy(view["intrinsics"][0]) for view in said]).astype(np.float64)
    return WindowOutput(
        T_window_cam=np.stack([numpy(view["camera_poses"][0]) for view in said]).astype(np.float64),
        depth=np.stack([numpy(view["depth_z"][0, ..., 0]) for view in said]).astype(np.float32),
        confidence=np.where(solid, confidence, np.float32(0)),
        focal=K_found[:, [0, 1], [0, 1]],
        principal=K_found[:, :2, 2],
    )


SHAPES = (
    (1.000, 518, 518),
    (1.321, 518, 392),
    (1.542, 518, 336),
    (1.762, 518, 294),
    (2.056, 518, 252),
    (3.083, 518, 168),
    (0.757, 392, 518),
    (0.649, 336, 518),
    (0.567, 294, 518),
    (0.486, 252, 518),
)
"""The shapes of pictures that it was trained with: width by height, width and height, px."""

NETWORK = Network("mapanything", "mapanything.models", "MapAnything", TabledSize(SHAPES), answer, load)
