"""Keyframes that the plane sweep's network learns from: costs, picture and true depth, one folder a room."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.mvs.network import PLANES, network_costs, network_picture
from list3r.reconstruction.mvs.settings import MvsSettings
from list3r.reconstruction.mvs.stereo import KeyframeCosts, keyframe_costs
from training.samples import Kind, chunk_file
from training.swept import posed_film
from training.worlds.film import Film, FilmSettings, make_film, varied

PARTS = ("costs", "picture", "place", "side")
"""Arrays of a room with K keyframes: uint8 (K, 64, h, w), 255 for cost 1; RGB (K, 2h, 2w, 3); true place among the
planes, float16 (K, 2h, 2w), negative where unknown; `KeyframeCosts.side_features`, (K, 3)."""
MOST_KEYFRAMES = 12
"""Kept of a room."""
UNKNOWN = -9.0


def make_keyframes(seed: int, folder: Path, **kind: Unpack[Kind]) -> Path | None:
    """Write the keyframes of a room unless they are there; return their folder, None where none can be swept.

    Three in four rooms for training have the looks of `training.worlds.looks`; their poses drift more or less, their
    keyframes have fewer and nearer sources, and depth is looked for in a shorter or longer span.
    """
    path = chunk_file(seed, folder, **kind).with_suffix("")
    if path.exists():
        return path if (path / "side.npy").exists() else None
    learned = not kind.get("held_out", False)
    settings = FilmSettings(seed, sensor="computed", **kind)
    if learned:
        settings = replace(varied(settings), looks=seed % 4 != 0)
    film, rng = make_film(replace(settings, every=1) if seed % 2 else settings), np.random.default_rng([seed, 91])
    rows = _keyframes(film, seed, rng if learned else None)
    kept = [rows[k] for k in sorted(rng.permutation(len(rows))[:MOST_KEYFRAMES].tolist())]
    fresh = path.with_name(f"{path.name}.{os.getpid()}")
    fresh.mkdir(parents=True, exist_ok=True)
    for name, images in zip(PARTS, zip(*kept, strict=True), strict=False):
        np.save(fresh / f"{name}.npy", np.stack(images))
    if path.exists():
        shutil.rmtree(fresh)
    else:
        fresh.rename(path)
    return path if kept else None


def _keyframes(film: Film, seed: int, vary: np.random.Generator | None) -> list[tuple[NDArray[np.generic], ...]]:
    drift = 1.0 if vary is None else float(np.exp(vary.normal(0.3, 0.7)))
    _, posed = posed_film(film, seed, drift)
    return [_sample(film, swept) for swept in keyframe_costs(posed, _settings(vary))]


def _settings(vary: np.random.Generator | None) -> MvsSettings:
    """Return the usual settings, or others that a stranger's walk would lead to."""
    usual = MvsSettings()
    if vary is None:
        return usual
    near, far = usual.views.reach
    reach = (near * float(np.exp(vary.normal(-0.05, 0.2))), far * float(np.exp(vary.normal(0.05, 0.25))))
    sources = int(vary.integers(2, usual.views.sources + 1)) if vary.random() < 0.5 else usual.views.sources
    ideal = usual.views.ideal_deg * (float(vary.uniform(0.2, 0.6)) if vary.random() < 0.3 else 1.0)
    return replace(usual, views=replace(usual.views, reach=reach, sources=sources, ideal_deg=ideal))


def _sample(film: Film, swept: KeyframeCosts) -> tuple[NDArray[np.generic], ...]:
    costs = (network_costs(swept.cost) * 255.0).round().numpy().astype(np.uint8)
    picture = network_picture(film.color[swept.key], *costs.shape[1:])
    (low, high), true = swept.span, film.true_depth[swept.key]
    place = (1.0 / np.maximum(true, 1e-3) - low) / (high - low) * (PLANES - 1)
    place = np.where(true > 0, np.clip(place, UNKNOWN, 3.0 * PLANES), UNKNOWN).astype(np.float16)
    return costs, picture, place, swept.side_features()
