"""Place recognition: recall of true revisits by frame, and the time of a query.

    python benchmarks/places.py --walk FOLDER --source .../redkitchen --seeds 1,2 --aliked .../aliked-n16.pth --json F

`--walk` is a folder `images`, `depth` (mm), `poses.txt` (camera to world, a row a frame) and `K.txt`, `--source` what
list3r reads, with depth and poses; `--seeds` are simulated homes (preset `loop`) whose second half has another light.
A frame that has revisits asks all frames at least 80 apart. A revisit: both see 30 % of the other's surface; `near`:
the cameras are within 1.5 m and 45 degrees. Recall@k: the share of these frames with a revisit among the first k.

Methods: hashed words, idf; VLAD of SIFT with the vocabulary of the package; VLAD (256 words) and Fisher vectors (64)
learned on simulated homes of other seeds, 256 whitened components; mutual matches with a ratio test against every
frame, SIFT and ALIKED; votes of local features, as builds have them. Times are of one thread at 2,000 frames; those of
matching are extrapolated from what there is.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import faiss
import numpy as np
from machine import write_json
from numpy.typing import NDArray

from benchmarks.simulation.presets import make_shot
from benchmarks.vocabulary import CAMERA, VIDEOS, noisy_pictures
from list3r.association.revisits.frame_search import FeatureIndex, FrameIndex, sift_rows
from list3r.evaluation.covisibility import covisibility
from list3r.evaluation.revisits import frame_labels
from list3r.frames.base import Camera
from list3r.frames.source import open_source
from list3r.reconstruction.features.learned import as_bytes
from list3r.reconstruction.features.local import detect, nearest_pairs
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.reconstruction.features.vlad import Vocabulary, describe_frame, root_sift
from list3r.simulation.rendering.render import Renderer

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
APART, NEAR_M, NEAR_DEG, MANY, CHUNK = 80, 1.5, 45.0, 2000, 32
EVERY = {"walk": 3, "source": 8, "simulated": 12}
"""Of every so many frames one is taken; simulated ones have 30 a second."""


@dataclass(frozen=True)
class Recording:
    """Frames with their truth."""

    name: str
    number: NDArray[np.int64]
    """Frame numbers (F,)."""
    color: list[NDArray[np.uint8]]
    depth: list[Floats]
    camera: Camera
    T_world_cam: Array
    """(F, 4, 4)."""

    def truths(self) -> dict[str, NDArray[np.bool_]]:
        """Which pairs of frames are revisits, (F, F), by kind."""
        small = self.camera.shrunk(160)
        size = small.width, small.height
        maps = np.stack([cv2.resize(d, size, interpolation=cv2.INTER_NEAREST) for d in self.depth])
        at, axis = self.T_world_cam[:, :3, 3], self.T_world_cam[:, :3, 2]
        near = np.linalg.norm(at[:, None] - at, axis=-1) < NEAR_M
        near &= axis @ axis.T > np.cos(np.radians(NEAR_DEG))
        seen, _ = frame_labels(covisibility(maps, self.T_world_cam, small))
        return {"seen": seen & self.apart(), "near": near & self.apart()}

    def apart(self) -> NDArray[np.bool_]:
        """Which pairs of frames count, (F, F)."""
        return np.asarray(np.abs(self.number[:, None] - self.number) >= APART)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walk", type=Path)
    parser.add_argument("--source", type=Path)
    parser.add_argument("--seeds", default="", help="of simulated homes, such as 1,2")
    parser.add_argument("--aliked", type=Path, help="weights")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    faiss.omp_set_num_threads(1)
    recordings: list[Callable[[], Recording]] = []
    if args.walk is not None:
        recordings.append(lambda: walk(args.walk))
    if args.source is not None:
        recordings.append(lambda: source(args.source))
    recordings += [lambda seed=seed: simulated(int(seed)) for seed in args.seeds.split(",") if seed]
    learned = learn()
    result: dict[str, Any] = {}
    for make in recordings:
        recording = make()
        result[recording.name] = measure(recording, learned, args.aliked)
        for method, row in result[recording.name]["methods"].items():
            print(recording.name, method, row, flush=True)
        write_json(args.json, {"apart": APART, "recordings": result})


def walk(folder: Path) -> Recording:
    """A folder of pictures, depth in mm, poses and a camera."""
    names = sorted(p.name for p in (folder / "images").iterdir())
    number = np.arange(0, len(names), EVERY["walk"])
    color = [cv2.imread(str(folder / "images" / names[k]))[..., ::-1].copy() for k in number]
    depth = [cv2.imread(str(folder / "depth" / names[k]), -1).astype(np.float32) / 1000 for k in number]
    K = np.loadtxt(folder / "K.txt")
    camera = Camera(color[0].shape[1], color[0].shape[0], K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    return Recording(
        folder.name, number, color, depth, camera, np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)[number]
    )


def source(path: Path) -> Recording:
    """What list3r reads."""
    opened = open_source(path)
    assert opened.info.camera is not None
    frames: list[Any] = []
    for first in range(0, opened.info.frame_count, EVERY["source"]):
        frames += opened.read(first, first + 1)
    number = np.array([f.index for f in frames])
    poses = np.stack([f.T_source_cam for f in frames])
    return Recording(path.name, number, [f.color for f in frames], [f.depth for f in frames], opened.info.camera, poses)


def simulated(seed: int) -> Recording:
    """A walk through a simulated home whose second half is filmed in dim, warm light."""
    shot = make_shot("loop", seed, movers=False)
    number = np.arange(0, len(shot.T_world_cam), EVERY["simulated"])
    renderer, rng = Renderer(shot.building.world, CAMERA), np.random.default_rng(seed)
    color, depth = [], []
    for k in number:
        view = renderer.render(shot.T_world_cam[k])
        light = np.array([1.0, 1.0, 1.0]) if k < len(shot.T_world_cam) / 2 else np.array([0.55, 0.48, 0.38])
        color.append(np.clip(view.color * light + rng.normal(0, 3, view.color.shape), 0, 255).astype(np.uint8))
        depth.append(np.asarray(view.depth, np.float32))
    return Recording(f"simulated {seed}", number, color, depth, CAMERA, shot.T_world_cam[number])


def measure(r: Recording, learned: dict[str, Aggregation], aliked: Path | None) -> dict[str, Any]:
    """Recall and times of every method."""
    sift = [detect(c, d, r.camera, FeatureSettings()).descriptors for c, d in zip(r.color, r.depth, strict=True)]
    truths, apart = r.truths(), r.apart()
    rows: dict[str, Any] = {}

    def add(name: str, likeness: Array, ms: float) -> None:
        rows[name] = {k: recall(np.where(apart, likeness, -np.inf), t) for k, t in truths.items()} | {
            "ms": round(float(ms), 2)
        }

    vectors = {"hashed words": hashed(sift), "vlad": np.stack([describe_frame(d) for d in sift])}
    vectors |= {name: np.stack([how.vector(d) for d in sift]) for name, how in learned.items()}
    for name, x in vectors.items():
        add(name, x @ x.T, vector_ms(x.astype(np.float32)))
    for name, found, ratio in (
        ("matches", [(root_sift(d)) for d in sift], 0.8),
        ("aliked matches", [] if aliked is None else aliked_of(r.color, aliked), 0.95),
    ):
        if found:
            started = time.process_time()
            counts = matches(found, apart, ratio)
            add(name, counts, 1000 * MANY * (time.process_time() - started) / max(1, np.tril(apart).sum()))
    index, queries = FeatureIndex(), sift_rows(sift)
    keys = np.stack([np.zeros_like(r.number), r.number], axis=1)
    for first in range(0, len(keys), CHUNK):
        index.add(keys[first : first + CHUNK], queries[first : first + CHUNK])
    found_rows, found_votes = index.search(queries, apart, len(keys))
    votes = np.zeros(apart.shape)
    np.put_along_axis(votes, found_rows, found_votes, axis=1)
    add("votes", votes, votes_ms(queries, keys))
    return {
        "frames": len(r.number),
        "pairs": {name: int(np.tril(t).sum()) for name, t in truths.items()},
        "asking": {name: int(t.any(axis=1).sum()) for name, t in truths.items()},
        "methods": rows,
    }


def recall(likeness: Array, truth: NDArray[np.bool_]) -> dict[str, float]:
    """Recall at 1, 5 and 20."""
    asking = np.flatnonzero(truth.any(axis=1))
    order = np.argsort(-likeness[asking], axis=1, kind="stable")
    right = np.take_along_axis(truth[asking], order, axis=1)
    return {f"@{k}": round(float(right[:, :k].any(axis=1).mean()), 3) for k in (1, 5, 20)} if len(asking) else {}


@dataclass(frozen=True)
class Aggregation:
    """Residuals of local features to words, and for Fisher vectors their squares, in whitened components."""

    words: Floats
    deviation: Floats | None
    """Of each word's features (K, d), or None: VLAD."""
    mean: Floats
    axes: Floats
    """Whitening, columns."""

    def vector(self, descriptors: NDArray[np.uint8]) -> Floats:
        """Unit vector of a frame's SIFT descriptors."""
        x = (aggregated(descriptors, self.words, self.deviation) - self.mean) @ self.axes
        return np.asarray(x / max(float(np.linalg.norm(x)), 1e-9), np.float32)


def aggregated(descriptors: NDArray[np.uint8], words: Floats, deviation: Floats | None) -> Floats:
    """Power-normalised sums of residuals."""
    x = Vocabulary.built_in().reduced(root_sift(descriptors))
    word = np.argmin((words**2).sum(axis=1) - 2.0 * x @ words.T, axis=1)
    off = x - words[word]
    if deviation is not None:
        scaled = off / deviation[word]
        off = np.concatenate([scaled, (scaled**2 - 1.0) / np.sqrt(2.0)], axis=1)
    sums = np.zeros((len(words), off.shape[1]), np.float64)
    np.add.at(sums, word, off)
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray(sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9), np.float32)


def learn(components: int = 256) -> dict[str, Aggregation]:
    """VLAD and Fisher vectors of simulated homes."""
    pictures = [
        detect(p, np.zeros(p.shape[:2], np.float32), CAMERA, FeatureSettings()).descriptors
        for video in VIDEOS
        for p in noisy_pictures(*video, 45)
    ]
    pictures = [p for p in pictures if len(p) > 50]
    x = Vocabulary.built_in().reduced(root_sift(np.concatenate(pictures)))
    out = {}
    for name, count in (("vlad 256, whitened", 256), ("fisher 64, whitened", 64)):
        kmeans = faiss.Kmeans(x.shape[1], count, niter=15, seed=1)
        kmeans.train(x)
        words, deviation = kmeans.centroids, None
        if "fisher" in name:
            word = kmeans.index.search(x, 1)[1].ravel()
            deviation = np.stack([x[word == k].std(axis=0) + np.float32(0.02) for k in range(count)])
        v = np.stack([aggregated(p, words, deviation) for p in pictures])
        mean = v.mean(axis=0)
        _, s, vt = np.linalg.svd(v - mean, full_matrices=False)
        kept = min(components, len(s) - 1)
        axes = vt[:kept].T / (s[:kept] / np.sqrt(len(v)) + 0.1 * s[0] / np.sqrt(len(v)))
        out[name] = Aggregation(words, deviation, mean, axes.astype(np.float32))
    return out


def hashed(sift: Sequence[NDArray[np.uint8]], bits: int = 12) -> Floats:
    """Histograms of words that are signs on random planes, weighted by how few frames have a word."""
    planes = np.random.default_rng(0).normal(size=(128, bits))
    mean = Vocabulary.built_in().mean
    words = [((root_sift(d) - mean) @ planes > 0) @ (1 << np.arange(bits)) for d in sift]
    counts = np.stack([np.bincount(w, minlength=1 << bits) for w in words]).astype(np.float32)
    x = np.sqrt(counts) * np.log(len(sift) / np.maximum((counts > 0).sum(axis=0), 1))
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9))


def aliked_of(color: Sequence[NDArray[np.uint8]], weights: Path) -> list[Floats]:
    """Descriptors of ALIKED, as they are stored."""
    from list3r.reconstruction.features.aliked import Aliked

    network = Aliked(weights)
    return [root_sift(as_bytes(network(c, 400).descriptors)) for c in color]


def matches(features: Sequence[Floats], apart: NDArray[np.bool_], ratio: float) -> Array:
    """Mutual matches of every pair."""
    out = np.zeros(apart.shape)
    for a, b in np.argwhere(np.tril(apart)):
        out[a, b] = out[b, a] = len(nearest_pairs(features[a], features[b], ratio))
    return out


def vector_ms(x: Floats) -> float:
    """Milliseconds of a query among many frames."""
    index, times = FrameIndex(x.shape[1]), -(-MANY // len(x))
    for n in range(times):
        index.add(np.zeros((len(x), 2), np.int64) + n, x)
    allowed = np.ones((len(x), times * len(x)), bool)
    started = time.process_time()
    index.search(x, allowed, 256)
    return 1000 * (time.process_time() - started) / len(x)


def votes_ms(queries: Sequence[Floats], keys: NDArray[np.int64]) -> float:
    """The same by votes; the frames repeat with noise."""
    index, rng = FeatureIndex(), np.random.default_rng(0)
    while len(index.keys) < MANY:
        index.add(keys, [(q + rng.normal(0, 0.05, q.shape)).astype(np.float32) for q in queries])
    asked = queries[:: max(1, len(queries) // 20)]
    allowed = np.ones((len(asked), len(index.keys)), bool)
    started = time.process_time()
    index.search(asked, allowed, 256)
    return 1000 * (time.process_time() - started) / len(asked)


if __name__ == "__main__":
    main()
