"""Rooms whose depth our own plane sweep computes from their pictures, with all its holes and errors.

Poses are off by a smooth drift, as those of a map are. Points whose depth is known, which the sweep takes the span of
depths from, are true ones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from list3r.frames.base import Frame
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.mvs.stereo import PosedFrames, Sparse, dense_depth, stereo_noise
from training.samples import Kind, chunk_file, sample_of, write_sample
from training.worlds.film import Film, FilmSettings, make_film, reconstruction_of, varied

DRIFT_M, DRIFT_DEG = 0.003, 0.06
"""Deviation of poses, see `reconstruction_of`."""
POINTS, BORDER_PX, FAR_M = 120, 4, 8.0
"""Known points of a frame, how far from its border they lie at least, and the farthest of them."""


def swept(film: Film, seed: int) -> Reconstruction | None:
    """Return the reconstruction of a film's pictures; None where there is too little depth to tell its noise."""
    given, posed = posed_film(film, seed)
    depth, confidence = dense_depth(posed)
    noise = stereo_noise(depth, confidence)
    if noise is None:
        return None
    return replace(given, depth=depth, confidence=confidence, depth_noise=noise)


def posed_film(film: Film, seed: int, drift: float = 1.0) -> tuple[Reconstruction, PosedFrames]:
    """Return the poses of a film, off by `drift` times the usual, and its pictures with them."""
    given = reconstruction_of(film, drift_m=DRIFT_M * drift, drift_deg=DRIFT_DEG * drift, seed=seed)
    rng = np.random.default_rng([seed, 23])
    sparse = [_known(true, rng) for true in film.true_depth]
    frames = [Frame(k, float(t), film.color[k], None, None) for k, t in enumerate(film.time_s.tolist())]
    return given, PosedFrames(frames, given.posed, given.T_chunk_cam, given.camera, sparse)


def _known(depth: np.ndarray, rng: np.random.Generator) -> Sparse:
    height, width = depth.shape
    y, x = (rng.integers(BORDER_PX, side - BORDER_PX, POINTS) for side in (height, width))
    known = (depth[y, x] > 0) & (depth[y, x] < FAR_M)
    return np.stack([x, y], axis=1)[known].astype(np.float64), depth[y, x][known].astype(np.float64)


def make_swept(seed: int, folder: Path, **kind: Unpack[Kind]) -> Path | None:
    """Make the chunk of a seed and write it, unless it is there; return its file, None where depth tells too little.

    Rooms with an odd seed are filmed half as far, with twice the frames a second.
    """
    path = chunk_file(seed, folder, **kind)
    if not path.exists():
        settings = FilmSettings(seed, sensor="computed", **kind)
        settings = settings if settings.held_out else varied(settings)
        settings = replace(settings, every=1) if seed % 2 else settings
        film = make_film(settings)
        found = swept(film, seed)
        if found is None:
            return None
        write_sample(path, sample_of(film, seed, settings.every, found))
    return path
