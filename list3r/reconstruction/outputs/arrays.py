"""One file of arrays of a whole video: VGGT's demo and Depth Anything 3's export.

VGGT's demo writes `predictions.npz` with `extrinsic` (S, 3, 4), `intrinsic`, `depth` (S, h, w, 1) and `depth_conf`;
Depth Anything 3 exports `results.npz` with `extrinsics`, `intrinsics`, `depth` (N, h, w) and `conf`. In both poses lead
from the world to the camera with OpenCV's axes, pixels count from the corner, and confidence is 1 + exp(x).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from list3r.memory.core.errors import SourceError
from list3r.reconstruction.feedforward.network import sigmoid_of_expp1
from list3r.reconstruction.feedforward.pictures import Placement, WidthSize
from list3r.reconstruction.outputs.base import (
    OutputOptions,
    ProgramOutput,
    Views,
    from_corner,
    homogeneous,
    inverses,
)
from list3r.reconstruction.precomputed_files import Manifest, Piece, read_arrays


@dataclass(frozen=True)
class PredictionNames:
    """How a program calls its arrays."""

    model: str
    poses: str
    intrinsics: str
    confidence: str


PROGRAMS = (
    PredictionNames("vggt", "extrinsic", "intrinsic", "depth_conf"),
    PredictionNames("da3", "extrinsics", "intrinsics", "conf"),
)


class ArraysReader:
    """Predictions of VGGT or Depth Anything 3."""

    name = "predictions.npz of VGGT or results.npz of DA3"

    def recognises(self, path: Path) -> bool:
        return path.is_file()

    def read(self, path: Path, options: OutputOptions) -> ProgramOutput:
        names = sorted({n for p in PROGRAMS for n in (p.poses, p.intrinsics, p.confidence)} | {"depth"})
        found = read_arrays(path, tuple(names))
        program = next((p for p in PROGRAMS if {p.poses, p.intrinsics, "depth"} <= found.keys()), None)
        if program is None:
            has = ", ".join(sorted(found)) or "nothing known"
            raise SourceError(f"{path} holds {has}; predictions of VGGT or DA3 have depth, intrinsics and extrinsics")
        depth = np.asarray(found["depth"], np.float32)
        depth = depth[..., 0] if depth.ndim == 4 else depth
        confidence = found.get(program.confidence)
        sure = np.ones_like(depth) if confidence is None else sigmoid_of_expp1(np.asarray(confidence, np.float32))
        T = inverses(homogeneous(found[program.poses]))
        views = Views(T, from_corner(found[program.intrinsics]), depth, sure)
        size = depth.shape[1:3] if depth.ndim == 3 else (1, 1)
        cut = program.model == "vggt"
        placement = options.placement(WidthSize(518), size) if cut else Placement(size, size)

        def pieces() -> Iterator[Piece]:
            yield views.piece(options.every * np.arange(len(depth)), placement, path)

        return ProgramOutput(Manifest("relative", program.model), pieces())
