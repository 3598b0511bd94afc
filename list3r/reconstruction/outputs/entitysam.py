"""Masks of EntitySAM: the pictures `pan_pred/VIDEO/*.png`, one for each frame that it was given, by name in order.

A colour is one instance throughout the video, and black is none: its number is red + 256 green + 256^2 blue, as in
COCO's panoptic pictures. Masks are of the frames' own size; there are no features.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.decoding.decode import read_color
from list3r.memory.core.errors import SourceError
from list3r.reconstruction.precomputed_files import Piece


class EntityMasks:
    """Instances of frames by their numbers."""

    def __init__(self, folder: Path, every: int = 1) -> None:
        """Raises `SourceError` for a folder without pictures."""
        self._files = sorted(folder.glob("*.png"))
        if not self._files:
            raise SourceError(f"{folder} holds no .png files; give the folder pan_pred/VIDEO that EntitySAM wrote")
        self._folder, self._every = folder, every
        self._numbers: dict[int, int] = {}

    def added(self, piece: Piece) -> Piece:
        """Return a file's contents with the masks of its frames. Raises `SourceError` for frames without masks."""
        size = piece.depth.shape[2], piece.depth.shape[1]
        masks = [cv2.resize(self._masks(int(f)), size, interpolation=cv2.INTER_NEAREST) for f in piece.frames]
        return replace(piece, masks=np.stack(masks))

    def _masks(self, frame: int) -> NDArray[np.int32]:
        """Instances of a frame, numbered from 1 in order of appearance. Shape (H, W)."""
        position = frame // self._every
        if position >= len(self._files):
            raise SourceError(f"{self._folder} has masks of {len(self._files)} frames, none of frame {frame}")
        color = read_color(self._files[position]).astype(np.int64)
        packed = color @ np.array([1, 256, 256**2])
        ids, where = np.unique(packed, return_inverse=True)
        known = [0 if i == 0 else self._numbers.setdefault(i, len(self._numbers) + 1) for i in ids.tolist()]
        return np.array(known, np.int32)[where].reshape(packed.shape)
