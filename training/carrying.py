"""Training of the network that tells what carries a thing, on what agglomeration leaves apart.

python -m training.carrying --out DIR --weights list3r/instances/learned/weights.npz --to NEW.npz

Rooms are others than those the larger networks learned from, which leave less apart there. Agglomeration that stops
early besides leaves more of what is one thing apart, alike in kind.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.carrying import MOST, Borders, CarrySettings, carry_pairs, clusters_of
from list3r.instances.learned.cut import CutSettings, join_parts, spread_labels
from list3r.instances.learned.graph import chunk_surface
from list3r.instances.learned.pieces import cut_pieces
from list3r.instances.learned.things import classify_things, names_of
from list3r.instances.learned.weights import load_weights, write_weights
from training.graphs import LEAST_PURE, surroundings_of
from training.samples import make_sample, read_sample
from training.train import ODD_SHARE

FIRST_SEED, FIRST_FITTED_SEED, FIRST_ODD_SEED = 12000, 12500, 13000
"""Seeds count up from here: rooms with loose furniture, with what is built in, with what no catalogue knows."""
EARLY = 2.5
"""Mean log odds above which parts become things, for the further pairs."""

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class CarryFit:
    """How the network is trained."""

    hidden: int = 48
    steps: int = 3000
    batch: int = 256
    rate: float = 3e-3
    decay: float = 3e-2
    noise: float = 0.1
    """Deviation of what is added to features, of their own deviation."""
    dropout: float = 0.3
    early: float = 0.4
    """Weight of pairs that agglomeration leaves apart only if it stops early."""
    members: int = 3
    """Networks that are trained from different beginnings; what they say in the mean is one network as wide as all."""


@dataclass(frozen=True)
class PairTable:
    """Q pairs with their truth."""

    x: NDArray[np.float32]
    """Shape (Q, F)."""
    one: NDArray[np.bool_]
    """Whether both are of one true thing. Shape (Q,)."""
    weight: NDArray[np.float32]
    """Shape (Q,)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of chunks and pairs")
    parser.add_argument("--weights", type=Path, help="weights of the other networks; the shipped ones without it")
    parser.add_argument("--to", type=Path, required=True, help="where the weights go with this network's among them")
    parser.add_argument("--worlds", type=int, default=70, help="rooms with loose furniture")
    parser.add_argument("--fitted", type=int, default=35, help="rooms with what is built in")
    parser.add_argument("--odd", type=int, default=25, help="rooms with things that no catalogue knows")
    args = parser.parse_args()
    torch.set_num_threads(1)
    data, weights = args.out / "chunks", load_weights(args.weights)
    paths = [make_sample(FIRST_SEED + k, data) for k in range(args.worlds)]
    paths += [make_sample(FIRST_FITTED_SEED + k, data, fitted=True) for k in range(args.fitted)]
    paths += [make_sample(FIRST_ODD_SEED + k, data, odd=ODD_SHARE) for k in range(args.odd)]
    tables = [kept_pairs(p, weights, args.out / "pairs") for p in paths]
    write_weights(args.to, {**weights, **fit_carrying(tables)})
    found = {"pairs": sum(len(t.one) for t in tables), "of one thing": sum(int(t.one.sum()) for t in tables)}
    print(json.dumps({"weights": args.to.name, **found}))  # noqa: T201


def kept_pairs(path: Path, weights: Arrays, folder: Path) -> PairTable:
    """Return the pairs of a sample on disk, kept in `folder`."""
    file = folder / f"{path.stem}.npz"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        table = pairs_of(path, weights)
        new = file.with_suffix(".new.npz")
        np.savez(new, x=table.x, one=table.one, weight=table.weight)
        new.replace(file)
    with np.load(file) as found:
        return PairTable(found["x"], found["one"], found["weight"])


def pairs_of(path: Path, weights: Arrays, early: float = CarryFit().early) -> PairTable:
    """Return the pairs of a sample that are asked about, with their truth; mixed clusters teach nothing."""
    sample = read_sample(path)
    cloud = sample.cloud()
    surface, truth = chunk_surface(cloud, sample.views, surroundings_of(sample)), sample.truth_of(cloud)
    bound = [t.id for t in sample.things if t.structure]
    s = CutSettings()
    parts, graph, told = join_parts(surface, cut_pieces(surface), weights, s)
    tables = []
    for end, weight in ((s.enough, 1.0), (EARLY, early)):
        own = agglomerate(len(graph.nodes), graph.left, graph.right, told.affinity, graph.weight, end)
        labels = spread_labels(cloud.points, np.asarray(np.append(own, -1)[parts], np.int32), s.hop_m)
        said = classify_things(weights, own, graph, told)
        borders = Borders(own[graph.left], own[graph.right], told.affinity, graph.weight)
        c = clusters_of(surface, labels, said, names_of(weights), borders)
        pairs = carry_pairs(surface, c, (c.whole >= CarrySettings().listed_from) & (c.structure <= 0.5))
        thing, pure = _majority(c.labels, truth, c.count)
        known = (np.minimum(pure[pairs.thing], pure[pairs.bit]) >= LEAST_PURE) & ~np.isin(thing[pairs.thing], bound)
        one = (thing[pairs.thing] == thing[pairs.bit]) & (thing[pairs.thing] > 0)
        tables.append((pairs.x[known], one[known], np.full(int(known.sum()), weight, np.float32)))
    columns = [np.concatenate(part) for part in zip(*tables, strict=True)]
    return PairTable(columns[0], columns[1], columns[2])


def _majority(
    labels: NDArray[np.int32], truth: NDArray[np.int32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the true thing of most voxels of each cluster, 0 for none, and their share. Shape (C,) each."""
    known = labels >= 0
    codes, votes = np.unique(labels[known].astype(np.int64) << 16 | truth[known], return_counts=True)
    order = np.lexsort((votes, codes >> 16))
    thing, most = np.zeros(count, np.int64), np.zeros(count)
    thing[codes[order] >> 16], most[codes[order] >> 16] = codes[order] & 0xFFFF, votes[order]
    return thing, most / np.maximum(np.bincount(labels[known], minlength=count), 1)


def fit_carrying(tables: Sequence[PairTable], settings: CarryFit | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of the network, trained on pairs."""
    s = settings or CarryFit()
    x = np.clip(np.concatenate([t.x for t in tables]), -MOST, MOST)
    one = np.concatenate([t.one for t in tables]).astype(np.float32)
    share = torch.from_numpy(np.concatenate([t.weight for t in tables]))
    mean, std = x.mean(axis=0), x.std(axis=0) + np.float32(1e-2)
    given, truth = torch.from_numpy((x - mean) / std), torch.from_numpy(one)
    nets = [_fitted((given, truth, share), s, seed) for seed in range(s.members)]
    found: dict[str, NDArray[Any]] = {"carry.mean": mean, "carry.std": std}
    hidden, last = [n[0] for n in nets], [n[3] for n in nets]
    found["carry.net.0.weight"] = np.concatenate([h.get_parameter("weight").detach().numpy() for h in hidden])
    found["carry.net.0.bias"] = np.concatenate([h.get_parameter("bias").detach().numpy() for h in hidden])
    found["carry.net.2.weight"] = (
        np.concatenate([e.get_parameter("weight").detach().numpy() for e in last], axis=1) / s.members
    )
    found["carry.net.2.bias"] = np.mean([e.get_parameter("bias").detach().numpy() for e in last], axis=0)
    return found


def _fitted(table: tuple[Tensor, Tensor, Tensor], s: CarryFit, seed: int) -> nn.Sequential:
    """Return one network, trained; the table is what it sees (Q, F), the truth (Q,) and weights (Q,) of pairs."""
    given, truth, share = table
    torch.manual_seed(seed)
    net = nn.Sequential(nn.Linear(given.shape[1], s.hidden), nn.ReLU(), nn.Dropout(s.dropout), nn.Linear(s.hidden, 1))
    optimiser, rng = torch.optim.AdamW(net.parameters(), s.rate, weight_decay=s.decay), np.random.default_rng(seed)
    for step in range(s.steps):
        for group in optimiser.param_groups:
            group["lr"] = s.rate * 0.5 * (1 + float(np.cos(np.pi * step / s.steps)))
        rows = torch.from_numpy(rng.integers(len(given), size=s.batch))
        out = net(given[rows] + s.noise * torch.randn(len(rows), given.shape[1]))[:, 0]
        loss: Any = (F.binary_cross_entropy_with_logits(out, truth[rows], reduction="none") * share[rows]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return net


if __name__ == "__main__":
    main()
