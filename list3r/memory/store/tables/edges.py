"""How chunks were measured to lie to each other, and how each of them bends."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.bends import Bend
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import Edge
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns, joined
from list3r.memory.store.rows.table import Table

_NO_FRAMES = (-1, -1)
_FRAMES = joined(
    ("frame_u", "frame_v"),
    ("frames",),
    lambda frames: frames or _NO_FRAMES,
    lambda u, v: (None if u < 0 else (u, v),),
)
_Key = tuple[int, int, str, int, int]


class Edges:
    """The table of edges. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._rows = Table(connection, "edges", Columns.of(Edge, _FRAMES), "u, v, kind, frame_u, frame_v")
        self._version = -1
        self._known: dict[_Key, Edge] | None = None
        connection.on_forget(self._forget)

    def add(self, edges: Iterable[Edge]) -> None:
        """Store measured edges; one measured again replaces the old one."""
        known, fresh = self._by_key(), list(edges)
        self._rows.put(fresh)
        if len(fresh) > len(known) // 4:
            self._known = None
            return
        condition = "u = ? AND v = ? AND kind = ? AND frame_u = ? AND frame_v = ?"
        known |= {_key(e): e for key in map(_key, fresh) for e in self._rows.all(condition, key)}
        self._known = dict(sorted(known.items()))

    def all(self) -> list[Edge]:
        """Return all measured edges, accepted or not."""
        return list(self._by_key().values())

    def _by_key(self) -> dict[_Key, Edge]:
        """All edges by key and in order, read again only when another process or a rollback may have changed them."""
        version = self._connection.data_version
        if self._known is None or self._version != version:
            self._known, self._version = {_key(e): e for e in self._rows.all()}, version
        return self._known

    def _forget(self) -> None:
        self._known = None


def _key(edge: Edge) -> _Key:
    return edge.u, edge.v, edge.kind, *(edge.frames or _NO_FRAMES)


@dataclass(frozen=True)
class _BendRow:
    chunk_id: int
    bend: Bend


_BEND = joined(
    ("frames", "twists"),
    ("bend",),
    lambda bend: (_doubles(bend.frames), _doubles(bend.twists)),
    lambda frames, twists: (_bend(frames, twists),),
)


class Bends:
    """The table of bends: one small row for each chunk that bends, written when a session is finished."""

    def __init__(self, connection: Connection) -> None:
        self._rows = Table(connection, "bends", Columns.of(_BendRow, _BEND), "chunk_id")

    def replace(self, bends: Mapping[int, Bend]) -> None:
        """Replace what is known of how chunks bend, by chunk id; call inside `transaction()`."""
        self._rows.delete()
        self._rows.put(_BendRow(k, bend) for k, bend in sorted(bends.items()))

    def all(self) -> dict[int, Bend]:
        """Return the bends by chunk id; a chunk that is not in it is rigid. Raises `MemoryFileError`."""
        return {row.chunk_id: row.bend for row in self._rows.all()}


def _doubles(values: NDArray[np.float64]) -> bytes:
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def _bend(frames: bytes, twists: bytes) -> Bend:
    at, x = np.frombuffer(frames, "<f8"), np.frombuffer(twists, "<f8").reshape(-1, 7)
    if len(at) != len(x) or not len(at) or not np.isfinite(at).all() or not np.isfinite(x).all():
        raise MemoryFileError("the motion inside a chunk (bends) is damaged; run `list3r verify`")
    return Bend(at, x)
