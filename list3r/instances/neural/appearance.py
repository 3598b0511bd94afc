"""Features of DINOv2 or DINOv3: of objects, patch tokens pooled inside each mask; of frames, the class token and all
patch tokens, by which places are found again.

A frame's patch tokens are pooled by their generalised mean of power 3 (GeM: Radenovic, Tolias, Chum, "Fine-tuning CNN
image retrieval with no human annotation", 2019), so that few strong tokens outweigh many weak ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.base import Discoverer, Proposals
from list3r.models.images import InputShape, network_input
from list3r.models.pretrained import load_named, space_name
from list3r.reconstruction.base import Reconstruction

CLASSES = {"dinov2": "Dinov2Model", "dinov3": "DINOv3ViTModel"}
LONG_SIDE = 518
"""Longer side of the network's input, px: 37 patches of 14, the resolution DINOv2 was last trained at."""


class Appearance:
    """Dense features of pictures."""

    def __init__(self, model: str, folder: Path, device: str = "auto", long_side: int = LONG_SIDE) -> None:
        """`model` is dinov2 or dinov3, `folder` holds its configuration and weights. Raises `OptionError`."""
        self._network, self._device = load_named(CLASSES, "features", model, folder, device)
        config = self._network.config
        self._patch, self._long_side = int(config.patch_size), long_side
        self._skipped = 1 + int(getattr(config, "num_register_tokens", 0) or 0)
        self.feature_space = space_name(model, folder, int(config.hidden_size))
        """`model@revision/dim`."""

    def tokens(self, color: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Token of the whole picture (D,) and patch tokens (h, w, D) of a picture (H, W, 3)."""
        import torch

        height, width = color.shape[:2]
        scale = self._long_side / max(height, width)
        rows, columns = (max(1, round(side * scale / self._patch)) for side in (height, width))
        shape = InputShape(rows * self._patch, columns * self._patch)
        with torch.inference_mode():
            picture = network_input(color, shape, self._device, self._network.dtype)
            states = self._network(pixel_values=picture).last_hidden_state[0].float()
        patches = states[self._skipped :].reshape(rows, columns, -1)
        return states[0].cpu().numpy(), patches.cpu().numpy()

    def whole(self, color: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Unit descriptor of a whole picture (H, W, 3): its class token and its pooled patch tokens. Shape (2 D,).

        The cosine of two pictures is the mean of both parts' cosines.
        """
        token, patches = self.tokens(color)
        power = np.mean(patches.reshape(-1, patches.shape[-1]).astype(np.float64) ** 3, axis=0)
        parts = token.astype(np.float64), np.cbrt(power)
        both = np.concatenate([part / max(float(np.linalg.norm(part)), 1e-9) for part in parts])
        return np.asarray(both / np.sqrt(2.0), np.float32)

    def pooled(self, color: NDArray[np.uint8], labels: NDArray[np.int32], count: int) -> NDArray[np.float32]:
        """Unit mean of the patch tokens under each label 1..count of a label image (H, W). Shape (count, D)."""
        _, patches = self.tokens(color)
        weight = label_shares(labels, count, patches.shape[:2])
        pooled = weight @ patches.reshape(-1, patches.shape[-1])
        length = np.linalg.norm(pooled, axis=1, keepdims=True)
        return np.asarray(pooled / np.maximum(length, 1e-9), np.float32)


class WithAppearance:
    """Discoverer: another discoverer's masks with features of this network."""

    def __init__(self, discoverer: Discoverer, appearance: Appearance) -> None:
        self._discoverer, self._appearance = discoverer, appearance

    @property
    def feature_space(self) -> str:
        """The network's."""
        return self._appearance.feature_space

    def __call__(self, frames: Sequence[Frame], reconstruction: Reconstruction, position: int) -> Proposals:
        """The other's candidates on the frame at `position`, each with the mean of the network's tokens inside it."""
        found = self._discoverer(frames, reconstruction, position)
        features = self._appearance.pooled(frames[position].color, found.labels, len(found.score))
        return replace(found, features=features)


def label_shares(labels: NDArray[np.int32], count: int, grid: tuple[int, int]) -> NDArray[np.float32]:
    """Pixels of each label 1..count in each cell of a grid laid over the label image. Shape (count, cells)."""
    rows = np.arange(labels.shape[0]) * grid[0] // labels.shape[0]
    columns = np.arange(labels.shape[1]) * grid[1] // labels.shape[1]
    cell = rows[:, None] * grid[1] + columns[None, :]
    cells = grid[0] * grid[1]
    at = labels.astype(np.int64) * cells + cell
    shares = np.bincount(at.ravel(), minlength=(count + 1) * cells).reshape(count + 1, cells)
    return shares[1:].astype(np.float32)
