"""Train the weights for computed depth further, on rooms whose depth our own plane sweep computes.

python -m training.computed --out DIR --start list3r/instances/learned/weights-computed.npz

A third of the rooms are those of `training.train` with simulated errors of computed depth, as networks of geometry
make them. Every step is kept in the folder and not done again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from list3r.instances.learned.graph import EDGE_FEATURES, NODE_FEATURES
from list3r.instances.learned.weights import load_weights, write_weights
from training.fit import SEEING, WIDTH, FitSettings, fit
from training.graphs import first_lesson, second_lessons
from training.model import PieceNetwork
from training.samples import make_sample
from training.swept import make_swept
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
from training.worlds.film import FilmSettings, drawn_sensor

SWEPT_SEED, SWEPT_FITTED_SEED, SWEPT_ODD_SEED = 7000, 7300, 7500
"""Seeds of swept rooms count up from here, as those of `training.train` do from others."""
ENDS = (FIRST_ENDS[1], STATES[1], STATES[2])
"""What agglomeration passes through in the second network's lessons."""

Rooms = list[tuple[Path, bool]]
"""Chunks, and whether each is learned from in few colours."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of chunks, graphs, states and logs")
    parser.add_argument("--start", type=Path, required=True, help="weights to go on from")
    parser.add_argument("--swept", default="110,50,60", help="swept rooms: with loose furniture, built in, odd things")
    parser.add_argument("--simulated", default="300,150,150", help="of so many rooms of training.train those computed")
    parser.add_argument("--held", type=int, default=12, help="left-out worlds of each kind, to calibrate on")
    parser.add_argument("--epochs", type=int, default=5, help="of the first network; the second has one less")
    parser.add_argument("--weights", type=Path, help="where the weights go; out/weights-computed.npz without it")
    args = parser.parse_args()
    torch.set_num_threads(1)
    data = args.out / "swept"
    loose, fitted, odd = map(int, args.swept.split(","))
    found = [make_swept(SWEPT_SEED + k, data) for k in range(loose)]
    found += [make_swept(SWEPT_FITTED_SEED + k, data, fitted=True) for k in range(fitted)]
    seeds = range(SWEPT_ODD_SEED, SWEPT_ODD_SEED + odd)
    found += [make_swept(seed, data, fitted=seed % 3 == 2, odd=ODD_SHARE) for seed in seeds]
    rooms = [(p, few) for p in found if p is not None for few in (False, True)]
    rooms += [(p, False) for p in _simulated(args.out / "chunks", *map(int, args.simulated.split(",")))]
    held = [make_swept(FIRST_HELD_SEED + k, data, held_out=True) for k in range(args.held)]
    held += [make_swept(FIRST_FITTED_HELD_SEED + k, data, held_out=True, fitted=True) for k in range(args.held)]
    left_out = [(p, False) for p in held if p is not None]
    weights = args.weights or args.out / "weights-computed.npz"
    train_further(rooms, left_out, args.out, args.epochs, weights, args.start)


def _simulated(folder: Path, loose: int, fitted: int, odd: int) -> list[Path]:
    """Make those of the first rooms of `training.train` whose sensor is computed depth."""
    kinds = [(FIRST_SEED + k, False, 0.0) for k in range(loose)]
    kinds += [(FIRST_FITTED_SEED + k, True, 0.0) for k in range(fitted)]
    kinds += [(FIRST_ODD_SEED + k, k % 3 == 2, ODD_SHARE) for k in range(odd)]
    return [
        make_sample(seed, folder, fitted=built_in, odd=share)
        for seed, built_in, share in kinds
        if drawn_sensor(FilmSettings(seed), np.random.default_rng([seed, 7])) == "computed"
    ]


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
    write_weights(weights, arrays)
    print(json.dumps({"weights": weights.name, "bytes": weights.stat().st_size, "held": things_found(arrays, last)}))  # noqa: T201


def _write_state(arrays: Mapping[str, NDArray[Any]], part: str, folder: Path) -> None:
    """Write the network of some weights as a fit that can be gone on from."""
    folder.mkdir(parents=True, exist_ok=True)
    held = {n.removeprefix(f"{part}."): torch.from_numpy(v) for n, v in arrays.items() if n.startswith(f"{part}.")}
    torch.save({"network": held}, folder / "state.pt")
    (folder / "labels.json").write_text(json.dumps([str(word) for word in arrays["names"]]))


if __name__ == "__main__":
    main()
