"""Losses of the learned discoverer against true masks: an oracle ladder with a rung for each step.

PYTHONPATH=. python benchmarks/discovery_ladder.py --seeds 5001,5004,5008 --json FILE

Each rung takes one more step from the discoverer and the rest from the truth; figures are those of `discovery.py`:
`true` true masks, `voxels` the true object of most pixels of each voxel, `superpoints`, `pieces`, `parts` the true
object of most of their voxels, `joined` likewise of the joined parts, `tree` the best fitting clusters of the
agglomeration's dendrogram, `cut` the clusters where it stops that fit a true object, `bound` likewise without those
classified as structure, `unlisted` all of these, `listed` those above the confidence threshold: the discoverer's
proposals. Tracking and merging are measured by `discovery_memory.py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from discovery import TrueDiscoverer, figures, film_of, seeds_of, summary
from machine import machine, write_json
from numpy.typing import NDArray

from list3r.instances.base import Proposals
from list3r.instances.geometric.cloud import Cloud, build_cloud
from list3r.instances.geometric.cuts import Segment, Segmentation, proposals_of
from list3r.instances.geometric.planes import estimate_up, find_planes
from list3r.instances.geometric.views import ChunkViews, chunk_views, forget_views
from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import CutSettings, join_parts, spread_labels
from list3r.instances.learned.discovery import LearnedDiscoverer
from list3r.instances.learned.graph import ChunkSurface, Surroundings, chunk_surface
from list3r.instances.learned.network import classify
from list3r.instances.learned.pieces import cut_pieces
from list3r.instances.learned.superpoints import cut_superpoints
from list3r.instances.learned.verdicts import classify_segments
from list3r.instances.learned.weights import load_weights
from list3r.instances.library import select_prompts
from training.samples import chunk_settings, voxel_truth
from training.worlds.film import Film, frames_of, reconstruction_of

ENDS = np.arange(-4.0, 5.01, 0.5)
"""Log odds at which the dendrogram is sampled."""
FITS = 0.25
"""IoU by voxels from which a cluster fits a true object."""

SHOWN = (
    *(f"{kind}{what}_{iou}" for kind in ("", "mask_") for iou in ("0.25", "0.5") for what in ("recall", "precision")),
    "duplicates_per_thing",
    "merged_pairs_per_thing",
)

Labels = NDArray[np.int32]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="5001,5004,5008")
    parser.add_argument("--fitted", action="store_true")
    parser.add_argument("--house", type=Path)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for seed in seeds_of(args.seeds):
        film, every = film_of(seed, None, args.house, fitted=args.fitted)
        for rung, said in climb(film, every, seed, args.weights).items():
            rows.append({"rung": rung, "seed": seed, **said, "cpu_s": 0.0, "frames": 1})
    table = {r: summary([row for row in rows if row["rung"] == r]) for r in dict.fromkeys(row["rung"] for row in rows)}
    print(machine())
    for rung, entry in table.items():
        print(f"{rung:12}", *(f"{entry[k]:6.3f}" for k in SHOWN))
    source = "house" if args.house else "fitted worlds" if args.fitted else "worlds"
    write_json(args.json, {"source": source, "mean": table, "walks": rows})


@dataclass(frozen=True)
class Chunk:
    """A chunk on the ladder."""

    film: Film
    views: ChunkViews
    surface: ChunkSurface
    truth: NDArray[np.int32]
    """True object of each voxel, 0 for none. Shape (N,)."""
    bound: frozenset[int]
    """True objects that are structure."""

    @property
    def cloud(self) -> Cloud:
        return self.surface.cloud


def climb(film: Film, every: int, seed: int, weights: Path | None) -> dict[str, dict[str, Any]]:
    """The figures of every rung on one walk."""
    settings, frames = chunk_settings(every), frames_of(film)
    reconstruction = reconstruction_of(film, seed=seed)
    views = chunk_views(frames, reconstruction, settings)
    shown = [views.view(p) for p in views.anchors]
    computed = reconstruction.depth_noise is not None
    cloud = build_cloud(shown, settings.segment.grain_m(sensed=not computed) * views.unit)
    poses = reconstruction.T_chunk_cam
    up = estimate_up(find_planes(cloud, 0.25 * views.unit**2, views.unit), poses)
    around = Surroundings(up, views.unit, float(np.median(poses[:, :3, 3] @ up)), computed)
    ids = tuple(film.ids[p][:: views.stride, :: views.stride].astype(np.int32) for p in views.anchors)
    bound = frozenset(t.id for t in film.things if t.structure)
    chunk = Chunk(film, views, chunk_surface(cloud, shown, around), voxel_truth(cloud, ids), bound)
    discoverer = LearnedDiscoverer(settings, weights)
    out: dict[str, dict[str, Any]] = {}

    def scores(cut: Callable[[int], Proposals]) -> dict[str, Any]:
        return figures(film, views, [select_prompts(cut(p), settings) for p in views.anchors])

    true = TrueDiscoverer(film)
    out["true"] = scores(lambda p: true(frames, reconstruction, p))
    for name, (labels, flat) in rungs(chunk, weights).items():
        out[name] = scores(lambda p, labels=labels, flat=flat: proposed(discoverer, chunk, labels, flat, p))
    out["listed"] = scores(lambda p: discoverer(frames, reconstruction, p))
    forget_views()
    return out


def proposed(discoverer: LearnedDiscoverer, chunk: Chunk, labels: Labels, flat: NDArray[np.bool_], p: int) -> Proposals:
    """Clusters as masks on an anchor; `flat` are structure."""
    segments = tuple(Segment(None, bool(f), 1.0) for f in flat)
    cut = Segmentation(np.asarray(labels + 1, np.int32), segments, chunk.surface.around.up)
    image = discoverer._label_view(chunk.views, p, chunk.cloud, cut)
    camera = chunk.views.reconstruction.camera
    features = np.ones((len(flat), 1), np.float32)
    view = chunk.views.view(p)
    return proposals_of(view, image, cut, features, stride=chunk.views.stride, shape=(camera.height, camera.width))


def rungs(chunk: Chunk, file: Path | None) -> dict[str, tuple[Labels, NDArray[np.bool_]]]:
    """Cluster of each voxel (N,), -1 for none, and which clusters are structure, of each rung."""
    weights, surface, s = load_weights(file, sensed=not chunk.surface.around.computed), chunk.surface, CutSettings()
    out = {"voxels": named(chunk, np.where(chunk.truth > 0, chunk.truth, -1))}
    out["superpoints"] = named(chunk, majority(chunk, cut_superpoints(surface).labels))
    pieces = cut_pieces(surface)
    out["pieces"] = named(chunk, majority(chunk, pieces.labels))
    g = pieces.graph
    first = agglomerate(len(g.nodes), g.left, g.right, classify(weights, "fine", g).affinity, g.weight, s.sure)
    out["parts"] = named(chunk, majority(chunk, pieces.joined(first)))
    parts, coarse, scores = join_parts(surface, pieces, weights, s)
    out["joined"] = named(chunk, majority(chunk, parts))
    at = lambda end: agglomerate(len(coarse.nodes), coarse.left, coarse.right, scores.affinity, coarse.weight, end)  # noqa: E731
    out["tree"] = best_of(chunk, [parts, *(np.append(at(e), -1)[parts] for e in ENDS)])
    own = at(s.enough)
    labels = np.asarray(np.append(own, -1)[parts], np.int32)
    labels = spread_labels(surface.cloud.points, labels, s.hop_m * surface.around.unit)
    out["cut"] = best_of(chunk, [labels])
    verdicts = classify_segments(weights, own, coarse, scores)
    free = verdicts.structure <= 0.5
    out["bound"] = best_of(chunk, [np.where(np.append(free, False)[labels], labels, -1)])
    out["unlisted"] = labels, ~free
    return out


def named(chunk: Chunk, ids: NDArray[np.int32]) -> tuple[Labels, NDArray[np.bool_]]:
    """Clusters numbered from 0, from true ids (-1 for none)."""
    values, number = np.unique(ids, return_inverse=True)
    shift = int(values[0] == -1)
    return np.asarray(number - shift, np.int32), np.isin(values[shift:], list(chunk.bound))


def majority(chunk: Chunk, labels: Labels) -> NDArray[np.int32]:
    """The true object of most voxels of each voxel's cluster, -1 where most are of none. Shape (N,)."""
    known = labels >= 0
    codes, votes = np.unique(labels[known].astype(np.int64) << 16 | chunk.truth[known], return_counts=True)
    order = np.lexsort((votes, codes >> 16))
    obj = np.full(int(labels.max(initial=-1)) + 2, -1, np.int32)
    obj[codes[order] >> 16] = codes[order] & 0xFFFF
    obj[obj == 0] = -1
    obj[-1] = -1
    return obj[labels]


def best_of(chunk: Chunk, groupings: list[NDArray[np.int32]]) -> tuple[Labels, NDArray[np.bool_]]:
    """The clusters of nested groupings that fit true objects best, none in another, best first."""
    size = np.bincount(chunk.truth)
    found: list[tuple[float, int, int, int]] = []
    for level, labels in enumerate(groupings):
        known = labels >= 0
        count = np.bincount(labels[known])
        codes, shared = np.unique(labels[known].astype(np.int64) << 16 | chunk.truth[known], return_counts=True)
        cluster, obj = codes >> 16, codes & 0xFFFF
        iou = shared / (count[cluster] + size[obj] - shared)
        rows = (obj > 0) & (iou >= FITS)
        fits = (iou[rows].tolist(), cluster[rows].tolist(), obj[rows].tolist())
        found += [(share, level, k, t) for share, k, t in zip(*fits, strict=True)]
    ids, done = np.full(len(chunk.truth), -1, np.int32), set()
    for _, level, cluster, obj in sorted(found, key=lambda e: (-e[0], e[1], e[2])):
        mine = groupings[level] == cluster
        if obj not in done and (ids[mine] < 0).all():
            ids[mine] = obj
            done.add(obj)
    return named(chunk, ids)


if __name__ == "__main__":
    main()
