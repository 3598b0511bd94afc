"""Predictions that networks' own programs save, brought to the layout of `precomputed`.

VGGT's demo writes `predictions.npz` with `extrinsic` (S, 3, 4), `intrinsic`, `depth` (S, h, w, 1) and `depth_conf`;
Depth Anything 3 exports `results.npz` with `extrinsics`, `intrinsics`, `depth` (N, h, w) and `conf`. In both poses lead
from the world to the camera with OpenCV's axes, and confidence is 1 + exp(x).
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import ExportError, SourceError
from list3r.reconstruction.networks.feedforward import sigmoid_of_expp1
from list3r.reconstruction.precomputed_files import Manifest, Piece, read_arrays, write_manifest, write_piece

Array = NDArray[np.float64]


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


def convert_predictions(path: Path, folder: Path, every: int = 1) -> int:
    """Write the folder of `precomputed` from predictions of every n-th frame; the number of frames.

    Raises `SourceError` for what is no such file, `OptionError` for a damaged one, `ExportError` for a folder that
    exists or cannot be written.
    """
    if not path.is_file():
        raise SourceError(f"{path} does not exist or is no file; give predictions.npz of VGGT or results.npz of DA3")
    if folder.exists():
        raise ExportError(f"{folder} exists; name another folder or remove it first")
    if not folder.parent.is_dir():
        raise ExportError(f"the folder {folder.parent} does not exist; create it first")
    piece, model = read_predictions(path, every)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir()
        write_piece(temporary / "predictions.npz", piece)
        write_manifest(temporary, Manifest("relative", model))
        temporary.rename(folder)
    except OSError as error:
        raise ExportError(f"{folder} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return len(piece.frames)


def read_predictions(path: Path, every: int = 1) -> tuple[Piece, str]:
    """Return what a file predicts, and by which model. Raises `SourceError` and `OptionError`."""
    names = sorted({n for p in PROGRAMS for n in (p.poses, p.intrinsics, p.confidence)} | {"depth"})
    found = read_arrays(path, tuple(names))
    program = next((p for p in PROGRAMS if {p.poses, p.intrinsics, "depth"} <= found.keys()), None)
    if program is None:
        has = ", ".join(sorted(found)) or "nothing known"
        raise SourceError(f"{path} holds {has}; predictions of VGGT or DA3 have depth, intrinsics and extrinsics")
    depth = np.asarray(found["depth"], np.float32)
    depth = depth[..., 0] if depth.ndim == 4 else depth
    count = len(depth)
    T_cam_world, K = _poses(found[program.poses]), np.asarray(found[program.intrinsics], np.float64)
    confidence = found.get(program.confidence)
    sure = np.ones_like(depth) if confidence is None else sigmoid_of_expp1(np.asarray(confidence, np.float32))
    fits = depth.ndim == 3 and T_cam_world.shape == (count, 4, 4) and K.shape == (count, 3, 3)
    if not fits or sure.shape != depth.shape or not count:
        raise SourceError(f"{path}: its arrays do not fit each other (depth {depth.shape}, intrinsics {K.shape})")
    good = np.isfinite(T_cam_world).all(axis=(1, 2)) & (np.abs(np.linalg.det(T_cam_world[:, :3, :3]) - 1) < 0.05)
    T = np.full((count, 4, 4), np.nan)
    T[good] = np.linalg.inv(T_cam_world[good])
    known = np.isfinite(depth) & (depth > 0)
    return Piece(
        frames=every * np.arange(count),
        T_world_cam=T,
        intrinsics=np.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2] - 0.5, K[:, 1, 2] - 0.5], axis=1),
        depth=np.where(known, depth, 0).astype(np.float32),
        confidence=np.where(known, sure, 0).astype(np.float32),
    ), program.model


def _poses(rows: NDArray[Any]) -> Array:
    """Return poses of shape (F, 3, 4) or (F, 4, 4) as (F, 4, 4)."""
    stated = np.asarray(rows, np.float64)
    if stated.ndim != 3 or stated.shape[1:] not in ((3, 4), (4, 4)):
        return np.zeros((0, 4, 4))
    out = np.tile(np.eye(4), (len(stated), 1, 1))
    out[:, :3] = stated[:, :3]
    return out
