"""The folder that Scal3R writes: `mat.txt`, `intri.yml` and `depths/`.

A row of `mat.txt` is a camera to world matrix of 16 numbers with OpenCV axes, whose rotation is scaled by the scale of
its block; `depths/N.exr` is z, already at the world's scale. `intri.yml` has `K_N`, px from the corner of the picture
of which its principal point is the middle. Depth has no confidence, so all pixels count alike.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from list3r.frames.decoding.decode import read_raw_depth
from list3r.frames.files import read_file
from list3r.memory.core.errors import SourceError
from list3r.reconstruction.feedforward.pictures import WidthSize
from list3r.reconstruction.outputs.base import Array, OutputOptions, ProgramOutput, Views, from_corner
from list3r.reconstruction.precomputed_files import Manifest, Piece

_MOST_TEXT = 2**28
_NUMBER = r"[-+0-9.eE]+"


class Scal3rReader:
    """The saved output of Scal3R."""

    name = "the result folder of Scal3R (mat.txt, intri.yml, depths)"

    def recognises(self, path: Path) -> bool:
        return (path / "mat.txt").is_file() and (path / "intri.yml").is_file() and (path / "depths").is_dir()

    def read(self, path: Path, options: OutputOptions) -> ProgramOutput:
        T, K = _poses(path / "mat.txt"), _intrinsics(path / "intri.yml")
        if len(T) != len(K):
            raise SourceError(f"{path}: mat.txt has {len(T)} poses, intri.yml {len(K)} cameras")

        def pieces() -> Iterator[Piece]:
            for n in range(len(T)):
                depth = np.asarray(read_raw_depth(path / "depths" / f"{n:06d}.exr"), np.float32)
                scaled = K[n : n + 1].copy()
                scaled[:, 0] *= depth.shape[1] / (2 * scaled[:, 0, 2, None])
                scaled[:, 1] *= depth.shape[0] / (2 * scaled[:, 1, 2, None])
                placement = options.placement(WidthSize(518), (depth.shape[0], depth.shape[1]))
                views = Views(T[n : n + 1], from_corner(scaled), depth[None], np.ones_like(depth)[None])
                yield views.piece(np.array([options.every * n]), placement, path)

        return ProgramOutput(Manifest("relative", "scal3r"), pieces())


def _poses(path: Path) -> Array:
    """Return the rigid poses of a file of matrices. Raises `SourceError`."""
    try:
        rows = np.array(
            [line.split() for line in read_file(path, _MOST_TEXT).decode().splitlines() if line], np.float64
        )
    except ValueError:
        rows = np.zeros((0, 0))
    if rows.ndim != 2 or rows.shape[1:] != (16,) or not len(rows):
        raise SourceError(f"{path} is not a list of poses of 16 numbers each")
    T = rows.reshape(-1, 4, 4)
    scale = np.cbrt(np.linalg.det(T[:, :3, :3]))
    T[:, :3, :3] /= np.where(np.abs(scale) > 1e-9, scale, np.nan)[:, None, None]
    return np.asarray(T)


def _intrinsics(path: Path) -> Array:
    """Return the intrinsic matrices of a file, in order of their names. Raises `SourceError`."""
    text = read_file(path, _MOST_TEXT).decode("utf-8", "replace")
    found = re.findall(rf"^K_(\w+):.*?data:\s*\[\s*((?:{_NUMBER}\s*,\s*){{8}}{_NUMBER})\s*\]", text, re.S | re.M)
    try:
        K = [np.array(numbers.split(","), np.float64).reshape(3, 3) for _, numbers in sorted(found)]
    except ValueError:
        K = []
    if not K or min(float(k[[0, 1, 0, 1], [0, 1, 2, 2]].min()) for k in K) <= 0:
        raise SourceError(f"{path} holds no intrinsics K_N of 9 numbers each")
    return np.stack(K)
