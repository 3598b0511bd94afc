"""What detectors saw of local instances, and the labels that instances have from it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from list3r.memory.core.records import DetectedLabel, Votes
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns, nested
from list3r.memory.store.rows.table import Table


@dataclass(frozen=True)
class _Vote:
    chunk_id: int
    local_id: int
    source: str
    votes: Votes


@dataclass(frozen=True)
class _Detected:
    instance: int
    label: DetectedLabel


class LabelVotes:
    """The table of votes. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        columns = Columns.of(_Vote, nested("votes", Columns.of(Votes)))
        self._rows = Table(connection, "votes", columns, "chunk_id, local_id, source")

    def put(self, chunk_id: int, source: str, votes: Mapping[int, Votes]) -> None:
        """Keep what a source saw of a chunk, by local id, instead of what the same one saw before."""
        self._rows.delete("chunk_id = ? AND source = ?", (chunk_id, source))
        self._rows.put(_Vote(chunk_id, n, source, found) for n, found in sorted(votes.items()))

    def of(self, chunk_id: int) -> dict[str, dict[int, Votes]]:
        """Return by source its votes by local id; nothing where none saw anything in the chunk."""
        out: dict[str, dict[int, Votes]] = {}
        for row in self._rows.all("chunk_id = ?", (chunk_id,)):
            out.setdefault(row.source, {})[row.local_id] = row.votes
        return out


class DetectedLabels:
    """The table of labels that instances have from detectors. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        columns = Columns.of(_Detected, nested("label", Columns.of(DetectedLabel)))
        self._rows = Table(connection, "detected_labels", columns, "instance")

    def all(self) -> dict[int, DetectedLabel]:
        """Return the labels that instances have from detectors and discoverers, by id."""
        return {row.instance: row.label for row in self._rows.all()}

    def of(self, ids: Collection[int]) -> dict[int, DetectedLabel]:
        """Return those of some instances, by id."""
        return {row.instance: row.label for row in self._rows.among("instance", ids)}

    def replace(self, labels: Mapping[int, DetectedLabel], ids: Collection[int] | None = None) -> None:
        """Write the labels of some instances, or of all; those of them that have none lose what they had."""
        before = self.all() if ids is None else self.of(ids)
        for n in sorted(before.keys() - labels.keys()):
            self.drop(n)
        self._rows.put(_Detected(n, label) for n, label in sorted(labels.items()) if before.get(n) != label)

    def drop(self, instance_id: int) -> None:
        """Forget the label of an instance."""
        self._rows.delete("instance = ?", (instance_id,))
