"""Make the plane sweep's network from seeds.

python -m training.sweep --out DIR --rooms 1140 --workers 14

Rooms are filmed and swept first, each kept in the folder; then the network learns from them, on a GPU where there is
one. On processors alone take `--steps 4000 --start list3r/reconstruction/mvs/weights.npz`, which goes on from the
shipped network: from nothing, so many steps of 40 would take days of two cores. Both are gone on with when interrupted.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from list3r.reconstruction.mvs.network import SweepNetwork, load_network
from list3r.reconstruction.mvs.weights import FORMAT
from training.samples import Kind
from training.sweep_fit import SweepFitSettings, fit_sweep, judge_sweep
from training.sweep_samples import make_keyframes
from training.train import FIRST_FITTED_HELD_SEED, FIRST_HELD_SEED, ODD_SHARE

FIRST_SWEEP_SEED = 20_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of rooms, states and logs; 15 MB a room")
    parser.add_argument("--rooms", type=int, default=1140)
    parser.add_argument("--held", type=int, default=10, help="left-out rooms of each kind, to report errors of")
    parser.add_argument("--workers", type=int, default=2, help="processes that film and sweep rooms")
    parser.add_argument("--steps", type=int, default=13_000)
    parser.add_argument("--start", type=Path, help="weights to go on from")
    parser.add_argument("--weights", type=Path, help="where the weights go; out/weights.npz without it")
    args = parser.parse_args()
    tasks = [(FIRST_SWEEP_SEED + k, kind_of(FIRST_SWEEP_SEED + k)) for k in range(args.rooms)]
    tasks += [(FIRST_HELD_SEED + k, Kind(held_out=True)) for k in range(args.held)]
    tasks += [(FIRST_FITTED_HELD_SEED + k, Kind(held_out=True, fitted=True)) for k in range(args.held)]
    with ProcessPoolExecutor(args.workers, get_context("spawn")) as pool:
        made = []
        for path in pool.map(partial(_make, args.out / "keyframes"), tasks):
            made.append(path)
            if len(made) % 20 == 0 or len(made) == len(tasks):
                print(json.dumps({"rooms": len(made), "of": len(tasks)}), flush=True)  # noqa: T201
    found = [(path, kind) for path, (_, kind) in zip(made, tasks, strict=True) if path is not None]
    rooms = [path for path, kind in found if not kind.get("held_out")]
    held = [path for path, kind in found if kind.get("held_out")]
    if not rooms:
        parser.error("there is no room to learn from; give --rooms")
    network = SweepNetwork() if args.start is None else load_network(args.start)
    network.requires_grad_(True)
    gpu = torch.cuda.is_available()
    settings = SweepFitSettings(args.steps, 40 if gpu else 4, None if gpu else (96, 128))
    if args.start is not None:
        settings = SweepFitSettings(args.steps, settings.batch, settings.crop, rate=3e-4, average=0.995)
    network.load_state_dict(fit_sweep(network, rooms, args.out / "fit", settings))
    weights = args.weights or args.out / "weights.npz"
    FORMAT.write(weights, {name: value.cpu().numpy() for name, value in network.state_dict().items()})
    print(json.dumps({"weights": weights.name, "bytes": weights.stat().st_size, "held": judge_sweep(network, held)}))  # noqa: T201


def kind_of(seed: int) -> Kind:
    """Return what kind of room a seed is: with what is built in, with recesses, with things that no catalogue knows."""
    chance = np.random.default_rng([seed, 77]).random(3)
    return Kind(
        fitted=bool(chance[0] < 0.3), recessed=bool(chance[1] < 0.35), odd=ODD_SHARE if chance[2] < 0.35 else 0.0
    )


def _make(folder: Path, task: tuple[int, Kind]) -> Path | None:
    torch.set_num_threads(1)
    return make_keyframes(task[0], folder, **task[1])


if __name__ == "__main__":
    main()
