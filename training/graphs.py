"""Graphs of pieces with what is true of them: what the networks learn from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import group
from list3r.instances.learned.graph import PieceGraph, Surroundings, chunk_surface
from list3r.instances.learned.network import classify
from list3r.instances.learned.pieces import Pieces, cut_pieces
from list3r.instances.settings import SegmentSettings
from training.colours import in_few_colours
from training.samples import Sample, read_sample
from training.worlds.catalogue import LABELS

Ends = tuple[float, ...]
LEAST_PURE = 0.6
"""Pieces of which no thing has this share teach nothing."""


@dataclass(frozen=True)
class Lesson:
    """A graph and its truth."""

    seed: int
    graph: PieceGraph
    thing: NDArray[np.int64]
    """True thing of each piece, 0 for none, -1 where it is mixed. Shape (P,)."""
    structure: NDArray[np.bool_]
    """Pieces of what bounds the room. Shape (P,)."""
    name: NDArray[np.int64]
    """Row of `LABELS` of each piece, -1 for none. Shape (P,)."""
    size: NDArray[np.float32]
    """Voxels of each piece. Shape (P,)."""


def surroundings_of(sample: Sample) -> Surroundings:
    """Return up (the true one, tilted by up to a few degrees), scale and the height of the cameras."""
    rng = np.random.default_rng([sample.seed, 13])
    up = sample.up + rng.normal(0, 0.015, 3)
    up /= np.linalg.norm(up)
    return Surroundings(up, 1.0, float(np.median(sample.T_chunk_cam[:, :3, 3] @ up)), sample.computed)


def lesson_of(sample: Sample, graph: PieceGraph, labels: NDArray[np.int32], truth: NDArray[np.int32]) -> Lesson:
    """Return a graph with the truth of its pieces; `labels` and `truth` have shape (N,)."""
    count = len(graph.nodes)
    known = labels >= 0
    codes, votes = np.unique(labels[known].astype(np.int64) << 16 | truth[known], return_counts=True)
    size = np.bincount(labels[known], minlength=count)
    order = np.lexsort((votes, codes >> 16))
    thing, most = np.zeros(count, np.int64), np.zeros(count)
    thing[codes[order] >> 16], most[codes[order] >> 16] = codes[order] & 0xFFFF, votes[order]
    thing[most < LEAST_PURE * size] = -1
    truth_of = {t.id: t for t in sample.things}
    structure = np.array([i > 0 and truth_of[i].structure for i in thing.tolist()], bool)
    row = {label: k for k, label in enumerate(LABELS)}
    name = [row.get(truth_of[i].label, -1) if i > 0 and not truth_of[i].structure else -1 for i in thing.tolist()]
    return Lesson(sample.seed, graph, thing, structure, np.array(name, np.int64), size.astype(np.float32))


def sample_and_cloud(path: Path, *, few: bool = False) -> tuple[Sample, Cloud]:
    """Return a sample on disk, in few colours if so asked, and its cloud on the voxels that discovery has for it."""
    sample = read_sample(path)
    if few:
        sample = in_few_colours(sample)
    return sample, sample.cloud(SegmentSettings().grain_m(sensed=not sample.computed))


def first_lesson(path: Path, *, few: bool = False) -> tuple[Lesson, NDArray[np.int32]]:
    """Return the graph of the finest pieces of a sample on disk with its truth, and the piece of each voxel.

    With `few` the room is `in_few_colours`. It is kept beside the sample.
    """
    kept = path.with_suffix(f".{_kind(few)}.graph")
    if not kept.exists():
        sample, cloud = sample_and_cloud(path, few=few)
        pieces = cut_pieces(chunk_surface(cloud, sample.views, surroundings_of(sample)))
        lesson = lesson_of(sample, pieces.graph, pieces.labels, sample.truth_of(cloud))
        _write(kept, lesson, pieces.labels)
    return _read(kept)


def second_lessons(
    path: Path, arrays: Mapping[str, NDArray[Any]], folder: Path, ends: Sequence[Ends], *, few: bool = False
) -> list[Lesson]:
    """Return the graphs of the parts that the networks make of a sample on disk, with their truth; kept in `folder`.

    One for each of `ends`: mean log odds down to which pieces are joined by the first network, and, one step after the
    other, parts by the second. So the second network learns from what it will see.
    """
    files = [folder / f"{path.stem}-{_kind(few)}-{'-'.join(f'{e:g}' for e in end)}.parts" for end in ends]
    if not all(f.exists() for f in files):
        folder.mkdir(parents=True, exist_ok=True)
        lesson, labels = first_lesson(path, few=few)
        sample, cloud = sample_and_cloud(path, few=few)
        truth = sample.truth_of(cloud)
        pieces, g = Pieces(labels, lesson.graph), lesson.graph
        surface = chunk_surface(cloud, sample.views, surroundings_of(sample))
        told = classify(arrays, "fine", g)
        made: dict[Ends, tuple[NDArray[np.int64], NDArray[np.int32], PieceGraph]] = {}
        for end, file in zip(ends, files, strict=True):
            for k in range(1, len(end) + 1):
                if end[:k] in made:
                    continue
                if k == 1:
                    own = agglomerate(len(g.nodes), g.left, g.right, told.affinity, g.weight, end[0])
                else:
                    before, _, h = made[end[: k - 1]]
                    said = classify(arrays, "coarse", h).affinity
                    own = agglomerate(len(h.nodes), h.left, h.right, said, h.weight, end[k - 1])[before]
                made[end[:k]] = (own, *group(surface, pieces, told, own))
            _, parts, graph = made[end]
            _write(file, lesson_of(sample, graph, parts, truth), np.zeros(0, np.int32))
    return [_read(f)[0] for f in files]


def _kind(few: bool) -> str:
    """Part of the names of kept graphs; those of 1 cm, which had none, are not read any more."""
    return "few" if few else "plain"


def _write(path: Path, lesson: Lesson, labels: NDArray[np.int32]) -> None:
    new = path.with_suffix(".new.npz")
    g = lesson.graph
    np.savez(
        new,
        seed=lesson.seed,
        nodes=g.nodes,
        left=g.left,
        right=g.right,
        edges=g.edges,
        weight=g.weight,
        moments=g.moments,
        thing=lesson.thing,
        structure=lesson.structure,
        name=np.array([LABELS[k] if k >= 0 else "" for k in lesson.name.tolist()], str),
        size=lesson.size,
        labels=labels,
    )
    new.replace(path)


def _read(path: Path) -> tuple[Lesson, NDArray[np.int32]]:
    with np.load(path) as data:
        a = {name: data[name] for name in data.files}
    graph = PieceGraph(a["nodes"], a["left"], a["right"], a["edges"], a["weight"], a["moments"])
    row = {label: k for k, label in enumerate(LABELS)}
    name = np.array([row.get(label, -1) for label in a["name"].tolist()], np.int64)
    return Lesson(int(a["seed"]), graph, a["thing"], a["structure"], name, a["size"]), a["labels"]
