"""Reconstruction `pi3x`, the successor of `pi3`: smoother, and takes known intrinsics.

Given intrinsics count pixels from the picture's corner (the first centre is at a half). `decode` makes a mask over all
pairs of tokens of all pictures, 9 GB for 100 of them, for given poses; there are none, so poses are switched off. Its
heads take 64 pictures at once, which can need more memory than the rest of the network.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.models.upstream import load_upstream
from list3r.reconstruction.feedforward.network import FeedforwardReconstructor, Network
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.pictures import PictureSize
from list3r.reconstruction.networks.pi3 import PIXEL_LIMIT, read
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


AT_ONCE = 8
"""Pictures that go through its heads together."""


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def load(cls: Any, path: Path, device: torch.device) -> Any:
    """Return the network, whose decoder predicts no poses and whose heads take a few pictures at a time."""
    model = load_upstream(cls, path, device)
    if hasattr(model, "decode"):
        _decode_without_poses(model)
    if hasattr(model, "_chunked_conv_head"):
        model._chunked_conv_head = partial(model._chunked_conv_head, chunk_size=AT_ONCE)
    return model


def _decode_without_poses(model: Any) -> None:
    decode = model.decode

    def plain(hidden: torch.Tensor, count: int, height: int, width: int, *_: Any) -> Any:
        before, model.use_multimodal = model.use_multimodal, False
        try:
            return decode(hidden, count, height, width, None, None)
        finally:
            model.use_multimodal = before

    model.decode = plain


def answer(model: Any, pictures: torch.Tensor, K: torch.Tensor | None) -> WindowOutput:
    """See `feedforward.Answer`."""
    if K is None:
        return read(model(imgs=pictures[None], with_prior=False))
    shifted = K.clone()
    shifted[:, :2, 2] += 0.5
    everywhere = pictures.new_ones((1, len(pictures))).bool()
    return read(model(imgs=pictures[None], intrinsics=shifted[None], mask_add_ray=everywhere))


NETWORK = Network("pi3x", "pi3.models.pi3x", "Pi3X", PictureSize(max_pixels=PIXEL_LIMIT), answer, load)
