"""Make data and weights of the learned discoverer from seeds.

python -m training.train --out DIR --worlds 470 --fitted 235 --odd 400 --held 12

Every step is kept in the folder and not done again: chunks, graphs, the state of each network after each epoch.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from list3r.instances.learned.cut import EXTRA_EDGES, EXTRA_NODES, CutSettings
from list3r.instances.learned.graph import EDGE_FEATURES, NODE_FEATURES
from list3r.instances.learned.weights import FORMAT
from training.fit import ABLATIONS, SEEING, WIDTH, Blindness, FitSettings, fit
from training.graphs import Lesson, first_lesson, second_lessons
from training.model import PieceNetwork
from training.samples import make_sample
from training.things import clusters, fit_things, overlaps
from training.worlds.catalogue import LABELS

FIRST_SEED, FIRST_FITTED_SEED, FIRST_ODD_SEED = 1000, 2000, 3000
"""Seeds count up from here: worlds for training, those with what is built in, those with what no catalogue knows."""
FIRST_HELD_SEED, FIRST_FITTED_HELD_SEED = 5000, 5500
"""Likewise left-out worlds, and those with what is built in."""
ODD_SHARE = 0.5
"""Share of things that no catalogue knows in rooms that have such things; every third of them is fitted, too."""

EDGE_WIDTH = 32
"""Width of the first network's states of borders; see `WIDTH`."""
AVERAGE = 0.999
"""What of the mean of its weights a network keeps in each step."""
SECOND_WIDTH, SECOND_EDGE_WIDTH, SECOND_DEPTH = 64, 48, 4
"""Likewise of the second one, which sees far smaller graphs, and its rounds of messages."""
FIRST_ENDS = ((2.0,), (3.5,))
"""Where agglomeration stops for the second network's first lessons."""
STATES = ((3.5, 3.5), (3.5, 3.5, 2.5), (3.5, 3.5, 2.5, 1.5))
"""What agglomeration then passes through, by the second network of the first lessons, see `CutSettings.steps`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of chunks, graphs, states and logs")
    parser.add_argument("--worlds", type=int, default=470, help="rooms with loose furniture")
    parser.add_argument("--fitted", type=int, default=235, help="rooms with what is built in")
    parser.add_argument("--odd", type=int, default=400, help="rooms with things that no catalogue knows")
    parser.add_argument("--held", type=int, default=12, help="left-out worlds of each kind, to calibrate on")
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--start", type=Path, help="folder of an earlier run whose first network is trained on")
    parser.add_argument("--without", choices=sorted(ABLATIONS), help="an ablation: what the networks do not see")
    parser.add_argument("--weights", type=Path, help="where the weights go; out/weights.npz without it")
    args = parser.parse_args()
    torch.set_num_threads(1)
    data = args.out / "chunks"
    paths = [make_sample(FIRST_SEED + k, data) for k in range(args.worlds)]
    paths += [make_sample(FIRST_FITTED_SEED + k, data, fitted=True) for k in range(args.fitted)]
    paths += [make_sample(FIRST_ODD_SEED + k, data, fitted=k % 3 == 2, odd=ODD_SHARE) for k in range(args.odd)]
    held = [make_sample(FIRST_HELD_SEED + k, data, held_out=True) for k in range(args.held)]
    held += [make_sample(FIRST_FITTED_HELD_SEED + k, data, held_out=True, fitted=True) for k in range(args.held)]
    train(paths, held, args.out, args.epochs, args.weights or args.out / "weights.npz", args.start, args.without)


def train(
    paths: Sequence[Path],
    held: Sequence[Path],
    out: Path,
    epochs: int,
    weights: Path,
    start: Path | None = None,
    without: str | None = None,
) -> None:
    """Train both networks and the classifier of things on chunks, and write the weights.

    Every room is learned from as it is and in few colours.
    """
    rooms, left_out = ([(p, few) for p in of for few in (False, True)] for of in (paths, held))
    lessons, seen = ([first_lesson(p, few=few)[0] for p, few in of] for of in (rooms, left_out))
    blind = ABLATIONS[without] if without else SEEING
    depth = 3 if blind.messages else 0
    fine = PieceNetwork(NODE_FEATURES, EDGE_FEATURES, len(LABELS), node=WIDTH, edge=EDGE_WIDTH, depth=depth)
    settings = FitSettings(
        epochs, start=start and start / "fine", blind=blind, blink=0.1, average=AVERAGE, least_weight=1.0
    )
    arrays = named("fine", fit(fine, lessons, seen, out / "fine", settings))
    every = [second_lessons(p, arrays, out / "parts", FIRST_ENDS, few=few) for p, few in rooms]
    unseen = [second_lessons(p, arrays, out / "parts", FIRST_ENDS[:1], few=few)[0] for p, few in left_out]
    settings = replace(settings, epochs=max(1, epochs // 2), start=None, noise=0.15, decay=1e-2, blink=0.15)
    first = [lesson for rows in every for lesson in rows]
    arrays |= named("coarse", fit(second_network(blind), first, unseen, out / "coarse", settings))
    for k, (p, few) in enumerate(rooms):
        every[k] += second_lessons(p, arrays, out / "parts", STATES, few=few)
    unseen = [second_lessons(p, arrays, out / "parts", STATES, few=few)[-1] for p, few in left_out]
    settings = replace(settings, epochs=max(1, epochs - 2))
    network = fit(
        second_network(blind), [lesson for rows in every for lesson in rows], unseen, out / "states", settings
    )
    arrays |= named("coarse", network)
    arrays |= fit_things(arrays, [rows[k] for rows in every for k in (0, -2, -1)], unseen, blind=blind)
    FORMAT.write(weights, arrays)
    print(json.dumps({"weights": weights.name, "bytes": weights.stat().st_size, "held": things_found(arrays, unseen)}))  # noqa: T201


def second_network(blind: Blindness) -> PieceNetwork:
    """Return the second network, untrained."""
    nodes, edges = NODE_FEATURES + WIDTH + EXTRA_NODES, EDGE_FEATURES + EXTRA_EDGES
    depth = SECOND_DEPTH if blind.messages else 0
    widths = {"node": SECOND_WIDTH, "edge": SECOND_EDGE_WIDTH, "depth": depth}
    return PieceNetwork(nodes, edges, len(LABELS), **widths, dropout=0.15)


def named(prefix: str, network: PieceNetwork) -> dict[str, NDArray[Any]]:
    """Return the arrays of a network by the names that inference asks for."""
    return {f"{prefix}.{k}": v.detach().numpy() for k, v in network.state_dict().items()}


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


if __name__ == "__main__":
    main()
