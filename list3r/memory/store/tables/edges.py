"""Relations of chunks: how they were measured to lie to each other."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from list3r.memory.records import (
    Edge,
)
from list3r.memory.store.codec import (
    pack_sim3,
    to_json,
)
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.rows import (
    f8,
    read_edge,
)
from list3r.memory.store.tables.bends import BendVerbs


class EdgeVerbs(BendVerbs):
    """Writing and reading how chunks lie to each other. Writing verbs are called inside `transaction()`."""

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        super().__init__(path, database, lock)
        self._edge_version = -1
        self._edge_rows: dict[tuple[int, int, str, int, int], Edge] | None = None

    def forget_rows(self) -> None:
        """Read again when they are next asked for what was kept of rows."""
        self._edge_rows = None

    def add_edges(self, edges: Iterable[Edge]) -> None:
        """Store measured relations of chunks; one measured again replaces the old one."""
        known = self._known_edges()
        fresh = list(edges)
        self._database.executemany(
            "INSERT OR REPLACE INTO edges (u, v, kind, frame_u, frame_v, S_v_u, confidence, weight, inliers,"
            " residual_m, accepted, reason, scores, covariance) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                (
                    e.u,
                    e.v,
                    e.kind,
                    *(e.frames or (-1, -1)),
                    pack_sim3(e.S_v_u),
                    e.confidence,
                    e.weight,
                    e.inliers,
                    e.residual_m,
                    int(e.accepted),
                    e.reason,
                    to_json(e.scores),
                    None if e.covariance is None else f8(e.covariance),
                )
                for e in fresh
            ],
        )
        for e in fresh:
            key = (e.u, e.v, e.kind, *(e.frames or (-1, -1)))
            known |= self._read_edges("WHERE u = ? AND v = ? AND kind = ? AND frame_u = ? AND frame_v = ?", key)
        self._edge_rows = dict(sorted(known.items()))

    def edges(self) -> list[Edge]:
        """All measured relations of chunks, accepted or not."""
        return list(self._known_edges().values())

    def _known_edges(self) -> dict[tuple[int, int, str, int, int], Edge]:
        """All edges by key and in order, read again only when another process or a rollback may have changed them."""
        version = int(self._rows("PRAGMA data_version")[0][0])
        if self._edge_rows is None or self._edge_version != version:
            self._edge_rows, self._edge_version = self._read_edges(), version
        return self._edge_rows

    def _read_edges(self, where: str = "", key: tuple[Any, ...] = ()) -> dict[tuple[int, int, str, int, int], Edge]:
        query = (
            "SELECT u, v, kind, S_v_u, confidence, weight, inliers, residual_m, accepted, reason, scores, frame_u,"
            f" frame_v, covariance FROM edges {where} ORDER BY u, v, kind, frame_u, frame_v"
        )
        return {(r[0], r[1], r[2], r[11], r[12]): read_edge(r) for r in self._rows(query, key)}
