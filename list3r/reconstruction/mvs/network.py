"""A network that estimates depth and its error from plane sweep costs and the picture.

A small U-Net: the costs of 64 depths show matches, the picture extends them over textureless surfaces. It was trained
on procedurally generated rooms (`training/sweep.py`, MODEL_CARD.md, research/colour-video 0199).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from list3r.reconstruction.mvs.images import Tensor
from list3r.reconstruction.mvs.weights import read_weights

PLANES = 64
"""Depths of the network's input costs."""
SIDE_FEATURES = 3
"""See `side_features`."""

_BLOCK = 12
"""Values of a picture per cost: four pixels of three colours."""


class _Residual(nn.Module):
    """Two convolutions with a skip connection (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.one, self.two = nn.Conv2d(inputs, outputs, 3, stride, 1), nn.Conv2d(outputs, outputs, 3, 1, 1)
        nn.init.normal_(self.two.weight, std=0.3 / (9 * outputs) ** 0.5)
        same = inputs == outputs and stride == 1
        self.skip = nn.Identity() if same else nn.Conv2d(inputs, outputs, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.skip(x) + self.two(F.relu(self.one(x))))


@dataclass(frozen=True)
class SweepPrediction:
    """The network's output for B keyframes. Places are numbers of planes, with fractions."""

    logits: Tensor
    """Of each plane. Shape (B, 64, h, w)."""
    place: Tensor
    """Shape (B, 2h, 2w)."""
    log_error: Tensor
    """Logarithm of the expected mean relative error of depth (Laplace). Shape (B, 2h, 2w)."""


class SweepNetwork(nn.Module):
    """Costs of 64 depths and the picture at twice their width to depth at that width."""

    def __init__(self, top: int = 40, widths: tuple[int, ...] = (64, 96, 128, 128)) -> None:
        super().__init__()
        w = (top, *widths)
        self.stem = nn.Conv2d(PLANES + _BLOCK + SIDE_FEATURES, top, 3, 1, 1)
        self.down = nn.ModuleList(_Residual(a, b, 2) for a, b in pairwise(w))
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(w))
        self.mix = nn.ModuleList(_Residual(a, a) for a in w[:-1])
        self.logits = nn.Conv2d(top, PLANES, 1)
        self.fine = nn.Sequential(nn.Conv2d(top + _BLOCK, top, 3, 1, 1), nn.ReLU(), nn.Conv2d(top, 36 + 4 + 4, 1))

    def forward(self, likeness: Tensor, picture: Tensor, side: Tensor) -> SweepPrediction:
        """Predict from likeness (B, 64, h, w), RGB (B, 3, 2h, 2w), both in [-1, 1], and `side_features` (B, 3)."""
        blocks = F.pixel_unshuffle(picture, 2)
        everywhere = side[:, :, None, None].expand(-1, -1, *likeness.shape[2:])
        x = F.relu(self.stem(torch.cat([likeness, blocks, everywhere], 1)))
        kept = [x]
        for down in self.down:
            kept.append(down(kept[-1]))
        x = kept[-1]
        for up, mix, skip in zip(reversed(self.up), reversed(self.mix), reversed(kept[:-1]), strict=True):
            x = mix(F.interpolate(up(x), size=skip.shape[2:], mode="bilinear", align_corners=False) + skip)
        logits = self.logits(x).float()
        fine = self.fine(torch.cat([x, blocks], 1)).float()
        place = _convex(_mode(logits), fine[:, :36]) + 1.5 * torch.tanh(fine[:, 36:40])
        both = F.pixel_shuffle(torch.cat([place, fine[:, 40:44]], 1), 2)
        return SweepPrediction(logits, both[:, 0], both[:, 1].clamp(-7.0, 2.0))


def _mode(logits: Tensor) -> Tensor:
    """Return the mean place of the likeliest plane and two on either side. Shape (B, h, w)."""
    near = logits.argmax(1, keepdim=True) + torch.arange(-2, 3, device=logits.device)[None, :, None, None]
    there = logits.gather(1, near.clamp(0, PLANES - 1))
    share = there.masked_fill((near < 0) | (near >= PLANES), -torch.inf).softmax(1)
    return (share * near).sum(1)


def _convex(place: Tensor, weights: Tensor) -> Tensor:
    """Return four mixtures of each place and its neighbours (Teed and Deng 2020, RAFT). Shape (B, 4, h, w)."""
    b, h, w = place.shape
    around = F.unfold(F.pad(place[:, None], (1, 1, 1, 1), mode="replicate"), 3).view(b, 9, 1, h, w)
    return (weights.view(b, 9, 4, h, w).softmax(1) * around).sum(1)


def side_features(span: tuple[float, float], parallax_px: float, sources: int) -> NDArray[np.float32]:
    """Return inputs that costs do not show: the planes' spacing and range, and the number of sources.

    `span` is the least and greatest inverse depth; one unit of it moves a pixel by `parallax_px`. Shape (3,).
    """
    low, high = span
    step = (high - low) * parallax_px / (PLANES - 1)
    return np.array([math.log(max(step, 1e-6)), low / high, sources / 6.0], np.float32)


def network_costs(cost: Tensor) -> Tensor:
    """Return costs (D, h, w) of evenly spaced planes as those of 64. Shape (64, h, w)."""
    count, height, width = cost.shape
    flat = cost.reshape(1, 1, count, height * width)
    size = (PLANES, height * width)
    return F.interpolate(flat, size=size, mode="bilinear", align_corners=True).reshape(PLANES, height, width)


def network_picture(color: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Return a picture at the network's input size for costs of a size. Shape (2 height, 2 width, 3)."""
    return np.asarray(cv2.resize(color, (2 * width, 2 * height), interpolation=cv2.INTER_AREA), np.uint8)


@lru_cache(maxsize=2)
def load_network(path: Path | None = None, device: str = "cpu") -> SweepNetwork:
    """Return the trained network, by default the shipped one. Raises `OptionError` for an invalid file."""
    network = SweepNetwork()
    network.load_state_dict({name: torch.from_numpy(value) for name, value in read_weights(path).items()})
    return network.eval().requires_grad_(False).to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def predict_depth(
    network: SweepNetwork, cost: Tensor, color: NDArray[np.uint8], span: tuple[float, float], side: NDArray[np.float32]
) -> tuple[Tensor, Tensor]:
    """Return inverse depth and its mean relative error, from costs (D, h, w) in [0, 1]. Shape (2h, 2w) each.

    `color` is the whole RGB picture; `span` holds the inverse depths of the first and the last plane.
    """
    low, high = span
    picture = torch.from_numpy(network_picture(color, *cost.shape[1:])).to(cost.device)
    likeness = (1.0 - 2.0 * network_costs(cost))[None].contiguous(memory_format=torch.channels_last)
    given = (picture.permute(2, 0, 1).float() / 127.5 - 1.0)[None]  # in the memory's order already
    with torch.inference_mode():
        said = network(likeness, given, torch.from_numpy(side)[None].to(cost.device))
    inverse = low + said.place[0] * ((high - low) / (PLANES - 1))
    return inverse.clamp_min(1e-3 * high), said.log_error[0].exp()
