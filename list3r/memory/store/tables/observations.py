"""Observations: which local instances make up which instance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from list3r.memory.core.records import Observation
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns
from list3r.memory.store.rows.table import Table, batches
from list3r.memory.store.tables.ids import Ids


class Observations:
    """The table of observations. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection, ids: Ids) -> None:
        self._connection = connection
        self._ids = ids
        columns = Columns.of(Observation, instance_id="instance")
        self._rows = Table(connection, "observations", columns, "chunk_id, local_id")

    def set(self, observations: Iterable[Observation]) -> None:
        """Say which instance each local instance belongs to."""
        self._rows.put(observations)

    def clear(self) -> None:
        """Forget which instance each local instance belongs to, before all of it is said again."""
        self._rows.delete()

    def forget(self, keys: Iterable[tuple[int, int]]) -> None:
        """Forget which instances these local instances (chunk id, local id) belong to."""
        statement = "DELETE FROM observations WHERE chunk_id = ? AND local_id = ?"
        self._connection.execute_many(statement, list(keys))

    def all(self) -> list[Observation]:
        """Return all observations in order of chunks and local ids."""
        return self._rows.all()

    def of(self, instance_id: int) -> list[Observation]:
        """Return the local instances that make up an instance, which may be an alias. Raises `UnknownIdError`."""
        return self._rows.all("instance = ?", (self._ids.resolve(instance_id),))

    def chunks_of(self, ids: Sequence[int]) -> list[tuple[int, int]]:
        """Return (instance id, chunk id) of the chunks that see some instances, in order."""
        query = "SELECT DISTINCT instance, chunk_id FROM observations WHERE instance IN ({})"
        return sorted(row for part, marks in batches(ids) for row in self._connection.rows(query.format(marks), part))

    def owners(self, keys: Sequence[tuple[int, int]]) -> dict[tuple[int, int], int]:
        """Return the instances of these local instances (chunk id, local id) that belong to one."""
        wanted = set(keys)
        rows = self._rows.among("chunk_id", sorted({int(k) for k, _ in keys}))
        return {(o.chunk_id, o.local_id): o.instance_id for o in rows if (o.chunk_id, o.local_id) in wanted}
