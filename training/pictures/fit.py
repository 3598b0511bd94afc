"""Train the network on pictures from chunks on disk.

python -m training.pictures.fit --chunks DIR --out DIR --epochs 12 [--part 0/2] [--minutes 20]

A state after every epoch lets an interrupted run go on.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from training.pictures.images import COLOUR, make_pictures
from training.pictures.network import REACHES, PictureNetwork

BATCH = 8
APART = (3.0, 2.0, 1.5)
"""Weight of pairs of different things at each reach; they are few at short ones."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pictures", type=Path, required=True, help="where pictures are kept")
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--part", default="", help="k/n: all worlds for training but every n-th from the k-th")
    parser.add_argument("--every", type=int, default=1, help="only every n-th world, to try things out")
    words = parser.parse_args()
    torch.set_num_threads(1)
    paths = sorted(words.chunks.glob("train-*.npz"))[:: words.every]
    if words.part:
        k, n = (int(v) for v in words.part.split("/"))
        paths = [p for row, p in enumerate(paths) if row % n != k]
    held = sorted(words.chunks.glob("test-*.npz"))
    data = [make_pictures(p, words.pictures) for p in paths]
    fit(data, [make_pictures(p, words.pictures) for p in held], words.out, words.epochs)


def fit(data: Sequence[Path], held: Sequence[Path], folder: Path, epochs: int, rate: float = 4e-3) -> PictureNetwork:
    """Train on folders of pictures; `log.jsonl` tells losses."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    network = PictureNetwork().to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-2)
    state, start = folder / "state.pt", 0
    if state.exists():
        saved = torch.load(state, weights_only=True)
        network.load_state_dict(saved["network"])
        optimiser.load_state_dict(saved["optimiser"])
        start = int(saved["epoch"])
    rows = [(d, k) for d in data for k in range(len(np.load(d / "ids.npy", mmap_mode="r")))]
    steps = len(rows) // BATCH
    for epoch in range(start, epochs):
        began, cpu, losses = time.monotonic(), time.process_time(), []
        rng = np.random.default_rng([1, epoch])
        order = rng.permutation(len(rows))
        network.train()
        for step in range(steps):
            done = (epoch + step / steps) / epochs
            for group in optimiser.param_groups:
                group["lr"] = float(rate * min(1.0, done * 30 + 0.05) * 0.5 * (1 + np.cos(np.pi * done)))
            batch = [_drawn(*rows[r], rng) for r in order[step * BATCH : (step + 1) * BATCH]]
            loss, parts = losses_of(network, *_stacked(batch))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(parts)
        entry = {"epoch": epoch + 1, "train": _rounded(losses), "wall_s": round(time.monotonic() - began)}
        entry |= {"cpu_s": round(time.process_time() - cpu), "held": score(network, held)}
        with (folder / "log.jsonl").open("a") as log:
            log.write(json.dumps(entry) + "\n")
        print(json.dumps(entry), flush=True)  # noqa: T201
        torch.save({"network": network.state_dict(), "optimiser": optimiser.state_dict(), "epoch": epoch + 1}, state)
    return network


Row = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8], NDArray[np.float32]]


def _read(folder: Path, k: int, name: str = "x") -> Row:
    load = lambda word: np.load(folder / f"{word}.npy", mmap_mode="r")[k]  # noqa: E731
    return (
        load(name).astype(np.float32),
        load("ids").astype(np.int32),
        np.array(load("structure")),
        load("way").astype(np.float32),
    )


def _drawn(folder: Path, k: int, rng: np.random.Generator) -> Row:
    """A view with what training adds: depth as computed, no colour, mirrored, noise."""
    x, ids, structure, way = _read(folder, k, "computed" if rng.random() < 0.3 else "x")
    if rng.random() < 0.3:
        x[COLOUR] = 0.0
    else:
        x[COLOUR] *= rng.uniform(0.6, 1.4, (3, 1, 1)).astype(np.float32)
        x[COLOUR] += rng.normal(0, 0.15, (3, 1, 1)).astype(np.float32)
    x[5] += np.float32(rng.normal(0, 0.03))
    x[11] += np.float32(rng.normal(0, 0.3))
    if rng.random() < 0.5:
        x, ids, structure, way = (a[..., ::-1].copy() for a in (x, ids, structure, way))
        x[2], way[0] = -x[2], -way[0]
    return x, ids, structure, way


def _stacked(batch: Sequence[Row]) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(np.stack(part)) for part in zip(*batch, strict=True))


def losses_of(
    network: PictureNetwork, x: Tensor, ids: Tensor, structure: Tensor, way: Tensor
) -> tuple[Tensor, list[float]]:
    """Return the loss of a batch and its parts: affinity for each reach, structure, middle."""
    with torch.autocast("cpu", torch.bfloat16):
        out = network(x.contiguous(memory_format=torch.channels_last))
    out = out.float()
    parts = []
    for k, reach in enumerate(REACHES):
        total, mass = torch.zeros(()), torch.zeros(())
        for axis in (0, 1):
            told, same, known = pairs_of(out[:, 2 * k + axis], ids, axis, reach)
            weight = known * torch.where(same, 1.0, APART[k])
            loss = F.binary_cross_entropy_with_logits(told, same.float(), reduction="none")
            total, mass = total + (loss * weight).sum(), mass + weight.sum()
        parts.append(total / mass.clamp(min=1))
    seen = ids > 0
    flat = F.binary_cross_entropy_with_logits(out[:, 6], structure.float(), reduction="none")
    parts.append((flat * seen).sum() / seen.sum().clamp(min=1))
    there = torch.isfinite(way)
    away = F.smooth_l1_loss(out[:, 7:10], torch.nan_to_num(way), beta=0.1, reduction="none")
    parts.append((away * there).sum() / there.sum().clamp(min=1))
    loss = sum(parts[:3]) + 0.5 * parts[3] + 4.0 * parts[4]
    return loss, [p.item() for p in parts]


def pairs_of(told: Tensor, ids: Tensor, axis: int, reach: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return of each pixel and the one `reach` down (axis 0) or right (1) what is told, the same thing, and known."""
    if axis == 0:
        a, b, told = ids[:, :-reach], ids[:, reach:], told[:, :-reach]
    else:
        a, b, told = ids[..., :-reach], ids[..., reach:], told[..., :-reach]
    return told, a == b, ((a > 0) & (b > 0)).float()


def _rounded(losses: Sequence[Sequence[float]]) -> list[float]:
    return [round(float(v), 4) for v in np.mean(np.array(losses), axis=0)]


@torch.no_grad()
def score(network: PictureNetwork, held: Sequence[Path]) -> list[float]:
    """Return the parts of the loss on left-out worlds, every third view."""
    network.eval()
    rows = [(d, k) for d in held for k in range(0, len(np.load(d / "ids.npy", mmap_mode="r")), 3)]
    return _rounded([losses_of(network, *_stacked([_read(*row)]))[1] for row in rows])


if __name__ == "__main__":
    main()
