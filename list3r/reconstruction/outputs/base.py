"""Geometry that other programs saved of a video, converted to the layout of `precomputed`.

Each program is one file of this room: it recognises its output, and reads it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import SourceError
from list3r.reconstruction.feedforward.pictures import Loader, Placement
from list3r.reconstruction.precomputed_files import Manifest, Piece

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OutputOptions:
    """Facts that a program's files do not contain."""

    every: int = 1
    """They are of every n-th frame of the video."""
    frame_size: tuple[int, int] | None = None
    """Height and width of the video's frames, px, for programs that cut them; None where nothing was cut."""
    masks: Path | None = None
    """A folder of EntitySAM with the instances of the same frames."""

    def placement(self, loader: Loader, size: tuple[int, int]) -> Placement:
        """Return the placement of pictures of a size in the frames. Raises `SourceError` where the loader makes other
        ones."""
        if self.frame_size is None:
            return Placement(size, size)
        placed = loader.place(*self.frame_size)
        if placed.size != size:
            height, width = self.frame_size
            raise SourceError(
                f"frames of {width}x{height} become pictures of {placed.size[1]}x{placed.size[0]}, and these are "
                f"{size[1]}x{size[0]}: give the size of the video's frames with --frame-size"
            )
        return placed


@dataclass(frozen=True)
class ProgramOutput:
    """The saved output of a program."""

    manifest: Manifest
    pieces: Iterator[Piece]
    """In order of their frames."""


class OutputReader(Protocol):
    """Reads the output of one program."""

    name: str
    """Of the program, and what it saves."""

    def recognises(self, path: Path) -> bool:
        """Return whether a path is this program's output."""
        ...

    def read(self, path: Path, options: OutputOptions) -> ProgramOutput:
        """Return the saved output. Raises `SourceError` for files that do not fit together, `OptionError` for damaged
        ones."""
        ...


@dataclass(frozen=True)
class Views:
    """A program's output for n pictures."""

    T_world_cam: Array
    """OpenCV axes. Shape (n, 4, 4)."""
    K: Array
    """Pixel centres at whole numbers. Shape (n, 3, 3)."""
    depth: NDArray[np.float32]
    """Along the camera's z. Shape (n, h, w)."""
    confidence: NDArray[np.float32]
    """In [0, 1]. Shape (n, h, w)."""

    def piece(self, frames: NDArray[np.int64], placement: Placement, path: Path) -> Piece:
        """Return them as a file's contents for whole frames. Raises `SourceError` when they do not fit each other."""
        count = len(frames)
        fits = self.depth.ndim == 3 and len(self.depth) == count and self.confidence.shape == self.depth.shape
        if not count or not fits or self.T_world_cam.shape != (count, 4, 4) or self.K.shape != (count, 3, 3):
            raise SourceError(
                f"{path}: its arrays do not fit each other (depth {self.depth.shape}, poses {self.T_world_cam.shape}, "
                f"intrinsics {self.K.shape})"
            )
        good: NDArray[np.bool_] = np.asarray(np.isfinite(self.T_world_cam).all(axis=(1, 2)))
        good[good] = np.abs(np.linalg.det(self.T_world_cam[good][:, :3, :3]) - 1) < 0.05
        T = np.where(good[:, None, None], self.T_world_cam, np.nan)
        known = np.isfinite(self.depth) & (self.depth > 0)
        fx, fy = self.K[:, 0, 0], self.K[:, 1, 1]
        return Piece(
            frames=frames,
            T_world_cam=T,
            intrinsics=np.stack([fx, fy, self.K[:, 0, 2] - placement.left, self.K[:, 1, 2] - placement.top], axis=1),
            depth=placement.whole(np.where(known, self.depth, 0).astype(np.float32)),
            confidence=placement.whole(np.where(known, self.confidence, 0).astype(np.float32)),
        )


def homogeneous(rows: NDArray[Any]) -> Array:
    """Return poses of shape (F, 3, 4), (F, 4, 4) or (F, 16) as (F, 4, 4); none for any other shape."""
    stated = np.asarray(rows, np.float64)
    stated = stated.reshape(-1, 4, 4) if stated.ndim == 2 and stated.shape[1] == 16 else stated
    if stated.ndim != 3 or stated.shape[1:] not in ((3, 4), (4, 4)):
        return np.zeros((0, 4, 4))
    out = np.tile(np.eye(4), (len(stated), 1, 1))
    out[:, :3] = stated[:, :3]
    return out


def inverses(T: Array) -> Array:
    """Inverses of poses (F, 4, 4); NaN for invalid ones."""
    good: NDArray[np.bool_] = np.asarray(np.isfinite(T).all(axis=(1, 2)))
    good[good] = np.abs(np.linalg.det(T[good][:, :3, :3])) > 1e-6
    out = np.full(T.shape, np.nan)
    out[good] = np.linalg.inv(T[good])
    return out


def from_corner(K: NDArray[Any]) -> Array:
    """Intrinsics (F, 3, 3) that count pixels from the picture's corner, counted from the first pixel's centre."""
    out = np.array(K, np.float64)
    if out.ndim == 3:
        out[:, :2, 2] -= 0.5
    return out
