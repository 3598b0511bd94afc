"""Reconstruction `mast3r` (Leroy et al., "Grounding Image Matching in 3D with MASt3R", ECCV 2024): pairs in chunks.

Inputs and outputs are those of `dust3r`; its descriptors and their confidence (`desc`, `desc_conf`) are not read. The
weights are about metric; each pair is taken at a scale of its own all the same.
"""

from __future__ import annotations

from list3r.reconstruction.feedforward.network import FeedforwardReconstructor, Network
from list3r.reconstruction.feedforward.pictures import CutSize
from list3r.reconstruction.networks.dust3r import answer
from list3r.reconstruction.registry import ModelOptions


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


NETWORK = Network("mast3r", "mast3r.model", "AsymmetricMASt3R", CutSize(longest=512), answer, half=False)
