"""ALIKED, a learned detector and descriptor of local features (Zhao et al., IEEE TIM 2023), in plain torch.

Written from the paper's description and the shapes of the published weights (BSD-3-Clause); deformable convolutions
are done by bilinear sampling, so that no other package is needed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from list3r.memory.core.errors import OptionError
from list3r.reconstruction.features.learned import LEARNED_WIDTH, LearnedFeatures

DIVISOR = 32
"""Sides of the network's input are multiples of this."""
RADIUS = 2
"""Only the best score within this many pixels is a keypoint."""
MIN_SCORE = 0.1
TEMPERATURE = 0.1
"""Of the soft-argmax that places a keypoint between pixels (the paper's)."""


class Aliked:
    """Detects and describes; descriptors are unit vectors."""

    def __init__(self, weights: Path, device: str = "cpu") -> None:
        """`weights` is a file of published weights. Raises `OptionError` when it is not."""
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
        except FileNotFoundError:
            raise OptionError(f"the weights {weights} do not exist; give the file aliked-n16.pth") from None
        except Exception as error:  # a damaged file ends in errors of many kinds
            raise OptionError(f"{weights} cannot be read as weights ({type(error).__name__}); fetch it again") from None
        self._network = _network_of(state, weights).to(device).eval()
        self._device = torch.device(device)

    def __call__(self, color: NDArray[np.uint8], count: int) -> LearnedFeatures:
        height, width = color.shape[:2]
        with torch.inference_mode():
            picture = torch.from_numpy(np.ascontiguousarray(color)).to(self._device).permute(2, 0, 1)[None].float()
            pad = (0, -width % DIVISOR, 0, -height % DIVISOR)
            features, scores = self._network(functional.pad(picture / 255.0, pad, mode="replicate"))
            features, scores = features[..., :height, :width], scores[..., :height, :width]
            xy, score = _keypoints(scores, count)
            found = self._network.describe(functional.normalize(features, dim=1), xy)
        return LearnedFeatures(xy.cpu().numpy(), found.cpu().numpy(), score.cpu().numpy())


class _Deformable(nn.Module):
    """A 3x3 convolution whose nine taps are displaced by learned offsets (Dai et al., 2017)."""

    def __init__(self, inner: int, outer: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(inner, 18, 3, padding=1)
        self.regular_conv = nn.Conv2d(inner, outer, 3, padding=1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Shape (1, C, h, w) -> (1, D, h, w)."""
        height, width = x.shape[-2:]
        reach = max(height, width) / 4.0
        offsets = self.offset_conv(x).clamp(-reach, reach)[0].view(9, 2, height, width)
        rows = torch.arange(height, device=x.device, dtype=x.dtype)[:, None]
        columns = torch.arange(width, device=x.device, dtype=x.dtype)[None, :]
        weight = self.regular_conv.weight
        out = x.new_zeros((weight.shape[0], height * width))
        for tap in range(9):
            v = rows + (tap // 3 - 1) + offsets[tap, 0]
            u = columns + (tap % 3 - 1) + offsets[tap, 1]
            grid = torch.stack([2.0 * u / max(width - 1, 1) - 1.0, 2.0 * v / max(height - 1, 1) - 1.0], dim=-1)
            taken = functional.grid_sample(x, grid[None], mode="bilinear", padding_mode="zeros", align_corners=True)
            out += weight[:, :, tap // 3, tap % 3] @ taken[0].flatten(1)
        return out.view(1, -1, height, width)


class _Block(nn.Module):
    """Two convolutions, with a shortcut around them from the second block on."""

    def __init__(self, inner: int, outer: int, *, shortcut: bool, deformable: bool) -> None:
        super().__init__()

        def conv(a: int, b: int) -> nn.Module:
            return _Deformable(a, b) if deformable else nn.Conv2d(a, b, 3, padding=1, bias=False)

        self.conv1, self.bn1 = conv(inner, outer), nn.BatchNorm2d(outer)
        self.conv2, self.bn2 = conv(outer, outer), nn.BatchNorm2d(outer)
        self.downsample = nn.Conv2d(inner, outer, 1) if shortcut else None

    def forward(self, x: Tensor) -> Tensor:
        """Shape (1, C, h, w) -> (1, D, h, w)."""
        out = self.bn2(self.conv2(functional.selu(self.bn1(self.conv1(x)))))
        return functional.selu(out if self.downsample is None else out + self.downsample(x))


class _Descriptor(nn.Module):
    """The sparse deformable head: each keypoint samples at offsets predicted from its own neighbourhood."""

    def __init__(self, width: int, positions: int, patch: int) -> None:
        super().__init__()
        self._patch, self._positions = patch, positions
        self.offset_conv = nn.Sequential(
            nn.Conv2d(width, 2 * positions, patch), nn.SELU(), nn.Conv2d(2 * positions, 2 * positions, 1)
        )
        self.sf_conv = nn.Conv2d(width, width, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.zeros(positions, width, width))

    def forward(self, features: Tensor, xy: Tensor) -> Tensor:
        """Unit descriptors (N, D) at pixels xy (N, 2) of features (1, D, h, w)."""
        if len(xy) == 0:
            return features.new_zeros((0, features.shape[1]))
        height, width = features.shape[-2:]
        near, half = xy.round().long(), self._patch // 2
        steps = torch.arange(self._patch, device=xy.device) - half
        padded = functional.pad(features, (half, half, half, half))[0]
        rows = (near[:, 1, None, None] + half + steps[:, None]).clamp(0, height + 2 * half - 1)
        columns = (near[:, 0, None, None] + half + steps[None, :]).clamp(0, width + 2 * half - 1)
        patches = padded[:, rows, columns].permute(1, 0, 2, 3)
        reach = max(height, width) / 4.0
        offsets = self.offset_conv(patches).clamp(-reach, reach).view(len(xy), self._positions, 2)
        at = near[:, None].to(features.dtype) + offsets
        grid = 2.0 * at / torch.tensor([width - 1, height - 1], device=xy.device) - 1.0
        taken = functional.grid_sample(features, grid[None], mode="bilinear", align_corners=True)
        mixed = functional.selu(self.sf_conv(taken))[0]
        return functional.normalize(torch.einsum("cnp,pcd->nd", mixed, self.agg_weights), dim=1)


class _Network(nn.Module):
    def __init__(self, channels: tuple[int, int, int, int], width: int, positions: int, patch: int) -> None:
        super().__init__()
        self.width = width
        one, two, three, four = channels
        self.block1 = _Block(3, one, shortcut=False, deformable=False)
        self.block2 = _Block(one, two, shortcut=True, deformable=False)
        self.block3 = _Block(two, three, shortcut=True, deformable=True)
        self.block4 = _Block(three, four, shortcut=True, deformable=True)
        quarter = width // 4
        self.conv1, self.conv2 = nn.Conv2d(one, quarter, 1, bias=False), nn.Conv2d(two, quarter, 1, bias=False)
        self.conv3, self.conv4 = nn.Conv2d(three, quarter, 1, bias=False), nn.Conv2d(four, quarter, 1, bias=False)
        self.score_head = nn.Sequential(
            nn.Conv2d(width, 8, 1, bias=False),
            nn.SELU(),
            nn.Conv2d(8, 4, 3, padding=1, bias=False),
            nn.SELU(),
            nn.Conv2d(4, 4, 3, padding=1, bias=False),
            nn.SELU(),
            nn.Conv2d(4, 1, 3, padding=1, bias=False),
        )
        self.desc_head = _Descriptor(width, positions, patch)

    def forward(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Features (1, D, h, w) and scores (1, 1, h, w) of a picture (1, 3, h, w) in [0, 1]."""
        x1 = self.block1(picture)
        x2 = self.block2(functional.avg_pool2d(x1, 2))
        x3 = self.block3(functional.avg_pool2d(x2, 4))
        x4 = self.block4(functional.avg_pool2d(x3, 4))
        parts = [functional.selu(self.conv1(x1))]
        for conv, x in ((self.conv2, x2), (self.conv3, x3), (self.conv4, x4)):
            part = functional.selu(conv(x))
            parts.append(functional.interpolate(part, size=x1.shape[-2:], mode="bilinear", align_corners=True))
        features = torch.cat(parts, dim=1)
        return features, self.score_head(features).sigmoid()

    def describe(self, features: Tensor, xy: Tensor) -> Tensor:
        """Unit descriptors (N, D) at pixels (N, 2)."""
        found: Tensor = self.desc_head(features, xy)
        return found


def _network_of(state: dict[str, Tensor], weights: Path) -> _Network:
    """Return the network with the sizes of the weights."""
    try:
        one, two = (state[f"block{k}.conv2.weight"].shape[0] for k in (1, 2))
        three, four = (state[f"block{k}.conv2.regular_conv.weight"].shape[0] for k in (3, 4))
        positions, width, _ = state["desc_head.agg_weights"].shape
        network = _Network((one, two, three, four), width, positions, state["desc_head.offset_conv.0.weight"].shape[-1])
        network.load_state_dict(state)
    except (KeyError, RuntimeError, ValueError, AttributeError, TypeError):
        raise OptionError(f"{weights} holds no weights of ALIKED; give a file such as aliked-n16.pth") from None
    if 2 * width > LEARNED_WIDTH:
        raise OptionError(f"{weights} has descriptors of {width} numbers; at most {LEARNED_WIDTH // 2} are kept")
    return network


def _keypoints(scores: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Local maxima, placed between pixels by a soft-argmax of their neighbours: xy (N, 2), px, and scores (N,)."""
    size = 2 * RADIUS + 1
    best = functional.max_pool2d(scores, size, stride=1, padding=RADIUS)
    peak = (scores == best) & (scores > MIN_SCORE)
    peak[..., : RADIUS + 1, :] = peak[..., -RADIUS - 1 :, :] = False
    peak[..., :, : RADIUS + 1] = peak[..., :, -RADIUS - 1 :] = False
    v, u = torch.nonzero(peak[0, 0], as_tuple=True)
    score = scores[0, 0, v, u]
    order = torch.argsort(score, descending=True, stable=True)[:count]
    v, u, score = v[order], u[order], score[order]
    steps = torch.arange(-RADIUS, RADIUS + 1, device=scores.device)
    around = scores[0, 0][v[:, None, None] + steps[:, None], u[:, None, None] + steps[None, :]]
    weight = functional.softmax(around.flatten(1) / TEMPERATURE, dim=1).view_as(around)
    dx = (weight.sum(dim=1) * steps).sum(dim=1)
    dy = (weight.sum(dim=2) * steps).sum(dim=1)
    return torch.stack([u + dx, v + dy], dim=1), score
