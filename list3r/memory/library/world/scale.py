"""How long a unit is: metric where a sensor or given poses say so, anchored where an operator knows one length.

Otherwise it is guessed (`guess`), or relative where nothing tells: the length of a unit is unknown.

An anchor is kept as an edit, in metres per unit of one chunk, which nothing changes: whatever later chunks, loops and
sessions do to the graph, the world is scaled so that lengths in that chunk stay what the operator said.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from list3r.memory.core.constraints import Key, standing
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import ChunkRow
from list3r.memory.library.overlap.summaries import cameras_of
from list3r.memory.library.world.guess import GUESS
from list3r.memory.store.store import Store

_WANTED = "give ID=0.095m, ID.height=0.095m, camera_height=1.5m or x,y,z:x,y,z=1.2m"
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "": 1.0}
_SHORTEST_M, _LONGEST_M = 0.002, 1000.0


@dataclass(frozen=True)
class ScaleAnchor:
    """A length that somebody knows."""

    text: str
    """As it was said."""
    metres: float
    kind: str
    """size or height of an instance, camera (the median height of the cameras over the floor), points."""
    instance_id: int = 0
    points_world: Array | None = None
    """Two points, world units as they are now. Shape (2, 3)."""


@dataclass(frozen=True)
class WorldScale:
    """What a unit of the pose graph is."""

    kind: str
    """metric, anchored, guessed or relative."""
    source: str | None
    """Who says so, None to leave what was said."""
    metres: float | None
    """Metres in a unit of the graph; None where it is one unit of the world, as in metric and relative memories."""


@dataclass(frozen=True)
class Lengths:
    """In what lengths of a memory are told."""

    units: str
    """m, or unit where nobody knows a length; one is about a metre where `metric` is guessed."""
    metric: str
    """metric, anchored, guessed or relative."""
    deviation: float | None
    """Of a guessed metre, as a share of it."""

    def __str__(self) -> str:
        """The unit for people."""
        return "about m" if self.metric == "guessed" else self.units


def lengths_of(store: Store) -> Lengths:
    """Return in what lengths are told."""
    kind, guess = store.facts.scale_kind or "relative", store.facts[GUESS]
    deviation = None if guess is None or kind != "guessed" else round(guess.deviation, 3)
    return Lengths("m" if kind in ("metric", "anchored") else "unit", kind, deviation)


@dataclass(frozen=True)
class MeasuredAnchor:
    """What an anchor comes to."""

    length: float
    """World units before."""
    chunk_id: int
    metres_per_unit: float
    """Metres in a unit of that chunk."""
    keys: tuple[Key, ...]
    """The local instances that were measured."""


def parse_anchor(text: str) -> ScaleAnchor:
    """Return an anchor from the user's words; a number without a unit is metres. Raises `OptionError`."""
    what, equals, length = text.replace(" ", "").rpartition("=")
    number = re.fullmatch(r"([0-9.]+(?:e-?[0-9]+)?)(m|cm|mm|)", length)
    try:
        metres = float(number[1]) * _METRES[number[2]] if number else math.nan
    except ValueError:
        metres = math.nan
    if not equals or not math.isfinite(metres):
        raise OptionError(f"anchor {text!r}: {_WANTED}")
    if not _SHORTEST_M <= metres <= _LONGEST_M:
        raise OptionError(f"anchor {text!r}: give a length between {_SHORTEST_M:g} and {_LONGEST_M:g} m")
    if what == "camera_height":
        return ScaleAnchor(text, metres, "camera")
    named = re.fullmatch(r"#?([0-9]{1,18})(\.height)?", what)
    if named:
        return ScaleAnchor(text, metres, "height" if named[2] else "size", int(named[1]))
    points = [_numbers(part) for part in what.split(":")]
    if len(points) != 2 or any(p is None for p in points):
        raise OptionError(f"anchor {text!r}: {_WANTED}")
    return ScaleAnchor(text, metres, "points", points_world=np.array(points, np.float64))


def measure(store: Store, anchor: ScaleAnchor) -> MeasuredAnchor:
    """Return how long the anchor is now. Raises `OptionError` and `UnknownIdError` where it cannot be measured."""
    chunks = main_part(store.chunks.all())
    if not chunks:
        raise OptionError(f"{store.path} has no chunk yet; there is nothing to measure")
    if store.facts.scale_kind == "metric":
        raise OptionError(f"lengths of {store.path} are metres already ({store.facts.scale_source})")
    length, keys = _length(store, anchor, chunks)
    if not (math.isfinite(length) and length > 0):
        raise OptionError(f"anchor {anchor.text!r} has no length in {store.path}; choose another one")
    inside = {c.chunk_id: c for c in chunks}
    chunk = inside.get(min((k for k, _ in keys), default=-1), chunks[0])
    return MeasuredAnchor(length, chunk.chunk_id, anchor.metres / length * float(chunk.S_world_chunk.scale), keys)


def write_scale(store: Store, chunks: list[ChunkRow], S_graph_chunk: Mapping[int, Sim3]) -> Sim3:
    """Write down what kind of scale the memory has; what takes the upright graph to the world. Within `transaction()`.

    `S_graph_chunk` holds the chunks in the frame of the pose graph.
    """
    found = world_scale(store, chunks, S_graph_chunk)
    store.facts.scale_kind = found.kind
    if found.source is not None:
        store.facts.scale_source = found.source
    store.facts.metres_per_graph_unit = found.metres
    return Sim3(np.asarray(1.0 if found.metres is None else found.metres), np.eye(3), np.zeros(3))


def world_scale(store: Store, chunks: list[ChunkRow], S_graph_chunk: Mapping[int, Sim3]) -> WorldScale:
    """Return what a unit of the graph is: by the chunks that are metric, else by the last anchor that stands, else by
    the guess."""
    inside = main_part(chunks)
    metric = [c.chunk_id for c in inside if c.scale_kind == "metric"]
    source = store.facts.scale_source
    if inside and len(metric) == len(inside):
        return WorldScale("metric", None if source not in (None, "none") else "the reconstruction model", None)
    if metric:
        mean = float(np.mean([math.log(float(S_graph_chunk[k].scale)) for k in metric]))
        return WorldScale("metric", f"{len(metric)} of {len(inside)} chunks are metric", math.exp(-mean))
    known = {c.chunk_id for c in inside}
    for edit in reversed(standing(store.edits.all())):
        if edit.kind == "scale" and edit.scale is not None and edit.scale[0] in known:
            chunk_id, metres = edit.scale
            factor = metres / float(S_graph_chunk[chunk_id].scale)
            return WorldScale("anchored", f"{edit.text}, by {edit.author}", factor)
    guess = store.facts[GUESS]
    if guess is not None and inside:
        return WorldScale("guessed", f"a guess, give or take {guess.deviation:.0%}, by {guess.source}", guess.metres)
    return WorldScale("relative", "none", None)


def rescale(store: Store) -> bool:
    """Scale the world by the anchors that stand now, or the guess; nothing where they say what they said before.

    Writes where chunks lie; the library is to be derived again then. Returns whether they lie otherwise.
    """
    chunks = store.chunks.all()
    S_world_graph = store.facts.S_world_graph
    S_graph_world = S_world_graph.inverse()
    grow = write_scale(store, chunks, {c.chunk_id: S_graph_world @ c.S_world_chunk for c in chunks})
    factor = float(grow.scale) / float(S_world_graph.scale)
    if abs(factor - 1.0) < 1e-12:
        return False
    S_new_old = Sim3(np.asarray(factor), np.eye(3), np.zeros(3))
    store.facts.S_world_graph = S_new_old @ S_world_graph
    store.chunks.place(
        {c.chunk_id: S_new_old @ c.S_world_chunk for c in chunks},
        {c.chunk_id: c.component for c in chunks},
        {c.chunk_id: c.covariance for c in chunks if c.covariance is not None},
    )
    return True


def main_part(chunks: list[ChunkRow]) -> list[ChunkRow]:
    """Return the chunks of the part whose unit is the memory's."""
    first = min((c.component for c in chunks), default=0)
    return [c for c in chunks if c.component == first]


def _length(store: Store, anchor: ScaleAnchor, chunks: list[ChunkRow]) -> tuple[float, tuple[Key, ...]]:
    upright = store.facts.gravity != "unknown"
    if anchor.kind == "points":
        assert anchor.points_world is not None
        return float(np.linalg.norm(anchor.points_world[1] - anchor.points_world[0])), ()
    if anchor.kind == "camera":
        estimate = store.facts.gravity_estimate
        if not upright or estimate is None or estimate.floor_height is None:
            raise OptionError(f"{store.path} has no floor to measure camera_height from; anchor an instance by its ID")
        return float(np.median(cameras_of(store, chunks).translation[:, 2])), ()
    instance = store.instances.get(store.ids.resolve(anchor.instance_id))
    if instance.component != chunks[0].component:
        raise OptionError(
            f"#{instance.id} lies in a part of the memory that was never joined to the first one; its size does "
            "not give the scale of that one"
        )
    keys = tuple((o.chunk_id, o.local_id) for o in store.observations.of(instance.id))
    if anchor.kind == "size":
        return float(instance.box.size.max()), keys
    if not upright:
        raise OptionError(f"{store.path} has no known up direction; anchor #{instance.id} by its longest edge")
    return float(instance.aabb[1, 2] - instance.aabb[0, 2]), keys


def _numbers(text: str) -> list[float] | None:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        return None
    return values if len(values) == 3 and all(map(math.isfinite, values)) else None
