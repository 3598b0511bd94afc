"""The merge log by number, and the edits of operators: appended, never rewritten."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from list3r.memory.core.constraints import Constraints, Edit, Key
from list3r.memory.core.records import MergeDecision
from list3r.memory.core.unpacking import parse_json
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.codec import to_json
from list3r.memory.store.rows.columns import Columns, joined, nested
from list3r.memory.store.rows.json_values import plain
from list3r.memory.store.rows.table import Table

EDIT_KINDS = ("merge", "split", "label", "delete", "scale", "room", "undo")


@dataclass(frozen=True)
class LogEntry:
    """One line of the merge log."""

    entry: int
    """Its number."""
    chunk_id: int
    """The last chunk then."""
    decision: MergeDecision


class MergeLog:
    """The table of merges. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        columns = Columns.of(LogEntry, nested("decision", Columns.of(MergeDecision)))
        self._rows = Table(connection, "merges", columns, "entry")

    def add(self, chunk_id: int, decision: MergeDecision) -> int:
        """Append one line; its number."""
        return self._rows.add(LogEntry(0, chunk_id, decision), entry=None)

    def add_all(self, chunk_id: int, decisions: Iterable[MergeDecision]) -> None:
        """Append what was decided when a chunk arrived."""
        self._rows.add_all((LogEntry(0, chunk_id, d) for d in decisions), entry=None)

    def all(self) -> list[LogEntry]:
        """Return the log with its numbers, oldest first."""
        return self._rows.all()

    def decisions(self) -> list[MergeDecision]:
        """Return the decisions of the log, oldest first."""
        return [entry.decision for entry in self._rows.all()]

    def has_decided(self, kind: str, a: str, b: str) -> bool:
        """Return whether the log holds a decision of this kind on these two."""
        query = "SELECT 1 FROM merges WHERE a = ? AND b = ? AND kind = ? LIMIT 1"
        return bool(self._connection.rows(query, (a, b, kind)))


class Edits:
    """The table of edits. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._rows = Table(connection, "edits", Columns.of(Edit, _ARGUMENTS), "entry")

    def add(self, edit: Edit) -> None:
        """Append an edit."""
        self._rows.add(edit)

    def all(self) -> list[Edit]:
        """Return all edits, oldest first, those that were taken back among them."""
        return self._rows.all()

    def constraints(self) -> Constraints:
        """Return what the edits that stand come to."""
        return Constraints.of(self.all())


_FIELDS = ("kind", "parts", "through", "before", "text", "target", "scale")


def _pack(kind: str, *values: object) -> tuple[str, str]:
    fields = dict(zip(_FIELDS[1:], map(plain, values), strict=True))
    if fields["scale"] is None:
        del fields["scale"]
    return kind, to_json(fields)


def _unpack(kind: str, arguments: str) -> tuple[object, ...]:
    fields = parse_json(arguments)
    parts = tuple(_keys(part) for part in fields["parts"])
    if kind not in EDIT_KINDS or (kind in ("merge", "split") and len(parts) != 2):
        raise ValueError(f"{kind} of {len(parts)} parts")
    before = tuple((int(n), label, _keys(keys)) for n, label, keys in fields["before"])
    scale = None if fields.get("scale") is None else (int(fields["scale"][0]), float(fields["scale"][1]))
    return kind, parts, int(fields["through"]), before, fields["text"], fields["target"], scale


def _keys(pairs: Any) -> tuple[Key, ...]:
    return tuple((int(chunk), int(local)) for chunk, local in pairs)


_ARGUMENTS = joined(("kind", "arguments"), _FIELDS, _pack, _unpack)
