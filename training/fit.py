"""Training of one network on lessons: losses, a log, checkpoints to go on from."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from list3r.instances.learned.cut import EXTRA_EDGES
from list3r.instances.learned.graph import EDGE_FEATURES, NODE_FEATURES
from training.graphs import Lesson
from training.model import PieceNetwork
from training.worlds.catalogue import LABELS


@dataclass(frozen=True)
class Blindness:
    """What an ablation does not see."""

    nodes: tuple[int, ...] = ()
    """Columns of the features of pieces."""
    edges: tuple[int, ...] = ()
    """Columns of the features of borders."""
    messages: bool = True
    """Whether messages are passed."""


SEEING = Blindness()
COLOUR, VIEWS = Blindness((16, 17, 18, 19, 20, 21), (7, 8, 20, 21, 22, 23)), Blindness((24, 25), (17, 18, 19, 20, 21))
WIDTH = 48
"""Width of the first network's states of pieces, which the second one sees."""
ABLATIONS = {
    "colour": COLOUR,
    "views": VIEWS,
    "messages": Blindness(messages=False),
}
"""What can be left out. Superpoints keep to borders of colour all the same."""
BLINKS = (
    COLOUR,
    VIEWS,
    Blindness((13, 14, 15), ()),
    Blindness(tuple(range(NODE_FEATURES, NODE_FEATURES + WIDTH)), ()),
    Blindness((), tuple(range(EDGE_FEATURES, EDGE_FEATURES + EXTRA_EDGES))),
)
"""Colours; views; heights; what the first network made of pieces; what it said of borders."""
BLIND = 1e9
"""Deviation by which a feature vanishes."""


@dataclass(frozen=True)
class FitSettings:
    """How long and how fast."""

    epochs: int = 12
    rate: float = 3e-3
    """Largest learning rate; it falls along half a cosine."""
    decay: float = 1e-4
    name_share: float = 0.2
    """Weight of the loss of names."""
    noise: float = 0.0
    """Deviation of what is added to features, of their own deviation."""
    blink: float = 0.0
    """How probably each of `BLINKS` is not seen in a lesson, so that nothing leans on one kind of feature alone."""
    average: float = 0.0
    """What of the mean of all weights so far a step keeps; above 0 the mean is what is scored and handed out."""
    least_weight: float = 0.0
    """What every border counts, however short it is, beside the logarithm of its length: legs are thin."""
    seed: int = 0
    start: Path | None = None
    """Folder of an earlier fit to go on from, its learning rate a third."""
    blind: Blindness = field(default_factory=lambda: SEEING)


def fit(
    network: PieceNetwork, lessons: Sequence[Lesson], held: Sequence[Lesson], folder: Path, settings: FitSettings
) -> PieceNetwork:
    """Train a network; a state of each epoch in `folder` lets an interrupted run go on, `log.jsonl` tells losses.

    The first GPU is used where there is one; weights are the same to the bit only on the CPU.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(settings.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    rate = settings.rate
    if settings.start is None:
        _standardise(network, lessons, settings.blind)
    else:
        load_earlier(network, settings.start)
        rate /= 3.0
    network.to(device)
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=settings.decay)
    (folder / "labels.json").write_text(json.dumps(LABELS))
    state, start = folder / "state.pt", 0
    if state.exists():
        saved = torch.load(state, weights_only=True, map_location=device)
        network.load_state_dict(saved["network"])
        optimiser.load_state_dict(saved["optimiser"])
        start = int(saved["epoch"])
    steps = settings.epochs * len(lessons)
    mean = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(settings.average)) if settings.average else None
    if mean is not None and start:
        mean.load_state_dict(saved["mean"])
    for epoch in range(start, settings.epochs):
        began, losses = time.monotonic(), []
        order = np.random.default_rng([settings.seed, epoch]).permutation(len(lessons))
        for k, row in enumerate(order.tolist()):
            done = (epoch * len(lessons) + k) / steps
            for group in optimiser.param_groups:
                group["lr"] = float(rate * min(1.0, done * 30 + 0.05) * 0.5 * (1 + np.cos(np.pi * done)))
            losses.append(_step(network, optimiser, lessons[row], settings))
            if mean is not None:
                mean.update_parameters(network)
        judged = network if mean is None else mean.module
        entry = {"epoch": epoch + 1, **_means(losses), "s": round(time.monotonic() - began, 1), **score(judged, held)}
        with (folder / "log.jsonl").open("a") as log:
            log.write(json.dumps(entry) + "\n")
        print(json.dumps(entry), flush=True)  # noqa: T201
        kept = {"network": network.state_dict(), "optimiser": optimiser.state_dict(), "epoch": epoch + 1}
        torch.save(kept | ({} if mean is None else {"mean": mean.state_dict()}), state)
    return (network if mean is None else mean.module).cpu()


def load_earlier(network: PieceNetwork, folder: Path) -> None:
    """Take over the weights of an earlier fit; names are matched by their words, new ones start from scratch."""
    state = torch.load(folder / "state.pt", weights_only=True, map_location="cpu")
    means = {k.removeprefix("module."): v for k, v in state.get("mean", {}).items() if k.startswith("module.")}
    saved = means or state["network"]
    row = {word: 1 + k for k, word in enumerate(json.loads((folder / "labels.json").read_text()))}
    own = network.state_dict()
    for part in ("weight", "bias"):
        head = own[f"node_head.{part}"].clone()
        head[0] = saved[f"node_head.{part}"][0]
        for k, word in enumerate(LABELS):
            if word in row:
                head[1 + k] = saved[f"node_head.{part}"][row[word]]
        saved[f"node_head.{part}"] = head
    network.load_state_dict(saved)


def tensors(lesson: Lesson, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return what a network takes."""
    g = lesson.graph
    nodes, left, right, edges, back = (
        torch.from_numpy(a).to(device) for a in (g.nodes, g.left, g.right, g.edges, g.reversed_edges())
    )
    return nodes, left, right, edges, back


def _standardise(network: PieceNetwork, lessons: Sequence[Lesson], blind: Blindness) -> None:
    nodes = np.concatenate([lesson.graph.nodes for lesson in lessons])
    edges = np.concatenate([lesson.graph.edges for lesson in lessons])
    for name, values in (("node", nodes), ("edge", edges)):
        getattr(network, f"{name}_mean").copy_(torch.from_numpy(values.mean(axis=0)))
        std = values.std(axis=0) + 1e-3
        std[list(getattr(blind, f"{name}s"))] = BLIND
        getattr(network, f"{name}_std").copy_(torch.from_numpy(std))


def truths(lesson: Lesson) -> tuple[Any, Any, Any]:
    """Return of each border whether it is inside of a thing, whether it is known, and its weight. Shape (E,) each."""
    a, b = lesson.thing[lesson.graph.left], lesson.thing[lesson.graph.right]
    known = (a > 0) & (b > 0)
    weight = np.log1p(lesson.graph.weight) * known
    return a == b, known, weight.astype(np.float32)


def _step(
    network: PieceNetwork, optimiser: torch.optim.Optimizer, lesson: Lesson, settings: FitSettings
) -> dict[str, float]:
    network.train()
    device = network.node_mean.device
    affinity, structure, names, _ = network(*_disturbed(network, lesson, settings))
    same, known, weight = truths(lesson)
    w = torch.from_numpy(weight + np.float32(settings.least_weight) * known).to(device)
    pair = F.binary_cross_entropy_with_logits(
        affinity, torch.from_numpy(same.astype(np.float32)).to(device), w, reduction="sum"
    ) / w.sum().clamp(min=1)
    size = torch.from_numpy(np.sqrt(lesson.size) * (lesson.thing > 0)).to(device)
    bound = F.binary_cross_entropy_with_logits(
        structure, torch.from_numpy(lesson.structure.astype(np.float32)).to(device), size, reduction="sum"
    )
    bound = bound / size.sum().clamp(min=1)
    named = torch.from_numpy(np.flatnonzero(lesson.name >= 0)).to(device)
    word = torch.zeros((), device=device)
    if len(named):
        word = F.cross_entropy(names[named], torch.from_numpy(lesson.name).to(device)[named], label_smoothing=0.05)
    loss = pair + 0.5 * bound + settings.name_share * word
    optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimiser.step()
    return {"pair": pair.item(), "structure": bound.item(), "name": word.item()}


def _disturbed(
    network: PieceNetwork, lesson: Lesson, settings: FitSettings
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What a network takes, with noise on the features, and some not seen; both ways of a border keep the same."""
    nodes, left, right, edges, back = tensors(lesson, network.node_mean.device)
    if settings.noise > 0:
        nodes = nodes + settings.noise * network.node_std * torch.randn_like(nodes)
        shift = settings.noise * network.edge_std * torch.randn_like(edges)
        edges, back = edges + shift, back + shift
    if settings.blink > 0:
        nodes, edges, back = nodes.clone(), edges.clone(), back.clone()
        for group in BLINKS:
            if torch.rand(()) < settings.blink:
                n = [k for k in group.nodes if k < nodes.shape[1]]
                e = [k for k in group.edges if k < edges.shape[1]]
                nodes[:, n] = network.node_mean[n]
                edges[:, e], back[:, e] = network.edge_mean[e], network.edge_mean[e]
    return nodes, left, right, edges, back


def _means(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {k: round(float(np.mean([r[k] for r in rows])), 4) for k in rows[0]}


@torch.no_grad()
def score(network: PieceNetwork, lessons: Sequence[Lesson]) -> dict[str, float]:
    """Return losses and shares right on lessons not trained on."""
    network.eval()
    right: dict[str, list[float]] = {
        "held_pair": [],
        "held_apart_found": [],
        "held_same_kept": [],
        "held_structure": [],
        "held_name": [],
    }
    for lesson in lessons:
        affinity, structure, names, _ = network(*tensors(lesson, network.node_mean.device))
        same, _, weight = truths(lesson)
        told = affinity.cpu().numpy()
        loss = np.logaddexp(0, told) - told * same
        right["held_pair"].append(float((loss * weight).sum() / max(weight.sum(), 1)))
        apart, inside = weight * ~same, weight * same
        right["held_apart_found"].append(float((apart * (told < 0)).sum() / max(apart.sum(), 1e-6)))
        right["held_same_kept"].append(float((inside * (told > 0)).sum() / max(inside.sum(), 1e-6)))
        size = lesson.size * (lesson.thing > 0)
        right["held_structure"].append(
            float((size * ((structure.cpu().numpy() > 0) == lesson.structure)).sum() / max(size.sum(), 1))
        )
        named = lesson.name >= 0
        if named.any():
            told_right = names.cpu().numpy().argmax(1) == lesson.name
            right["held_name"].append(float((lesson.size * told_right)[named].sum() / lesson.size[named].sum()))
    return {k: round(float(np.mean(v)), 4) if v else 0.0 for k, v in right.items()}
