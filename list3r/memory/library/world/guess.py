"""What a metre is where nobody knows: guessed by how people film, and by the sizes of what has a name.

A guess turns units into about metres and is said to be one wherever lengths are told: nothing is metric by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkRow, Instance
from list3r.memory.library.overlap.metre import CAMERA_M, CAMERA_SPREAD, DEPTH_SPREAD
from list3r.memory.library.overlap.summaries import cameras_of, chunk_summaries, sample_of
from list3r.memory.library.world.gravity import Gravity
from list3r.memory.store.facts import Fact
from list3r.memory.store.store import Store

_TABLES = ("table", "dining table", "desk")
_SEEN = 0.35
"""Deviation of the logarithm of what was seen of a thing that was named."""
USUAL_M: Mapping[str, tuple[float, float]] = {
    "bed": (2.0, 0.15),
    "bottle": (0.25, 0.3),
    "bowl": (0.16, 0.3),
    "chair": (0.85, 0.2),
    "cup": (0.10, 0.2),
    "door": (2.0, 0.08),
    "keyboard": (0.43, 0.15),
    "laptop": (0.34, 0.2),
    "microwave": (0.48, 0.15),
    "mouse": (0.11, 0.2),
    "mug": (0.10, 0.2),
    "refrigerator": (1.7, 0.2),
    "toilet": (0.7, 0.15),
}
"""Longest edge of things, metres, and the deviation of its logarithm, the sight of a part included."""


@dataclass(frozen=True)
class GuessSettings:
    """When a guess is good enough, and what people film."""

    most_deviation: float = 0.2
    """As a share of a metre, beyond which nothing is guessed."""
    over_table_m: float = 0.66
    """Height of the cameras over a table, where no floor is seen, and"""
    over_table_spread: float = 0.33
    """the deviation of its logarithm."""
    least_names: int = 2
    """Classes of usual size that must be named beside the table, for what was named may be the floor or a bed."""
    apart: float = 2.0
    """Deviations between two sources from which the less exact one is left out."""
    steady: float = 0.04
    """A guess that differs by less from the one before, as a share, is not worth scaling the world for."""


@dataclass(frozen=True)
class MetreGuess:
    """A guess."""

    metres: float
    """Metres in a unit of the graph."""
    deviation: float
    """As a share of it."""
    source: str
    """What it stands on, in words."""


GUESS = Fact[MetreGuess | None]("metre_guess", MetreGuess, None)
"""What a metre is by the last look at it; what is known of lengths goes before it."""


@dataclass
class _Sources:
    """What different sources say a metre is, in units: logarithms with deviations."""

    said: list[tuple[float, float, str]] = field(default_factory=list)

    def add(self, unit: float, deviation: float, name: str) -> None:
        if math.isfinite(unit) and unit > 0:
            self.said.append((math.log(unit), deviation, name))

    def together(self, apart: float) -> MetreGuess | None:
        """Their mean by weight; the least exact of those that contradict the more exact ones do not count."""
        kept: list[tuple[float, float, str]] = []
        for value, deviation, name in sorted(self.said, key=lambda row: row[1]):
            if not kept or abs(value - _mean(kept)[0]) <= apart * math.hypot(deviation, _mean(kept)[1]):
                kept.append((value, deviation, name))
        if not kept:
            return None
        value, deviation = _mean(kept)
        names = list(dict.fromkeys(name for *_, name in kept))
        return MetreGuess(math.exp(-value), deviation, _listed(names))


def _listed(names: Sequence[str]) -> str:
    return " and ".join([*([", ".join(names[:-1])] if len(names) > 1 else []), names[-1]])


def _mean(rows: Sequence[tuple[float, float, str]]) -> tuple[float, float]:
    weight = np.array([1.0 / deviation**2 for _, deviation, _ in rows])
    return float(weight @ [value for value, *_ in rows] / weight.sum()), float(1.0 / np.sqrt(weight.sum()))


def guess_metre(
    store: Store,
    chunks: Sequence[ChunkRow],
    S_graph_chunk: Mapping[int, Sim3],
    gravity: Gravity,
    settings: GuessSettings | None = None,
) -> MetreGuess | None:
    """Return what a metre is by the cameras, what they saw and what was named, of the chunks of one part; None where
    that says too little.

    `S_graph_chunk` and `gravity` are of the frame of the pose graph. Names are those that instances have now.
    """
    s, said = settings or GuessSettings(), _Sources()
    summaries, scale = chunk_summaries(store), float(store.facts.S_world_graph.scale)
    some = [_placed(c, S_graph_chunk) for c in sample_of(chunks)]
    depths = [float(c.S_world_chunk.scale) * summaries[c.chunk_id].unit for c in some]
    centers = cameras_of(store, some).translation
    if not depths or not len(centers) or gravity.status == "unknown":
        return None
    said.add(float(np.median(depths)), DEPTH_SPREAD, "how far things are")
    names = _by_names(store.instances.all(structure=False), chunks[0].component)
    if gravity.floor_height is not None:
        height = float(np.median(centers @ gravity.up)) - gravity.floor_height
        said.add(height / CAMERA_M, CAMERA_SPREAD, "the camera's height over the floor")
    elif store.facts.gravity != "unknown" and len(names) >= s.least_names:
        over = _over_table(store, chunks) / scale
        said.add(over / s.over_table_m, s.over_table_spread, "the camera's height over a table")
    if len(said.said) < 2:
        return None
    for unit, deviation, name in names:
        said.add(unit / scale, deviation, name)
    found, before = said.together(s.apart), store.facts[GUESS]
    if found is None or found.deviation > s.most_deviation:
        return None
    if before is not None and abs(before.metres / found.metres - 1.0) < s.steady:
        return MetreGuess(before.metres, found.deviation, found.source)
    return found


def _placed(chunk: ChunkRow, S_graph_chunk: Mapping[int, Sim3]) -> ChunkRow:
    return replace(chunk, S_world_chunk=S_graph_chunk[chunk.chunk_id])


def _over_table(store: Store, chunks: Sequence[ChunkRow]) -> float:
    """Return the cameras' median height over the largest thing that is named a table, world units; 0 for none."""
    things = store.instances.all(structure=False)
    tables = [i for i in things if i.label in _TABLES and i.component == chunks[0].component and not i.dynamic]
    if not tables:
        return 0.0
    largest = max(tables, key=lambda i: float(i.box.size.max()))
    placed = {c.chunk_id for c in chunks}
    rows = sample_of([c for c in store.chunks.all() if c.chunk_id in placed])
    eyes = float(np.median(cameras_of(store, rows).translation[:, 2]))
    return eyes - float(largest.aabb[1, 2])


def _by_names(instances: Sequence[Instance], component: int) -> list[tuple[float, float, str]]:
    """Return what a metre is in world units by each class that has a usual size, from the median of its things.

    More things of a class share what is usual about it, so they are only surer of what was seen. They tell nothing
    where the cameras' height does not: what is named is often a part of a thing, or another one.
    """
    sizes: dict[str, list[float]] = {}
    for i in instances:
        name = i.label or ""
        if i.component == component and name in USUAL_M and np.isfinite(i.box.size).all() and not i.dynamic:
            sizes.setdefault(name, []).append(float(i.box.size.max()))
    out = []
    for name, lengths in sorted(sizes.items()):
        usual, deviation = USUAL_M[name]
        seen = _SEEN / math.sqrt(len(lengths))
        out.append((float(np.median(lengths)) / usual, math.hypot(deviation, seen), f"the size of a {name}"))
    return out
