"""Train the weights for computed depth further, on rooms whose depth our own plane sweep computes.

python -m training.computed --out DIR --start list3r/instances/learned/weights-computed.npz

A third of the rooms are those of `training.train` with simulated errors of computed depth, as networks of geometry
make them. Every step is kept in the folder and not done again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from training.further import RECESSED_HELD_SEED, rooms_of, train_further
from training.samples import make_sample
from training.swept import make_swept
from training.train import (
    FIRST_FITTED_HELD_SEED,
    FIRST_FITTED_SEED,
    FIRST_HELD_SEED,
    FIRST_ODD_SEED,
    FIRST_SEED,
    ODD_SHARE,
)
from training.worlds.film import FilmSettings, drawn_sensor

SWEPT_SEED, SWEPT_FITTED_SEED, SWEPT_ODD_SEED = 7000, 7300, 7500
"""Seeds of swept rooms count up from here, as those of `training.train` do from others."""
RECESSED_SEED, RECESSED_FITTED_SEED, RECESSED_ODD_SEED = 7600, 7700, 7800
"""Likewise of swept rooms with recesses."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of chunks, graphs, states and logs")
    parser.add_argument("--start", type=Path, required=True, help="weights to go on from")
    parser.add_argument("--swept", default="110,50,60", help="swept rooms: with loose furniture, built in, odd things")
    parser.add_argument("--recessed", default="0,0,0", help="swept rooms with recesses, likewise")
    parser.add_argument("--simulated", default="300,150,150", help="of so many rooms of training.train those computed")
    parser.add_argument("--held", type=int, default=12, help="left-out worlds of each kind, to calibrate on")
    parser.add_argument("--epochs", type=int, default=5, help="of the first network; the second has one less")
    parser.add_argument("--weights", type=Path, help="where the weights go; out/weights-computed.npz without it")
    args = parser.parse_args()
    torch.set_num_threads(1)
    data = args.out / "swept"
    seeds = SWEPT_SEED, SWEPT_FITTED_SEED, SWEPT_ODD_SEED
    found = rooms_of(make_swept, data, seeds, args.swept, recessed=False)
    seeds = RECESSED_SEED, RECESSED_FITTED_SEED, RECESSED_ODD_SEED
    recessed = rooms_of(make_swept, data, seeds, args.recessed, recessed=True)
    found += recessed
    rooms = [(p, few) for p in found if p is not None for few in (False, True)]
    rooms += [(p, False) for p in _simulated(args.out / "chunks", *map(int, args.simulated.split(",")))]
    held = [make_swept(FIRST_HELD_SEED + k, data, held_out=True) for k in range(args.held)]
    held += [make_swept(FIRST_FITTED_HELD_SEED + k, data, held_out=True, fitted=True) for k in range(args.held)]
    for k in range(args.held if recessed else 0):
        held.append(make_swept(RECESSED_HELD_SEED + k, data, held_out=True, fitted=k % 2 == 1, recessed=True))
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


if __name__ == "__main__":
    main()
