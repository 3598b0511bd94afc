"""Training of what judges whole things: their names, and whether each is one whole; and its calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import CutSettings
from list3r.instances.learned.network import Classification, classify, two_layers
from list3r.instances.learned.verdicts import NODES_AT, SHOWN_NODES, segment_features
from training.fit import BLIND, SEEING, Blindness
from training.graphs import Lesson
from training.worlds.catalogue import LABELS

Arrays = Mapping[str, NDArray[Any]]

ONE_THING, SAME_NAME = 0.5, 0.25
"""IoU with a true thing, by voxels, from which a cluster is one whole, and from which it should have its name."""


OTHER_ENDS = (-2.5, -1.0, 1.0)
"""Where agglomeration stops besides, so that what is joined too far and not far enough is seen."""


@dataclass(frozen=True)
class ThingFit:
    """How the classifier of things is trained."""

    hidden: int = 256
    steps: int = 6000
    batch: int = 256
    rate: float = 3e-3
    decay: float = 1e-2
    noise: float = 0.1
    """Deviation of what is added to features, of their own deviation."""
    dropout: float = 0.5
    seed: int = 0


@dataclass(frozen=True)
class ThingTable:
    """T clusters with their truth."""

    x: NDArray[np.float32]
    """What verdicts are told from. Shape (T, F)."""
    whole: NDArray[np.bool_]
    """Shape (T,)."""
    name: NDArray[np.int64]
    """Row of `LABELS`, -1 where it has none. Shape (T,)."""
    structure: NDArray[np.bool_]
    """Clusters that are structure by most of their voxels, or said to be. Shape (T,)."""


def overlaps(
    lesson: Lesson, own: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return each cluster's IoU by voxels with the thing it fits best, that thing, and which clusters are structure."""
    known = lesson.thing > 0
    count = int(own.max(initial=-1)) + 1
    size = np.bincount(own, lesson.size, minlength=count)
    whole = np.bincount(lesson.thing[known], lesson.size[known])
    codes, at = np.unique(own[known] << 16 | lesson.thing[known], return_inverse=True)
    shared = np.bincount(at, lesson.size[known])
    cluster, thing = codes >> 16, codes & 0xFFFF
    iou = shared / (size[cluster] + whole[thing] - shared)
    best, which = np.zeros(count), np.zeros(count, np.int64)
    order = np.argsort(iou, kind="stable")
    best[cluster[order]], which[cluster[order]] = iou[order], thing[order]
    bound = np.bincount(own, lesson.size * lesson.structure, minlength=count) > 0.5 * size
    return best, which, bound


def clusters(arrays: Arrays, lesson: Lesson, enough: float) -> tuple[NDArray[np.int64], Classification]:
    """Return the thing of each part of a graph (P,), and what the second network said."""
    told = classify(arrays, "coarse", lesson.graph)
    g = lesson.graph
    return agglomerate(len(g.nodes), g.left, g.right, told.affinity, g.weight, enough), told


def table_of(arrays: Arrays, lessons: Sequence[Lesson], *, more: bool) -> ThingTable:
    """Return the clusters of several chunks; with `more` those of other thresholds and of the truth, too."""
    rows: list[tuple[NDArray[Any], ...]] = []
    for lesson in lessons:
        told, g = classify(arrays, "coarse", lesson.graph), lesson.graph
        ends = (CutSettings().enough, *(OTHER_ENDS if more else ()))
        groupings = [agglomerate(len(g.nodes), g.left, g.right, told.affinity, g.weight, end) for end in ends]
        if more:
            groupings.append(np.unique(lesson.thing, return_inverse=True)[1].astype(np.int64))
        for grouping in groupings:
            iou, which, bound = overlaps(lesson, grouping)
            said, x = segment_features(grouping, lesson.graph, told)
            label = dict(zip(lesson.thing.tolist(), lesson.name.tolist(), strict=True))
            name = np.array([label.get(t, -1) for t in which.tolist()], np.int64)
            rows.append((x, iou > ONE_THING, np.where(iou > SAME_NAME, name, -1), bound | (said > 0.5)))
    columns = [np.concatenate(part) for part in zip(*rows, strict=True)]
    return ThingTable(columns[0], columns[1], columns[2], columns[3])


def fit_things(
    arrays: Arrays,
    lessons: Sequence[Lesson],
    held: Sequence[Lesson],
    settings: ThingFit | None = None,
    blind: Blindness = SEEING,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of the classifier of things, trained on `lessons` and calibrated on left-out worlds."""
    s = settings or ThingFit()
    table = table_of(arrays, lessons, more=True)
    free = ~table.structure
    x, whole, name = table.x[free], table.whole[free], table.name[free]
    mean, std = x.mean(axis=0), x.std(axis=0) + 1e-2
    std[[NODES_AT + k for k, column in enumerate(SHOWN_NODES) if column in blind.nodes]] = BLIND
    torch.manual_seed(s.seed)
    net = nn.Sequential(
        nn.Linear(x.shape[1], s.hidden), nn.ReLU(), nn.Dropout(s.dropout), nn.Linear(s.hidden, 1 + len(LABELS))
    )
    optimiser = torch.optim.AdamW(net.parameters(), s.rate, weight_decay=s.decay)
    given, truth = torch.from_numpy((x - mean) / std), torch.from_numpy(whole.astype(np.float32))
    called = torch.from_numpy(name)
    share = torch.from_numpy(1.0 / np.sqrt(np.bincount(name[name >= 0], minlength=len(LABELS)) + 5.0)).float()
    rng = np.random.default_rng(s.seed)
    for step in range(s.steps):
        rows = torch.from_numpy(rng.integers(len(x), size=s.batch))
        for group in optimiser.param_groups:
            group["lr"] = s.rate * 0.5 * (1 + float(np.cos(np.pi * step / s.steps)))
        out = net(given[rows] + s.noise * torch.randn(len(rows), x.shape[1]))
        loss = F.binary_cross_entropy_with_logits(out[:, 0], truth[rows])
        known = called[rows] >= 0
        if known.any():
            target = called[rows][known]
            each = F.cross_entropy(out[known, 1:], target, reduction="none", label_smoothing=0.02)
            loss = loss + (each * share[target]).sum() / share[target].sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    layers = {"0": net[0], "2": net[3]}
    found: dict[str, NDArray[Any]] = {"things.mean": mean, "things.std": std}
    for number, layer in layers.items():
        found[f"things.net.{number}.weight"] = layer.weight.detach().numpy()
        found[f"things.net.{number}.bias"] = layer.bias.detach().numpy()
    found["names"] = np.array(LABELS)
    return found | calibrate({**arrays, **found}, held)


def calibrate(arrays: Arrays, held: Sequence[Lesson]) -> dict[str, NDArray[Any]]:
    """Return the scale and shift of the log odds of being whole, and the temperature of names, on left-out worlds.

    A name is right or wrong only of what is a thing: the other probability tells whether it is one.
    """
    table = table_of(arrays, held, more=False)
    free = ~table.structure
    x = ((table.x[free] - arrays["things.mean"]) / arrays["things.std"]).astype(np.float32)
    out = two_layers(arrays, "things.net", x).astype(np.float64)
    a, b = _platt(out[:, 0], table.whole[free])
    listed = (1 / (1 + np.exp(-(a * out[:, 0] + b))) > 0.3) & (table.name[free] >= 0)
    name = table.name[free][listed]
    losses = {}
    for temperature in np.geomspace(0.5, 6.0, 60).tolist():
        odds = out[listed, 1:] / temperature
        p = np.exp(odds - odds.max(axis=1, keepdims=True))
        best = np.clip((p / p.sum(axis=1, keepdims=True)).max(axis=1), 1e-6, 1 - 1e-6)
        right = p.argmax(axis=1) == name
        losses[temperature] = float(-np.where(right, np.log(best), np.log(1 - best)).mean())
    return {
        "things.whole": np.array([a, b], np.float32),
        "things.temperature": np.float32(min(losses, key=lambda t: losses[t])),
    }


def _platt(odds: NDArray[np.float64], right: NDArray[np.bool_]) -> tuple[float, float]:
    """Scale and shift of log odds that make them likeliest, by Newton's method with a weak prior on (1, 0)."""
    full, w = np.column_stack([odds, np.ones(len(odds))]), np.array([1.0, 0.0])
    for _ in range(30):
        p = 1 / (1 + np.exp(-np.clip(full @ w, -20, 20)))
        hessian = full.T @ (full * (p * (1 - p))[:, None]) + np.eye(2)
        w = w + np.linalg.solve(hessian, full.T @ (right - p) - (w - np.array([1.0, 0.0])))
    return float(w[0]), float(w[1])
