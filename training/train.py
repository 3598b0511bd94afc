"""Make data and weights of the learned discoverer from seeds.

python -m training.train --out DIR --worlds 200 --held 12

Every step is kept in the folder and not done again: chunks, graphs, the state of each network after each epoch.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import EXTRA_EDGES, EXTRA_NODES, CutSettings, summarise
from list3r.instances.learned.graph import EDGE_FEATURES, NODE_FEATURES
from list3r.instances.learned.network import judge
from list3r.instances.learned.weights import write_weights
from training.fit import FitSettings, fit
from training.graphs import Lesson, first_lesson, second_lessons
from training.model import PieceNetwork
from training.samples import make_sample
from training.worlds.catalogue import LABELS

FIRST_SEED, FIRST_HELD_SEED = 1000, 5000
"""Seeds of worlds for training count up from the first, those of left-out worlds for the log from the second."""

OTHER_THRESHOLDS = (0.5, 3.5)
"""Where agglomeration of fine pieces stops besides, so that the second network sees parts of other sizes too."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of chunks, graphs, states and logs")
    parser.add_argument("--worlds", type=int, default=200)
    parser.add_argument("--held", type=int, default=12, help="left-out worlds that the log is told of")
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--weights", type=Path, help="where the weights go; out/weights.npz without it")
    words = parser.parse_args()
    torch.set_num_threads(1)
    data = words.out / "chunks"
    paths = [make_sample(FIRST_SEED + k, data) for k in range(words.worlds)]
    held = [make_sample(FIRST_HELD_SEED + k, data, held_out=True) for k in range(words.held)]
    train(paths, held, words.out, words.epochs, words.weights or words.out / "weights.npz")


def train(paths: Sequence[Path], held: Sequence[Path], out: Path, epochs: int, weights: Path) -> None:
    """Train both networks and the confidence on chunks, and write the weights."""
    lessons, seen = [first_lesson(p)[0] for p in paths], [first_lesson(p)[0] for p in held]
    fine = fit(
        PieceNetwork(NODE_FEATURES, EDGE_FEATURES, len(LABELS)), lessons, seen, out / "fine", FitSettings(epochs)
    )
    arrays = named("fine", fine)
    usual = CutSettings().sure
    more = [second_lessons(p, arrays, out / "parts", (usual, *OTHER_THRESHOLDS)) for p in paths]
    unseen = [second_lessons(p, arrays, out / "parts", (usual,))[0] for p in held]
    shape = (NODE_FEATURES + EXTRA_NODES, EDGE_FEATURES + EXTRA_EDGES)
    every = [lesson for several in more for lesson in several]
    settings = FitSettings(epochs, noise=0.15, decay=1e-2)
    coarse = fit(PieceNetwork(*shape, len(LABELS), dropout=0.15), every, unseen, out / "coarse", settings)
    arrays |= named("coarse", coarse)
    arrays |= fit_confidence(arrays, [several[0] for several in more])
    write_weights(weights, arrays)
    print(json.dumps({"weights": weights.name, "bytes": weights.stat().st_size, "held": things_found(arrays, unseen)}))  # noqa: T201


def named(prefix: str, network: PieceNetwork) -> dict[str, NDArray[Any]]:
    """Return the arrays of a network by the names that inference asks for."""
    return {f"{prefix}.{k}": v.detach().numpy() for k, v in network.state_dict().items()}


def clusters(arrays: dict[str, NDArray[Any]], lesson: Lesson, enough: float) -> tuple[NDArray[np.int64], Any]:
    """Return the thing of each part of a graph (P,), and what the second network said."""
    told = judge(arrays, "coarse", lesson.graph)
    g = lesson.graph
    return agglomerate(len(g.nodes), g.left, g.right, told.affinity, g.weight, enough), told


def overlaps(
    lesson: Lesson, own: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return each cluster's IoU by voxels with the thing it fits best, that thing, and which clusters are structure."""
    known = lesson.thing > 0
    count = int(own.max(initial=-1)) + 1
    size = np.bincount(own, lesson.size, minlength=count)
    whole = np.bincount(lesson.thing[known], lesson.size[known])
    codes, at = np.unique(own[known] << 16 | lesson.thing[known], return_inverse=True)
    shared = np.bincount(at, lesson.size[known])
    cluster, thing = codes >> 16, codes & 0xFFFF
    iou = shared / (size[cluster] + whole[thing] - shared)
    best, which = np.zeros(count), np.zeros(count, np.int64)
    order = np.argsort(iou, kind="stable")
    best[cluster[order]], which[cluster[order]] = iou[order], thing[order]
    bound = np.bincount(own, lesson.size * lesson.structure, minlength=count) > 0.5 * size
    return best, which, bound


def things_found(
    arrays: dict[str, NDArray[Any]], lessons: Sequence[Lesson], enough: float = CutSettings().enough
) -> dict[str, float]:
    """Return recall and precision of things by voxels at IoU 0.25 and 0.5, of clusters of at least 40 voxels."""
    counts = np.zeros(5)
    for lesson in lessons:
        own, _ = clusters(arrays, lesson, enough)
        iou, which, bound = overlaps(lesson, own)
        size = np.bincount(own, lesson.size)
        listed = (size >= 40) & ~bound
        true = {
            t
            for t in np.unique(lesson.thing[(lesson.thing > 0) & ~lesson.structure]).tolist()
            if lesson.size[lesson.thing == t].sum() >= 60
        }
        hit = [len(true & set(which[listed & (iou >= limit)].tolist())) for limit in (0.25, 0.5)]
        counts += [len(true), listed.sum(), *hit, 0]
    true_, listed_, a, b, _ = np.maximum(counts, 1e-6)
    values = {
        "recall_0.25": a / true_,
        "precision_0.25": a / listed_,
        "recall_0.5": b / true_,
        "precision_0.5": b / listed_,
    }
    return {k: round(float(v), 3) for k, v in values.items()}


def fit_confidence(arrays: dict[str, NDArray[Any]], lessons: Sequence[Lesson]) -> dict[str, NDArray[np.float32]]:
    """Return the logistic regression that tells whether a cluster is one whole thing (IoU of 0.5 by voxels)."""
    rows, right = [], []
    for lesson in lessons:
        own, told = clusters(arrays, lesson, CutSettings().enough)
        iou, _, bound = overlaps(lesson, own)
        cut = summarise(np.zeros(0, np.int32), own, lesson.size, lesson.graph, told)
        rows.append(cut.features[~bound])
        right.append(iou[~bound] > 0.5)
    x, y = np.concatenate(rows), np.concatenate(right).astype(np.float64)
    mean, std = x.mean(axis=0), x.std(axis=0) + 1e-3
    x = (x - mean) / std
    full = np.concatenate([x, x**2, np.ones((len(x), 1))], axis=1)
    weight = np.zeros(full.shape[1])
    for _ in range(30):
        p = 1 / (1 + np.exp(-np.clip(full @ weight, -20, 20)))
        hessian = full.T @ (full * (p * (1 - p))[:, None]) + 1.0 * np.eye(len(weight))
        weight += np.linalg.solve(hessian, full.T @ (y - p) - weight)
    names = {"mean": mean, "std": std, "weight": weight}
    return {f"confidence.{k}": v.astype(np.float32) for k, v in names.items()}


if __name__ == "__main__":
    main()
