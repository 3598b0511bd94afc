"""The network on pictures: a U-Net that tells of each pixel what its neighbours are to it."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from training.pictures.images import CHANNELS

REACHES = (2, 5, 12)
"""Pixels (of half size) over which affinities are told, along both axes."""
OUTPUTS = 2 * len(REACHES) + 1 + 3
"""Log odds of affinity right and down for each reach, of structure, and the way to the middle of the thing."""


class _Block(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.norm(self.conv(x)))


class PictureNetwork(nn.Module):
    """About 290,000 parameters; (B, CHANNELS, h, w) -> (B, OUTPUTS, h, w)."""

    def __init__(self, width: tuple[int, ...] = (20, 40, 60, 80)) -> None:
        super().__init__()
        steps = range(len(width) - 1)
        self.stem = _Block(CHANNELS, width[0])
        self.down = nn.ModuleList(
            nn.Sequential(_Block(width[k], width[k + 1], 2), _Block(width[k + 1], width[k + 1])) for k in steps
        )
        self.middle = _Block(width[-1], width[-1])
        self.across = nn.ModuleList(nn.Conv2d(width[k + 1], width[k], 1) for k in steps)
        self.up = nn.ModuleList(_Block(width[k], width[k]) for k in steps)
        self.head = nn.Conv2d(width[0], OUTPUTS, 1)

    def forward(self, x: Tensor) -> Tensor:
        levels = [self.stem(x)]
        for down in self.down:
            levels.append(down(levels[-1]))
        y = self.middle(levels[-1])
        for k in reversed(range(len(self.up))):
            raised = F.interpolate(self.across[k](y), size=levels[k].shape[-2:], mode="nearest")
            y = self.up[k](raised + levels[k])
        return self.head(y)
