"""Discovery `precomputed`: masks that some model wrote next to its geometry (docs/precomputed.md).

Where it wrote no features with them, an object is known again by its colours in the anchor's picture.

A number in a file's masks is one object throughout that file, so candidates of several anchors need no guessing. Files
that hold only some of a chunk's frames number their objects on their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.base import Proposals
from list3r.instances.geometric.features import COLOR_PART, color_feature
from list3r.instances.settings import InstanceSettings
from list3r.memory.core.errors import OptionError
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.precomputed import open_folder
from list3r.reconstruction.precomputed_files import Piece, read_piece

MOST_OBJECTS = 1_000_000
"""Objects of one file; numbers of different files are kept apart by this."""


class PrecomputedMasks:
    """Discoverer: looks an anchor's masks up by the frame's number."""

    def __init__(self, folder: Path, settings: InstanceSettings | None = None) -> None:
        """Raises `OptionError` when the folder is no such folder, or its files have no masks."""
        self._path, self._folder = folder, open_folder(folder)
        self._settings = settings or InstanceSettings()
        first = self._checked(0)
        self._dimensions = COLOR_PART if first is None else first.shape[1]
        self._kind = "colors" if first is None else "features"

    @property
    def feature_space(self) -> str:
        """Features of whatever wrote the files, `model@revision/dim`."""
        named = "".join(c if c.isalnum() or c in "-_." else "-" for c in self._folder.manifest.model) or "unnamed"
        return f"precomputed-{named}{'-colors' * (self._kind == 'colors')}@1/{self._dimensions}"

    def __call__(self, frames: Sequence[Frame], reconstruction: Reconstruction, position: int) -> Proposals:
        """Candidates on the frame at `position`; none where no file holds the frame."""
        height, width = reconstruction.camera.height, reconstruction.camera.width
        wanted = reconstruction.frame_indices
        index = int(wanted[position])
        held = [k for k in self._folder.holding(wanted) if index in self._folder.frames[k]]
        if not held:
            nothing = np.zeros((height, width), np.int32), np.zeros(0, np.int64)
            return self._proposals(position, *nothing, np.zeros((0, self._dimensions), np.float32), 0)
        piece = _piece(self._folder.files[held[0]])
        assert piece.masks is not None
        masks = piece.masks[int(np.searchsorted(piece.frames, index))]
        masks = cv2.resize(masks, (width, height), interpolation=cv2.INTER_NEAREST)
        numbers = np.unique(masks[masks > 0]).astype(np.int64)
        labels = np.where(masks > 0, np.searchsorted(numbers, masks) + 1, 0).astype(np.int32)
        known = self._checked(held[0])
        features = _colors(frames[position].color, labels, len(numbers)) if known is None else known[numbers - 1]
        return self._proposals(position, labels, numbers, features, held[0])

    def _proposals(
        self,
        position: int,
        labels: NDArray[np.int32],
        numbers: NDArray[np.int64],
        features: NDArray[np.float32],
        file: int,
    ) -> Proposals:
        length = np.linalg.norm(features, axis=1, keepdims=True)
        return Proposals(
            position=position,
            labels=labels,
            score=np.ones(len(numbers), np.float32),
            features=np.divide(features, length, out=np.zeros_like(features), where=length > 0),
            plane=np.full((len(numbers), 4), np.nan),
            identity=numbers + MOST_OBJECTS * file,
        )

    def _checked(self, k: int) -> NDArray[np.float32] | None:
        """Features of a file, one row for each object of its masks, None where it has none."""
        path = self._folder.files[k]
        piece = _piece(path)
        if piece.masks is None:
            raise OptionError(f"{path} has no masks, which --discovery precomputed needs")
        least, most = int(piece.masks.min(initial=0)), int(piece.masks.max(initial=0))
        rows = MOST_OBJECTS - 1 if piece.features is None else len(piece.features)
        if least < 0 or most > min(rows, MOST_OBJECTS - 1):
            raise OptionError(f"{path}: masks hold objects {least} to {most}; features has {rows} rows")
        return None if piece.features is None else np.nan_to_num(piece.features)


def _colors(color: NDArray[np.uint8], labels: NDArray[np.int32], count: int) -> NDArray[np.float32]:
    """Features of the objects 1 to `count` of a picture by their colours. Shape (count, D)."""
    rows = [color_feature(color[labels == n + 1]) for n in range(count)]
    return np.stack(rows) if rows else np.zeros((0, COLOR_PART), np.float32)


@lru_cache(maxsize=2)
def _piece(path: Path) -> Piece:
    """Return a file, read once for all anchors of a chunk."""
    return read_piece(path)
