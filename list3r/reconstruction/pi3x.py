"""Reconstruction `pi3x`, the successor of `pi3`: smoother, and can be told the intrinsics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from list3r.reconstruction.feedforward import FeedforwardReconstructor, Network, PictureSize
from list3r.reconstruction.feedforward_output import WindowOutput
from list3r.reconstruction.pi3 import PIXEL_LIMIT, read
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """The model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`."""
    if K is None:
        return read(model(imgs=pictures[None], with_prior=False))
    told = K.expand(1, len(pictures), 3, 3)
    everywhere = pictures.new_ones((1, len(pictures))).bool()
    return read(model(imgs=pictures[None], intrinsics=told, mask_add_ray=everywhere))


NETWORK = Network("pi3x", "pi3.models.pi3x", "Pi3X", PictureSize(max_pixels=PIXEL_LIMIT), answer)
