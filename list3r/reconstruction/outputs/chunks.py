"""The chunks of VGGT-Long and Pi-Long, each in a frame of reference and at a scale of its own.

Both keep `_tmp_results_unaligned/chunk_N.npy` when their configuration says `delete_temp_files: False`: a pickled
dictionary, which is not read here. docs/precomputed.md has the three lines that make `chunk_N.npz` of it. VGGT-Long
has `extrinsic` (n, 4, 4), camera to world, `intrinsic` (n, 3, 3) px from the corner, `depth` and `depth_conf` = 1 +
exp(x); with pi3 inside `world_points` (n, h, w, 3) and `world_points_conf` in [0, 1] instead of the last three.
Pi-Long has `camera_poses`, camera to world, `local_points` in each camera, and `conf` (n, h, w, 1) in [0, 1]. Length
and overlap of the chunks are in the copy of the configuration next to them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import read_file
from list3r.memory.core.errors import SourceError
from list3r.reconstruction.feedforward.network import sigmoid_of_expp1
from list3r.reconstruction.feedforward.pictures import Placement, WidthSize
from list3r.reconstruction.feedforward.points import from_points, in_camera
from list3r.reconstruction.outputs.base import OutputOptions, ProgramOutput, Views, from_corner, homogeneous
from list3r.reconstruction.precomputed_files import Manifest, Piece, read_arrays

UNALIGNED = "_tmp_results_unaligned"
_NAMES = (
    *("extrinsic", "intrinsic", "depth", "depth_conf", "world_points", "world_points_conf"),
    *("camera_poses", "local_points", "conf"),
)
_MOST_CONFIGURATION = 2**20


class ChunksReader:
    """The saved chunks of VGGT-Long or Pi-Long."""

    name = f"the folder of VGGT-Long or Pi-Long ({UNALIGNED}/chunk_N.npz)"

    def recognises(self, path: Path) -> bool:
        return (path / UNALIGNED).is_dir()

    def read(self, path: Path, options: OutputOptions) -> ProgramOutput:
        files = sorted((path / UNALIGNED).glob("chunk_*.npz"), key=lambda p: int(re.sub(r"\D", "", p.stem) or 0))
        if not files:
            raise SourceError(f"{path / UNALIGNED} holds no chunk_N.npz: see docs/precomputed.md for chunk_N.npy")
        length, overlap = _plan(path)

        def pieces() -> Iterator[Piece]:
            for k, file in enumerate(files):
                views, cut = _views(read_arrays(file, _NAMES), file)
                size = views.depth.shape[1:3]
                placement = options.placement(WidthSize(518), size) if cut else Placement(size, size)
                frames = options.every * (k * (length - overlap) + np.arange(len(views.depth)))
                yield views.piece(frames, placement, file)

        return ProgramOutput(Manifest("relative", "chunks", options.every * length, options.every * overlap), pieces())


def _plan(path: Path) -> tuple[int, int]:
    """Return length and overlap of the chunks in the configuration. Raises `SourceError` where they are missing."""
    for file in sorted(path.glob("*.yaml")):
        text = read_file(file, _MOST_CONFIGURATION).decode("utf-8", "replace")
        found = [re.search(rf"^\s*{name}\s*:\s*(\d+)", text, re.MULTILINE) for name in ("chunk_size", "overlap")]
        if all(found):
            length, overlap = (int(m.group(1)) for m in found if m is not None)
            if 0 < overlap < length:
                return length, overlap
    raise SourceError(f"{path} has no .yaml with the chunk_size and overlap of its chunks")


def _views(found: dict[str, NDArray[Any]], file: Path) -> tuple[Views, bool]:
    """Return a chunk's views, and whether its pictures were made by VGGT's loader. Raises `SourceError`."""
    if {"camera_poses", "local_points", "conf"} <= found.keys():
        return _of_points(found["camera_poses"], found["local_points"], found["conf"]), False
    if {"extrinsic", "intrinsic", "depth", "depth_conf"} <= found.keys():
        depth, sure = (np.asarray(found[k], np.float32) for k in ("depth", "depth_conf"))
        depth = depth[..., 0] if depth.ndim == 4 else depth
        K = from_corner(found["intrinsic"])
        return Views(homogeneous(found["extrinsic"]), K, depth, sigmoid_of_expp1(sure)), True
    if {"extrinsic", "world_points", "world_points_conf"} <= found.keys():
        T, points = homogeneous(found["extrinsic"]), np.asarray(found["world_points"], np.float32)
        if points.ndim == 4 and len(T) == len(points):
            points = np.stack([in_camera(t, p) for t, p in zip(T, points, strict=True)])
            return _of_points(T, points, found["world_points_conf"]), False
    has = ", ".join(sorted(found)) or "nothing known"
    raise SourceError(f"{file} holds {has}; a chunk of VGGT-Long or Pi-Long has poses and depth or points")


def _of_points(poses: NDArray[Any], points: NDArray[Any], confidence: NDArray[Any]) -> Views:
    T, sure = homogeneous(poses), np.asarray(confidence, np.float32)
    sure = sure[..., 0] if sure.ndim == 4 else sure
    said = from_points(T, np.asarray(points, np.float32), sure)
    K = np.tile(np.eye(3), (len(T), 1, 1))
    K[:, [0, 1], [0, 1]], K[:, :2, 2] = said.focal, said.principal
    return Views(T, K, said.depth, said.confidence)
