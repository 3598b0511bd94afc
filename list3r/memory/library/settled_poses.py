"""Settled poses: where chunks lie for the purpose of consolidation, with hysteresis. Every chunk that comes moves all
others by a little, and what is derived from a chunk need not be derived again for a millimetre.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import Array, Sim3, stack, take
from list3r.memory.overlap.summaries import ChunkSummary
from list3r.memory.records import ChunkRow
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import SettledRow

_FAR_M = 0.5
"""Chunks whose points lie further apart than this share no instance."""
_TURNED_DEG = 0.5
"""How far chunks may turn in the world before boxes along its axes are derived anew."""
_ATTACHED = 3.0
"""So many times as far may a chunk shift that is redundant as a whole against those that it is like: 12 mm, when
surfaces meet within 30. Only whom it is like follows from where it lies (decision 0172)."""
_FEW = 2
"""Chunks up to which those that moved are derived anew rather than carried."""


@dataclass(frozen=True)
class HysteresisSettings:
    """How far a chunk may move before what was derived from it is derived anew."""

    move_m: float = 0.004
    """A fraction of the noise of depth at arm's length and of the tolerance within which surfaces meet."""
    turn_deg: float = 0.12
    """The same at two metres."""
    scale: float = 0.002


def settle(
    store: Store,
    summaries: Mapping[int, ChunkSummary],
    settings: HysteresisSettings | None = None,
    among: Iterable[int] | None = None,
) -> frozenset[int]:
    """Settle all chunks, or those `among` them, and return those that were settled anew: a chunk keeps its settled pose
    unless it has moved on or belongs to another component.

    Writes to the table `settled`, so that a build that goes on takes up the same poses.
    """
    s = settings or HysteresisSettings()
    chunks = store.chunks.all() if among is None else [store.chunks.get(k) for k in sorted(among)]
    T_graph_world = _world_of_graph(store).inverse()
    before = store.library.settled.all()
    fresh: dict[int, SettledRow] = {}
    for c in chunks:
        S_graph_chunk, row = T_graph_world @ c.S_world_chunk, before.get(c.chunk_id)
        unit = float(S_graph_chunk.scale) * (1.0 if c.scale_kind == "metric" else summaries[c.chunk_id].unit)
        if row is None or row.component != c.component or not _near(row.S_graph_chunk, S_graph_chunk, unit, s):
            fresh[c.chunk_id] = SettledRow(c.component, S_graph_chunk, extent_of(summaries[c.chunk_id], S_graph_chunk))
    if fresh:
        store.library.settled.put(fresh)
    return frozenset(fresh)


def settled_chunks(store: Store) -> list[ChunkRow]:
    """Return all chunks, which must be settled, at their settled poses in the world."""
    T_world_graph, rows = _world_of_graph(store), store.library.settled.all()
    return [replace(c, S_world_chunk=T_world_graph @ rows[c.chunk_id].S_graph_chunk) for c in store.chunks.all()]


def _world_of_graph(store: Store) -> Sim3:
    return store.facts.S_world_graph


def _near(a: Sim3, b: Sim3, unit: float, s: HysteresisSettings) -> bool:
    turn = np.arccos(np.clip((np.trace(a.rotation.T @ b.rotation) - 1.0) / 2.0, -1.0, 1.0))
    moved = float(np.linalg.norm(a.translation - b.translation))
    grown = abs(float(a.scale) / float(b.scale) - 1.0)
    return bool(moved <= s.move_m * unit and np.degrees(turn) <= s.turn_deg and grown <= s.scale)


def extent_of(summary: ChunkSummary, S_graph_chunk: Sim3) -> Array:
    """Return the axis-aligned box of a summary's points in the graph's frame, grown by half of what lies near. Shape
    (2, 3).
    """
    slack = 0.5 * _FAR_M * float(S_graph_chunk.scale) * summary.unit
    if len(summary.shapes.points) == 0:
        return np.array([[np.inf] * 3, [-np.inf] * 3])
    p = S_graph_chunk.apply(summary.shapes.points)
    return np.stack([p.min(axis=0) - slack, p.max(axis=0) + slack])


def neighbours(
    rows: Mapping[int, SettledRow], chunk_id: int, here: SettledRow | None = None, extents: Array | None = None
) -> list[int]:
    """Return ids of the chunks of one component that lie near a chunk, itself among them, in order.

    `here` is where the chunk lies, where that is not what `rows` says; `extents` are those of the rows, (N, 2, 3), for
    who asks often.
    """
    ids = np.fromiter(rows, np.int64, len(rows))
    extents = np.array([r.extent for r in rows.values()]) if extents is None else extents
    here = here or rows[chunk_id]
    meet = np.all((extents[:, 0] <= here.extent[1]) & (extents[:, 1] >= here.extent[0]), axis=1)
    found = [int(k) for k in ids[meet] if rows[int(k)].component == here.component]
    return sorted({chunk_id, *found})


@dataclass(frozen=True)
class CarrySettings:
    """When what was derived of chunks is carried along with them."""

    poses: HysteresisSettings
    """How far two chunks that meet may shift against each other."""
    up_deg: float
    """How far up may turn in a chunk before boxes, and what stands on what, are derived anew."""
    metre: float
    """What a metre is in units of the graph."""
    upright: int | None
    """The component whose z is up; None without one."""


@dataclass(frozen=True)
class Carried:
    """Chunks that lie elsewhere in the world at the end of a session, but to each other as before."""

    rows: Mapping[int, SettledRow]
    """All settled chunks, where they lie now."""
    moves: Mapping[int, Sim3]
    """By chunk, from where it was settled in the world to where it lies now."""
    dirty: frozenset[int]
    """The chunks that lie otherwise to another one, or whose up is another: they are derived anew."""
    before: Mapping[int, SettledRow]
    """Where these lay, carried along with their neighbours."""
    apart: frozenset[tuple[int, int]]
    """Pairs of others that are no longer near each other, for the axes of the graph have turned."""
    together: frozenset[tuple[int, int]]
    """Pairs of others that are near each other for the same reason, and share nothing."""


def carry(store: Store, T_world_graph: Sim3, settings: CarrySettings) -> Carried | None:
    """Return how settled chunks are carried to where they lie now, and which of them lie otherwise to each other.

    `T_world_graph` is the frame in which the library was derived. What is derived of two chunks depends on how they lie
    to each other and on which way is up. So where a walk bends by metres, and neighbours by less than the hysteresis,
    hardly anything is derived anew (decision 0156). Small shifts add up over several ends (`SettledRow.carried`). None
    where a chunk came to another component, and where at most `_FEW` have moved. Writes nothing.
    """
    rows = store.library.settled.all()
    placed = [store.chunks.get(k) for k in rows]
    if any(rows[c.chunk_id].component != c.component for c in placed):
        return None
    ids, extents = np.fromiter(rows, np.int64, len(rows)), np.array([r.extent for r in rows.values()])
    there, world = stack([r.S_graph_chunk for r in rows.values()]), stack([c.S_world_chunk for c in placed])
    here = _world_of_graph(store).inverse() @ world
    by, moves = here @ there.inverse(), world @ (T_world_graph @ there).inverse()
    frames = stack([T_world_graph]), stack([_world_of_graph(store)])
    if _stirred(there, here, settings).sum() <= _FEW and not _stirred(*frames, settings).any():
        return None
    attached = np.isin(ids, list(store.library.redundant.chunks()))
    pairs = np.searchsorted(ids, np.array(_compared(store, rows), np.int64).reshape(-1, 2))
    upright = np.array([c.component == settings.upright for c in placed])
    shifted = _shifted(by, moves, extents, pairs, (upright, attached), settings.metre)
    slack = np.array([r.carried for r in rows.values()]) + shifted
    most = np.array([settings.poses.move_m, settings.poses.turn_deg, settings.up_deg, _TURNED_DEG])
    most = most * np.where(attached[:, None], [_ATTACHED, _ATTACHED, 1.0, 1.0], 1.0)
    others = (slack > most).any(axis=1) | (np.abs(by.scale - 1.0) > settings.poses.scale)
    boxes = carried_boxes(by, extents)
    apart, together, strange = _near_otherwise(store, ids, by, (extents, boxes), settings.metre)
    others |= np.isin(ids, list(strange))
    dirty = frozenset(ids[others].tolist())
    chunks = [(n, k, rows[k].component) for n, k in enumerate(ids.tolist())]
    beside = _beside(pairs, others)
    return Carried(
        rows={k: SettledRow(part, take(here, n), boxes[n], slack[n]) for n, k, part in chunks},
        moves={k: take(moves, n) for n, k, _ in chunks},
        dirty=dirty,
        before={
            k: SettledRow(part, (S := take(by, beside[n])) @ take(there, n), carried_boxes(S, extents[n]))
            for n, k, part in chunks
            if k in dirty
        },
        apart=frozenset(p for p in apart if dirty.isdisjoint(p)),
        together=frozenset(p for p in together if dirty.isdisjoint(p)),
    )


def carried_boxes(S: Sim3, boxes: Array) -> Array:
    """Return the boxes round boxes that were carried along, each by its own similarity. Shape (..., 2, 3)."""
    known: NDArray[np.bool_] = np.asarray(np.isfinite(boxes).all(axis=(-1, -2)))[..., None]
    some = np.where(known[..., None], boxes, 0.0)
    middle, half = some.mean(axis=-2), np.ptp(some, axis=-2) / 2.0
    reach = np.asarray(S.scale)[..., None] * (np.abs(S.rotation) @ half[..., None])[..., 0]
    there = S.apply(middle[..., None, :])[..., 0, :]
    return np.where(known[..., None], np.stack([there - reach, there + reach], axis=-2), boxes)


def _stirred(a: Sim3, b: Sim3, settings: CarrySettings) -> NDArray[np.bool_]:
    """Return of which poses one is further from the other than the hysteresis. Shape (N,)."""
    s = settings.poses
    cosine = (np.einsum("nij,nij->n", a.rotation, b.rotation) - 1.0) / 2.0
    turned = _degrees(cosine) > s.turn_deg
    moved = np.linalg.norm(a.translation - b.translation, axis=1) > s.move_m * settings.metre
    return np.asarray(moved | turned | (np.abs(a.scale / b.scale - 1.0) > s.scale))


def _compared(store: Store, rows: Mapping[int, SettledRow]) -> list[tuple[int, int]]:
    """Return the pairs of settled chunks of which one was compared with the other."""
    found = {(u, v) for u, v in store.library.overlaps.pairs(list(rows)) if u < v}
    found |= {(min(p), max(p)) for p in store.library.redundant.compared() if p[0] != p[1]}
    return sorted(p for p in found if p[0] in rows and p[1] in rows)


def _shifted(
    by: Sim3,
    moves: Sim3,
    extents: Array,
    pairs: NDArray[np.int64],
    kinds: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    metre: float,
) -> Array:
    """Return how far chunks shift and turn at most against one that they were compared with, how far their up turns,
    and they themselves, metres and degrees. Shape (N, 4).

    `kinds` are the chunks that stand upright, and those that are redundant as a whole, (N,) each: nothing of another
    one follows from where these lie.
    """
    (upright, attached), out = kinds, np.zeros((len(extents), 4))
    shift, turn = _between(by, extents, pairs)
    for column, other in (pairs.T, pairs.T[::-1]):
        told = attached[column] | ~attached[other]
        np.maximum.at(out[:, 0], column[told], shift[told] / metre)
        np.maximum.at(out[:, 1], column[told], turn[told])
    out[:, 2] = np.where(upright, _degrees(moves.rotation[:, 2, 2]), 0.0)
    out[:, 3] = _degrees((np.trace(moves.rotation, axis1=1, axis2=2) - 1.0) / 2.0)
    return out


def _degrees(cosine: Array) -> Array:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _between(by: Sim3, extents: Array, pairs: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return how far two chunks are carried otherwise: in the middle of what they share, units of the graph, and by
    what angle, degrees. Shape (P,) each.
    """
    u, v = pairs.T
    low, high = np.maximum(extents[u, 0], extents[v, 0]), np.minimum(extents[u, 1], extents[v, 1])
    middle = np.nan_to_num((low + high) / 2.0, posinf=0.0, neginf=0.0)[:, None]
    shift = np.linalg.norm(take(by, u).apply(middle) - take(by, v).apply(middle), axis=-1)[:, 0]
    cosine = (np.einsum("nij,nij->n", by.rotation[u], by.rotation[v]) - 1.0) / 2.0
    return shift, _degrees(cosine)


def _near_otherwise(
    store: Store, ids: NDArray[np.int64], by: Sim3, boxes: tuple[Array, Array], metre: float
) -> tuple[set[tuple[int, int]], set[tuple[int, int]], set[int]]:
    """Return the pairs of chunks that are no longer near, those that have come to be near and share nothing, and the
    chunks of all other pairs of which either is true. `boxes` are the extents of the chunks before and now.
    """
    rows, redundant = store.library.settled.all(), store.library.redundant.chunks()
    near = {k: SettledRow(rows[k].component, rows[k].S_graph_chunk, boxes[1][n]) for n, k in enumerate(ids.tolist())}
    near = {k: row for k, row in near.items() if k not in redundant}
    extents = np.array([r.extent for r in near.values()]).reshape(-1, 2, 3)
    now = {(k, n) for k in near for n in neighbours(near, k, extents=extents) if n > k}
    before = {(u, v) for u, v in store.library.overlaps.pairs(list(near)) if u < v and u in near and v in near}
    apart, together = before - now, sorted(now - before)
    strange = {k for p in apart if store.library.overlaps.get(p) for k in p}
    shift, _ = _between(by, boxes[0], np.searchsorted(ids, np.array(together, np.int64).reshape(-1, 2)))
    far = shift > 0.5 * _FAR_M * metre
    strange |= {k for p, shifted in zip(together, far.tolist(), strict=True) if shifted for k in p}
    return apart, set(together), strange


def _beside(pairs: NDArray[np.int64], others: NDArray[np.bool_]) -> dict[int, int]:
    """Return by position of each of some chunks the nearest in order that it was compared with and is none of them,
    else its own.
    """
    out = {n: n for n in np.flatnonzero(others).tolist()}
    for u, v in (*pairs.tolist(), *pairs[:, ::-1].tolist()):
        if others[u] and not others[v] and (out[u] == u or abs(v - u) < abs(out[u] - u)):
            out[u] = v
    return out
