"""Learn the vocabulary of frame descriptors (`list3r/reconstruction/features/vocabulary.npz`) on simulated rooms.

python benchmarks/vocabulary.py --out list3r/reconstruction/features/vocabulary.npz
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import faiss
import numpy as np

from benchmarks.simulation.presets import make_shot
from list3r.frames.base import Camera
from list3r.frames.sift import root_sift
from list3r.reconstruction.features.local import detect
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.simulation.rendering.render import Renderer

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
VIDEOS = (("loop", 101), ("calm", 102), ("kidnap", 103), ("dynamic", 104))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--words", type=int, default=64)
    parser.add_argument("--axes", type=int, default=31)
    parser.add_argument("--every", type=int, default=90, help="frames between pictures")
    args = parser.parse_args()
    x = root_sift(np.concatenate([descriptors(*video, args.every) for video in VIDEOS]))
    mean = x.mean(axis=0)
    axes = np.linalg.svd((x - mean)[::5], full_matrices=False)[2][: args.axes].T
    kmeans = faiss.Kmeans(args.axes, args.words, niter=20, seed=1)
    kmeans.train(np.ascontiguousarray((x - mean) @ axes, np.float32))
    half = {"mean": mean, "axes": axes, "words": kmeans.centroids}
    np.savez_compressed(args.out, **{name: value.astype(np.float16) for name, value in half.items()})
    print(f"{args.words} args of {len(x)} descriptors: {args.out}")


def descriptors(preset: str, seed: int, every: int) -> np.ndarray:
    """SIFT descriptors of some pictures of a simulated video."""
    blank = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    found = (detect(p, blank, CAMERA, FeatureSettings()) for p in noisy_pictures(preset, seed, every))
    return np.concatenate([f.descriptors for f in found])


def noisy_pictures(preset: str, seed: int, every: int) -> Iterator[np.ndarray]:
    """Some pictures of a simulated video, with the noise of a camera."""
    shot = make_shot(preset, seed, movers=False)
    renderer, rng = Renderer(shot.building.world, CAMERA), np.random.default_rng(seed)
    for pose in shot.T_world_cam[::every]:
        color = renderer.render(pose).color
        yield np.clip(color + rng.normal(0, 3, color.shape), 0, 255).astype(np.uint8)


if __name__ == "__main__":
    main()
