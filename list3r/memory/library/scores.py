"""How local instances of two chunks overlap, kept by what the chunks measured and how they lie to each other.

The pose of one chunk in the other is rounded to the tolerance, and overlaps are those of the rounded pose. So they do
not depend on when they were computed, and a chunk that trembles keeps them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import Sim3, rotation_exp, rotation_log, stack, take
from list3r.memory.library.change.detection import ChangeSettings, across_sessions
from list3r.memory.library.change.free_space_carving import FreeSpaceCarving
from list3r.memory.library.merging.movers import without_moving
from list3r.memory.library.overlap.pair_scores import PairScores, pair_scores
from list3r.memory.library.overlap.summaries import Summaries
from list3r.memory.library.overlap.voxels import GrownCells
from list3r.memory.store.store import Store
from list3r.memory.store.tables.pair_scores import StoredScores

Pair = tuple[int, int]
_SCORES = np.dtype(
    [("i", "<i4"), ("j", "<i4"), ("i_on_j", "<f8"), ("j_on_i", "<f8"), ("shared", "<i4"), ("frame_iou", "<f8")]
)


@dataclass(frozen=True)
class RoundingSettings:
    """How exactly the pose of one chunk in another is taken."""

    move_m: float = 0.004
    """A fraction of the noise of depth at arm's length and of the tolerance within which surfaces meet."""
    turn_deg: float = 0.12
    """The same at two metres."""
    scale: float = 0.002


class PairScoreCache:
    """The overlaps of pairs of chunks as they lie now, computed where they are not kept."""

    def __init__(
        self, store: Store, summaries: Summaries, settings: tuple[RoundingSettings, ChangeSettings, object]
    ) -> None:
        """`settings` are those of rounding, of changes, and of shapes."""
        self._store, self._summaries = store, summaries
        self._rounding, self._changes, _ = settings
        self._settings = repr(settings).encode()
        self._carving = FreeSpaceCarving(store, self._changes.visibility)
        self._rounded: dict[Pair, tuple[Sim3, bytes]] = {}
        self._kept: dict[Pair, StoredScores] = {}
        self._known: dict[Pair, PairScores] = {}
        self._fresh: dict[Pair, StoredScores] = {}

    def prepare(self, pairs: Sequence[Pair], *, every: bool = False) -> None:
        """Round the poses of pairs of chunks, u <= v, and read what is kept of them; with `every`, of all there are."""
        rounded, chunks, s = self._rounded, self._store.chunks, self._rounding
        missing = [p for p in pairs if p not in rounded]
        if not missing:
            return
        known = {
            k: (self._summaries[k].unit, self._summaries[k].digest) for k in sorted({k for p in missing for k in p})
        }
        u, v = (stack([chunks.get(p[n]).S_world_chunk for p in missing]) for n in (0, 1))
        S_u_v = u.inverse() @ v
        unit = np.array([known[k][0] for k, _ in missing])
        steps = np.column_stack([*[s.move_m * unit] * 3, *[np.full(len(unit), np.radians(s.turn_deg))] * 3])
        steps = np.column_stack([steps, np.full(len(unit), s.scale)])
        exact = np.column_stack([S_u_v.translation, rotation_log(S_u_v.rotation), np.log(S_u_v.scale)])
        exact[[k == m for k, m in missing]] = 0.0
        place = np.rint(exact / steps).astype(np.int64)
        near = place * steps
        poses = Sim3(np.exp(near[:, 6]), rotation_exp(near[:, 3:6]), near[:, :3])
        for n, p in enumerate(missing):
            digests = (known[k][1] for k in p)
            parts = (*digests, place[n].tobytes(), steps[n].tobytes(), self._settings)
            rounded[p] = take(poses, n), hashlib.blake2b(b"".join(parts), digest_size=16).digest()
        table = self._store.pair_scores
        rows = table.all() if every else [row for p in missing if (row := table.get(*p)) is not None]
        self._kept |= {(row.u, row.v): row for row in rows}

    def of(self, u: int, v: int) -> PairScores:
        """Return how two chunks overlap, u <= v, without what moves, and without what plainly is two instances of two
        sessions at one place.
        """
        if (u, v) not in self._known:
            self.prepare([(u, v)])
            (rounded, stamp), kept = self._rounded[u, v], self._kept.get((u, v))
            if kept is None or kept.stamp != stamp:
                found = self._computed(u, v, rounded)
                self._fresh[u, v] = StoredScores(u, v, stamp, pack_scores(found))
            else:
                found = self._read(kept)
            self._known[u, v] = found
        return self._known[u, v]

    def write(self, *, every: bool = False) -> None:
        """Keep what was computed; where `every` pair that matters was asked for, the others are forgotten. Call inside
        `transaction()`.
        """
        table = self._store.pair_scores
        table.put(self._fresh[p] for p in sorted(self._fresh))
        self._fresh.clear()
        if every:
            table.drop(p for p in table.pairs() if p not in self._known)

    def _computed(self, u: int, v: int, S_u_v: Sim3) -> PairScores:
        summaries = {k: self._summaries[k] for k in (u, v)}
        shapes = {k: x.shapes for k, x in summaries.items()}
        p = pair_scores(shapes[u], shapes[v], S_u_v, self._store.derived.of(GrownCells))
        motions = {(k, n): track for k, x in summaries.items() for n, track in x.motions.items()}
        known = without_moving({(u, v): p}, shapes, motions)
        lie = {v: S_u_v, u: Sim3.identity()}
        return across_sessions(known, shapes, lie, self._carving, self._changes)[u, v]

    def _read(self, kept: StoredScores) -> PairScores:
        """Return the scores of a pair of chunks. Raises `MemoryFileError` where they name what is not there."""
        p, file = unpack_scores(kept.scores), self._store.path
        for chunk_id, rows in ((kept.u, p.i), (kept.v, p.j)):
            count = len(self._summaries[chunk_id].shapes.local_id)
            if len(rows) and not 0 <= rows.min() <= rows.max() < count:
                raise MemoryFileError(
                    f"overlaps of chunks {kept.u} and {kept.v} name local instances that chunk {chunk_id} does not "
                    f"have; run `list3r verify {file}`, `list3r repair {file}` saves what is sound"
                )
        return p


def pack_scores(p: PairScores) -> bytes:
    """Return scores of a pair of chunks as one blob."""
    out: NDArray[np.void] = np.zeros(len(p.i), _SCORES)
    for name in _SCORES.names or ():
        out[name] = getattr(p, name)
    return out.tobytes()


def unpack_scores(blob: bytes) -> PairScores:
    """Return the inverse of `pack_scores`. Raises `MemoryFileError` for a blob of another length."""
    if len(blob) % _SCORES.itemsize:
        raise MemoryFileError(f"overlaps: {len(blob)} bytes do not hold whole scores; run `list3r verify` on the file")
    found = np.frombuffer(blob, _SCORES)
    i, j, shared = (found[name].astype(np.int64) for name in ("i", "j", "shared"))
    return PairScores(i, j, found["i_on_j"].copy(), found["j_on_i"].copy(), shared, found["frame_iou"].copy())
