"""Train weights further: those for sensors on rooms whose windows, doors and niches lie behind the face of their walls.

python -m training.further --out DIR --start list3r/instances/learned/weights.npz

More than half of the rooms are those of `training.train`, and what is written is the mean of the networks before and
after, so that nothing is forgotten. Every step is kept in the folder and not done again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from list3r.instances.learned.graph import EDGE_FEATURES, NODE_FEATURES
from list3r.instances.learned.weights import FORMAT, load_weights
from training.fit import SEEING, WIDTH, FitSettings, fit
from training.graphs import first_lesson, second_lessons
from training.model import PieceNetwork
from training.samples import make_sample
from training.things import fit_things
from training.train import (
    AVERAGE,
    EDGE_WIDTH,
    FIRST_ENDS,
    FIRST_FITTED_HELD_SEED,
    FIRST_FITTED_SEED,
    FIRST_HELD_SEED,
    FIRST_ODD_SEED,
    FIRST_SEED,
    ODD_SHARE,
    STATES,
    named,
    second_network,
    things_found,
)
from training.worlds.catalogue import LABELS

RECESSED_SEED, RECESSED_FITTED_SEED, RECESSED_ODD_SEED = 4000, 4300, 4600
"""Seeds of recessed rooms count up from here, as those of `training.train` do from others."""
RECESSED_HELD_SEED = 5900
"""Likewise left-out ones, of which every second one has what is built in."""
ENDS = (FIRST_ENDS[1], STATES[1], STATES[2])
"""What agglomeration passes through in the second network's lessons."""

Arrays = Mapping[str, NDArray[Any]]
Made = TypeVar("Made")
Rooms = list[tuple[Path, bool]]
"""Chunks, and whether each is learned from in few colours."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of chunks, graphs, states and logs")
    parser.add_argument("--start", type=Path, required=True, help="weights to go on from")
    parser.add_argument("--known", default="90,45,65", help="rooms of training.train: loose furniture, built in, odd")
    parser.add_argument("--recessed", default="60,40,60", help="rooms with recesses, likewise")
    parser.add_argument("--held", type=int, default=12, help="left-out worlds of each kind, to calibrate on")
    parser.add_argument("--epochs", type=int, default=4, help="of the first network; the second has one less")
    parser.add_argument("--kept", type=float, default=0.5, help="share of the networks as they were in that mean")
    parser.add_argument("--weights", type=Path, help="where the weights go; out/weights.npz without it")
    args = parser.parse_args()
    torch.set_num_threads(1)
    data = args.out / "chunks"
    seeds = FIRST_SEED, FIRST_FITTED_SEED, FIRST_ODD_SEED
    paths = rooms_of(make_sample, data, seeds, args.known, recessed=False)
    seeds = RECESSED_SEED, RECESSED_FITTED_SEED, RECESSED_ODD_SEED
    paths += rooms_of(make_sample, data, seeds, args.recessed, recessed=True)
    held = [make_sample(FIRST_HELD_SEED + k, data, held_out=True) for k in range(args.held)]
    held += [make_sample(FIRST_FITTED_HELD_SEED + k, data, held_out=True, fitted=True) for k in range(args.held)]
    for k in range(args.held):
        held.append(make_sample(RECESSED_HELD_SEED + k, data, held_out=True, fitted=k % 2 == 1, recessed=True))
    rooms, left_out = ([(p, few) for p in of for few in (False, True)] for of in (paths, held))
    weights = args.weights or args.out / "weights.npz"
    train_further(rooms, left_out, args.out, args.epochs, weights, args.start)
    FORMAT.write(weights, mean_of(load_weights(args.start), load_weights(weights), args.kept))


def rooms_of(
    make: Callable[..., Made], folder: Path, seeds: tuple[int, int, int], counts: str, *, recessed: bool
) -> list[Made]:
    """Make rooms with loose furniture, with what is built in, and with what no catalogue knows, so many of each."""
    loose, fitted, odd = map(int, counts.split(","))
    kinds = [(seeds[0] + k, False, 0.0) for k in range(loose)]
    kinds += [(seeds[1] + k, True, 0.0) for k in range(fitted)]
    kinds += [(seeds[2] + k, k % 3 == 2, ODD_SHARE) for k in range(odd)]
    return [make(seed, folder, fitted=built_in, odd=share, recessed=recessed) for seed, built_in, share in kinds]


def train_further(rooms: Rooms, held: Rooms, out: Path, epochs: int, weights: Path, start: Path) -> None:
    """Train both networks further and the judge of things anew, and write the weights."""
    arrays = {n: np.array(v) for n, v in load_weights(start).items()}
    for part in ("fine", "coarse"):
        _write_state(arrays, part, out / "start" / part)
    lessons, seen = ([first_lesson(p, few=few)[0] for p, few in of] for of in (rooms, held))
    fine = PieceNetwork(NODE_FEATURES, EDGE_FEATURES, len(LABELS), node=WIDTH, edge=EDGE_WIDTH, depth=3)
    settings = FitSettings(epochs, start=out / "start" / "fine", blink=0.1, average=AVERAGE, least_weight=1.0)
    arrays |= named("fine", fit(fine, lessons, seen, out / "fine", settings))
    every, unseen = ([second_lessons(p, arrays, out / "parts", ENDS, few=few) for p, few in of] for of in (rooms, held))
    last = [rows[-1] for rows in unseen]
    settings = replace(
        settings, epochs=max(1, epochs - 1), start=out / "start" / "coarse", noise=0.15, decay=1e-2, blink=0.15
    )
    second = fit(second_network(SEEING), [x for rows in every for x in rows], last, out / "coarse", settings)
    arrays |= named("coarse", second)
    arrays |= fit_things(arrays, [x for rows in every for x in rows], last)
    FORMAT.write(weights, arrays)
    print(json.dumps({"weights": weights.name, "bytes": weights.stat().st_size, "held": things_found(arrays, last)}))  # noqa: T201


def mean_of(before: Arrays, after: Arrays, kept: float) -> dict[str, NDArray[Any]]:
    """Return the weights after training, the networks blended with those before: this keeps what both know (Wortsman
    et al., Robust fine-tuning of zero-shot models, CVPR 2022). The judge of things is the new one.
    """
    blended = {n: np.asarray(v) for n, v in after.items()}
    for n, v in blended.items():
        if n.startswith(("fine.", "coarse.")) and np.issubdtype(v.dtype, np.floating):
            blended[n] = (kept * np.asarray(before[n], np.float64) + (1.0 - kept) * v).astype(np.float32)
    return blended


def _write_state(arrays: Arrays, part: str, folder: Path) -> None:
    """Write the network of some weights as a fit that can be gone on from."""
    folder.mkdir(parents=True, exist_ok=True)
    held = {n.removeprefix(f"{part}."): torch.from_numpy(v) for n, v in arrays.items() if n.startswith(f"{part}.")}
    torch.save({"network": held}, folder / "state.pt")
    (folder / "labels.json").write_text(json.dumps([str(word) for word in arrays["names"]]))


if __name__ == "__main__":
    main()
