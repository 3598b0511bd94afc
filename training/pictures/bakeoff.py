"""The graph of pieces with and without what a network on pictures says, trained alike; and its votes alone.

python -m training.pictures.bakeoff --chunks DIR --network DIR --start DIR/fine --out DIR

The graphs' networks are trained on the worlds that the network on pictures was not (every second one).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import EXTRA_EDGES, EXTRA_NODES, CutSettings, make_parts
from list3r.instances.learned.graph import EDGE_FEATURES, NODE_FEATURES, ChunkSurface, chunk_surface
from list3r.instances.learned.network import judge
from list3r.instances.learned.pieces import Pieces
from list3r.instances.learned.weights import write_weights
from training.fit import FitSettings, fit, load_earlier, truths
from training.graphs import Lesson, _read, _write, first_lesson, lesson_of, surroundings_of
from training.model import PieceNetwork
from training.pictures.votes import EDGE_VOTES, NODE_VOTES, Said, read_network, say, with_votes
from training.samples import Sample, read_sample
from training.things import fit_things, overlaps
from training.train import named, things_found
from training.worlds.catalogue import LABELS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=Path, required=True)
    parser.add_argument("--network", type=Path, required=True, help="folder of a fit of part 0/2")
    parser.add_argument("--start", type=Path, required=True, help="folder of an earlier fit of fine pieces")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--every", type=int, default=2)
    parser.add_argument("--epochs", type=int, nargs=2, default=(3, 8))
    parser.add_argument("--variants", default="a,c", help="of a (the graph alone) and c (with votes)")
    words = parser.parse_args()
    torch.set_num_threads(1)
    paths = sorted(words.chunks.glob("train-*.npz"))[:: words.every]
    held = sorted(words.chunks.glob("test-*.npz"))
    network = read_network(words.network)
    voted = [voted_lesson(p, network, words.out) for p in paths]
    unseen = [voted_lesson(p, network, words.out) for p in held]
    _tell("b", alone(voted, unseen))
    for variant in words.variants.split(","):
        votes = variant == "c"
        out = words.out / variant
        fine = PieceNetwork(NODE_FEATURES + votes * NODE_VOTES, EDGE_FEATURES + votes * EDGE_VOTES, len(LABELS))
        _started(fine, words.start, voted if votes else [without(x) for x in voted], out / "start")
        settings = FitSettings(words.epochs[0], start=out / "start")
        shown = [x if votes else without(x) for x in (*voted, *unseen)]
        arrays = named("fine", fit(fine, shown[: len(voted)], shown[len(voted) :], out / "fine", settings))
        began = time.process_time()
        parts = [part_lesson(p, arrays, network, words.out, variant) for p in paths]
        seen = [part_lesson(p, arrays, network, words.out, variant) for p in held]
        _tell(variant, {"parts_cpu_s": round(time.process_time() - began, 1)})
        coarse = PieceNetwork(
            NODE_FEATURES + EXTRA_NODES + votes * NODE_VOTES,
            EDGE_FEATURES + EXTRA_EDGES + votes * EDGE_VOTES,
            len(LABELS),
            dropout=0.15,
        )
        settings = FitSettings(words.epochs[1], noise=0.15, decay=1e-2)
        arrays |= named("coarse", fit(coarse, parts, seen, out / "coarse", settings))
        for enough in (-1.0, 0.0, 1.0):
            _tell(variant, {"enough": enough, **things_found(arrays, seen, enough)})
        arrays |= fit_things(arrays, parts, seen)
        write_weights(out / "weights.npz", arrays)


def _tell(variant: str, entry: dict[str, Any]) -> None:
    print(json.dumps({"variant": variant, **entry}), flush=True)  # noqa: T201


def surface_of(sample: Sample) -> ChunkSurface:
    """Return the surface of a chunk on disk."""
    return chunk_surface(sample.cloud(), sample.views, surroundings_of(sample))


def said_of(path: Path, network: Any, surface: ChunkSurface, out: Path) -> Said:
    """Return what the network on pictures says of a chunk; kept on disk."""
    kept = out / "said" / f"{path.stem}.npz"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        s = say([network], surface)
        new = kept.with_suffix(".new.npz")
        np.savez(new, affinity=s.affinity.astype(np.float16), structure=s.structure, middle=s.middle)
        new.replace(kept)
    with np.load(kept) as data:
        return Said(data["affinity"].astype(np.float32), data["structure"], data["middle"])


def voted_lesson(path: Path, network: Any, out: Path) -> Lesson:
    """Return the lesson of the finest pieces with votes; kept on disk."""
    kept = out / "fine" / f"{path.stem}.lesson"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        lesson, labels = first_lesson(path)
        surface = surface_of(read_sample(path))
        graph = with_votes(surface, labels, lesson.graph, said_of(path, network, surface, out))
        _write(kept, replace(lesson, graph=graph), labels)
    return _read(kept)[0]


def without(lesson: Lesson) -> Lesson:
    """Return a lesson of fine pieces without votes."""
    g = lesson.graph
    return replace(lesson, graph=replace(g, nodes=g.nodes[:, :NODE_FEATURES], edges=g.edges[:, :EDGE_FEATURES]))


def part_lesson(path: Path, arrays: dict[str, NDArray[Any]], network: Any, out: Path, variant: str) -> Lesson:
    """Return the lesson of parts; kept on disk."""
    kept = out / variant / "parts" / f"{path.stem}.lesson"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        lesson, labels = _read(out / "fine" / f"{path.stem}.lesson")
        lesson = lesson if variant == "c" else without(lesson)
        sample = read_sample(path)
        surface = surface_of(sample)
        told = judge(arrays, "fine", lesson.graph)
        parts, graph = make_parts(surface, Pieces(labels, lesson.graph), told, CutSettings().sure)
        if variant == "c":
            graph = with_votes(surface, parts, graph, said_of(path, network, surface, out))
        _write(kept, lesson_of(sample, graph, parts, sample.truth_of(surface.cloud)), np.zeros(0, np.int32))
    return _read(kept)[0]


def _started(network: PieceNetwork, start: Path, lessons: Sequence[Lesson], out: Path) -> None:
    """Write the weights of an earlier fit with columns for votes that start at nothing."""
    if (out / "state.pt").exists():
        return
    out.mkdir(parents=True, exist_ok=True)
    old = PieceNetwork(NODE_FEATURES, EDGE_FEATURES, len(LABELS))
    (out / "labels.json").write_text(json.dumps(LABELS))
    load_earlier(old, start)
    own, earlier = network.state_dict(), old.state_dict()
    for kind in ("node", "edge"):
        values = np.concatenate([getattr(lesson.graph, f"{kind}s") for lesson in lessons])
        more = values.shape[1] - len(earlier[f"{kind}_mean"])
        tail = torch.from_numpy(values[:, values.shape[1] - more :])
        if more:
            earlier[f"{kind}_mean"] = torch.cat([earlier[f"{kind}_mean"], tail.mean(0)])
            earlier[f"{kind}_std"] = torch.cat([earlier[f"{kind}_std"], tail.std(0) + 1e-3])
            fresh = 0.2 * own[f"{kind}.0.weight"][:, -more:]
            earlier[f"{kind}.0.weight"] = torch.cat([earlier[f"{kind}.0.weight"], fresh], dim=1)
    network.load_state_dict(earlier)
    torch.save({"network": network.state_dict()}, out / "state.pt")


def alone(lessons: Sequence[Lesson], held: Sequence[Lesson]) -> dict[str, Any]:
    """Return what the votes alone find: a logistic regression of them is the affinity of fine pieces."""
    x = np.concatenate([lesson.graph.edges[:, -EDGE_VOTES:] for lesson in lessons])
    mean, std = x.mean(0), x.std(0) + 1e-3
    same, weight = (np.concatenate([truths(lesson)[k] for lesson in lessons]) for k in (0, 2))
    layer = torch.nn.Linear(EDGE_VOTES, 1)
    optimiser = torch.optim.LBFGS(layer.parameters(), max_iter=60)
    given, truth = torch.from_numpy((x - mean) / std), torch.from_numpy(same.astype(np.float32))
    w = torch.from_numpy(weight)

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        loss = torch.nn.functional.binary_cross_entropy_with_logits(layer(given)[:, 0], truth, w, reduction="sum")
        loss = loss / w.sum()
        loss.backward()
        return loss

    optimiser.step(closure)
    vector = (layer.weight.detach().numpy()[0] / std).astype(np.float32)
    shift = float(layer.bias.detach()) - float(mean @ vector)
    out: dict[str, Any] = {"vector": vector.round(4).tolist(), "shift": round(shift, 4)}
    for tag, rows in (("train", lessons[::5]), ("held", held)):
        for enough in (-1.0, 0.0, 1.0, 2.0):
            out[f"{tag} {enough:g}"] = _found_alone(rows, vector, shift, enough)
    return out


def _found_alone(lessons: Sequence[Lesson], vector: NDArray[np.float32], shift: float, enough: float) -> list[float]:
    """Recall and precision of things by voxels at 0.25 and 0.5, as `training.train.things_found`."""
    counts = np.zeros(4)
    for lesson in lessons:
        g = lesson.graph
        own = agglomerate(len(g.nodes), g.left, g.right, g.edges[:, -EDGE_VOTES:] @ vector + shift, g.weight, enough)
        size = np.bincount(own, lesson.size)
        iou, which, bound = overlaps(lesson, own)
        listed = (size >= 40) & ~bound
        true = {
            t
            for t in np.unique(lesson.thing[(lesson.thing > 0) & ~lesson.structure]).tolist()
            if lesson.size[lesson.thing == t].sum() >= 60
        }
        counts += [
            len(true),
            listed.sum(),
            *(len(true & set(which[listed & (iou >= v)].tolist())) for v in (0.25, 0.5)),
        ]
    t, n, a, b = np.maximum(counts, 1e-6)
    return [round(float(v), 3) for v in (a / t, a / n, b / t, b / n)]


if __name__ == "__main__":
    main()
