"""Training of what tells readings off their surface: true masks of films, and how far each reading lies off its thing.

python -m training.readings --out DIR --worlds 60

Samples are kept in the folder and not made again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import nn
from torch.nn import functional as F

from list3r.instances.geometric.views import ChunkViews
from list3r.instances.learned.readings import FEATURES, OFF_M, reading_features
from list3r.instances.learned.weights import load_weights, write_weights
from list3r.reconstruction.base import backproject
from training.samples import chunk_settings
from training.worlds.film import Film, FilmSettings, frames_of, make_film, reconstruction_of, varied

FIRST_SEED = 8001
OF_EACH = 1500
"""Readings of a thing that are learned from, at most."""
HIDDEN, STEPS, BATCH, RATE = 32, 6000, 1024, 3e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of samples")
    parser.add_argument("--worlds", type=int, default=60)
    parser.add_argument("--weights", type=Path, required=True, help="file of weights into which these are written")
    words = parser.parse_args()
    torch.set_num_threads(1)
    arrays = fit_readings([make_readings(FIRST_SEED + k, words.out) for k in range(words.worlds)])
    write_weights(words.weights, {**load_weights(words.weights), **arrays})


def make_readings(seed: int, folder: Path) -> Path:
    """Make the readings of the film of a seed and write them, unless they are there already; return their file."""
    path = folder / f"readings-{seed:06d}.npz"
    if not path.exists():
        settings = varied(FilmSettings(seed, fitted=seed % 3 == 0))
        x, off = readings_of(make_film(settings), seed, settings.every)
        folder.mkdir(parents=True, exist_ok=True)
        new = path.with_suffix(".new.npz")
        np.savez(new, x=x.astype(np.float16), off=off)
        new.replace(path)
    return path


def readings_of(film: Film, seed: int, every: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return features of readings of true masks and how far each lies off its thing, metres. (N, FEATURES), (N,)."""
    views = ChunkViews(frames_of(film), reconstruction_of(film, seed=seed), chunk_settings(every))
    bound, stride = [t.id for t in film.things if t.structure], views.stride
    ids = [film.ids[p][::stride, ::stride].astype(np.int32) for p in views.anchors]
    images = [np.where(np.isin(i, bound), 0, i) for i in ids]
    surface = [true_surface(film, views, p) for p in views.anchors]
    x = reading_features(views, views.anchors, images)
    shown = [(views.view(p), image, image > 0) for p, image in zip(views.anchors, images, strict=True)]
    points = np.concatenate([v.points[mask & v.confirmed] for v, _, mask in shown])
    owner = np.concatenate([image[mask & v.confirmed] for v, image, mask in shown])
    true, of = np.concatenate([s.reshape(-1, 3) for s in surface]), np.concatenate([i.ravel() for i in images])
    rng, rows, away = np.random.default_rng(seed), [], []
    for thing in np.unique(owner).tolist():
        mine, there = np.flatnonzero(owner == thing), true[of == thing]
        if len(mine) >= LEAST and len(there):
            mine = rng.permutation(mine)[:OF_EACH]
            away.append(cKDTree(there[:: max(1, len(there) // 20000)]).query(points[mine])[0])
            rows.append(mine)
    return x[np.concatenate(rows)], np.concatenate(away).astype(np.float32)


LEAST = 30
"""Readings of a thing from which it is learned from."""


def true_surface(film: Film, views: ChunkViews, position: int) -> NDArray[np.float32]:
    """Return the true surface that a view shows, in the chunk's frame. Shape (h, w, 3)."""
    T = views.reconstruction.T_chunk_cam[0] @ np.linalg.inv(film.T_world_cam[0]) @ film.T_world_cam[position]
    depth = np.ascontiguousarray(film.true_depth[position][:: views.stride, :: views.stride])
    return np.asarray(backproject(depth, views.camera) @ T[:3, :3].T + T[:3, 3], np.float32)


def fit_readings(paths: Sequence[Path], seed: int = 0) -> Mapping[str, NDArray[Any]]:
    """Return the arrays of the network that tells whether a reading is off its surface."""
    data = [np.load(p) for p in paths]
    x = np.concatenate([d["x"] for d in data]).astype(np.float32)
    off = torch.from_numpy((np.concatenate([d["off"] for d in data]) > OFF_M).astype(np.float32))
    mean, std = x.mean(axis=0), x.std(axis=0) + 1e-3
    given, rng = torch.from_numpy((x - mean) / std), np.random.default_rng(seed)
    torch.manual_seed(seed)
    net = nn.Sequential(nn.Linear(FEATURES, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))
    optimiser, losses = torch.optim.Adam(net.parameters(), RATE), []
    for step in range(STEPS):
        for group in optimiser.param_groups:
            group["lr"] = RATE * 0.5 * (1 + float(np.cos(np.pi * step / STEPS)))
        rows = torch.from_numpy(rng.integers(len(x), size=BATCH))
        loss = F.binary_cross_entropy_with_logits(net(given[rows])[:, 0], off[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    told = {"readings": len(x), "off": round(float(off.mean()), 4), "loss": round(float(np.mean(losses[-500:])), 4)}
    print(json.dumps(told))  # noqa: T201
    arrays: dict[str, NDArray[Any]] = {"readings.mean": mean, "readings.std": std}
    for number in (0, 2):
        arrays |= {f"readings.net.{number}.{n}": v.detach().numpy() for n, v in net[number].named_parameters()}
    return arrays


if __name__ == "__main__":
    main()
