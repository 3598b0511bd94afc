"""Relations of instances."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.records import Relation
from list3r.memory.store.connection import Connection
from list3r.memory.store.derived import CurrentCache
from list3r.memory.store.rows.columns import Columns
from list3r.memory.store.rows.table import Table
from list3r.memory.store.tables.ids import Ids

_KEPT_BYTES = 8_000_000
"""Of relations of many instances that were asked for last."""


class RelationTable:
    """The table of relations. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection, ids: Ids) -> None:
        self._connection = connection
        self._ids = ids
        self._rows = Table(connection, "relations", Columns.of(Relation), "subject, predicate, object")
        self._kept: CurrentCache[tuple[str, str, tuple[str, ...]], NDArray[np.int64]] = CurrentCache(
            connection.stamp, _KEPT_BYTES, lambda pairs: pairs.nbytes
        )

    def replace(self, subjects: Iterable[int] | None, relations: Iterable[Relation]) -> None:
        """Replace all relations that touch these instances (all relations when `subjects` is None)."""
        if subjects is None:
            self._rows.delete()
        else:
            ids = [(int(i),) for i in subjects]
            self._connection.execute_many("DELETE FROM relations WHERE subject = ?", ids)
            self._connection.execute_many("DELETE FROM relations WHERE object = ?", ids)
        self._rows.put(relations)

    def all(
        self, subject: int | None = None, predicate: str | None = None, object: int | None = None
    ) -> list[Relation]:
        """Return the relations that match what is given; ids may be aliases."""
        wanted: dict[str, int | str] = {}
        for column, value in (("subject", subject), ("object", object)):
            if value is not None:
                wanted[column] = self._ids.resolve(value)
        if predicate is not None:
            wanted["predicate"] = predicate
        return self._rows.all(" AND ".join(f"{column} = ?" for column in wanted), tuple(wanted.values()))

    def among(self, ids: Iterable[int], predicates: Sequence[str], *, as_object: bool) -> list[Relation]:
        """Return the relations of some predicates in which some instances are the subject, or the object."""
        column, kinds = "object" if as_object else "subject", ",".join("?" * len(predicates))
        return self._rows.among(column, sorted(map(int, ids)), f"predicate IN ({kinds})", predicates)

    def pairs(
        self, predicates: Sequence[str], subjects: Iterable[int] | None, objects: Iterable[int] | None
    ) -> list[tuple[int, int]]:
        """Return the (subject, object) of all relations of some predicates between some instances; None is any, not
        for both.

        What leads to an answer: in a table that is not checked as a whole these rows are not, `among` checks those of
        the answer.
        """
        given = (("subject", subjects), ("object", objects))
        ends = {column: np.sort(np.fromiter(ids, np.int64)) for column, ids in given if ids is not None}
        first, *other = sorted(ends, key=lambda column: len(ends[column]))
        found = self._pairs_of(first, json.dumps(ends[first].tolist()), tuple(predicates))
        for column in other:
            found = found[np.isin(found[:, ("subject", "object").index(column)], ends[column])]
        return list(zip(*found.T.tolist(), strict=True))

    def _pairs_of(self, column: str, ids: str, predicates: tuple[str, ...]) -> NDArray[np.int64]:
        """Return what `pairs` does for one end, whose `ids` are a list in JSON; kept while the file stays as it is.

        An id has few relations: reading them all costs less than looking each predicate up. Shape (N, 2).
        """
        query = (
            f"SELECT subject, object FROM relations WHERE {column} IN (SELECT value FROM json_each(?))"
            f" AND +predicate IN ({','.join('?' * len(predicates))})"
        )

        def read() -> NDArray[np.int64]:
            return np.array(self._connection.rows(query, (ids, *predicates)), np.int64).reshape(-1, 2)

        return self._kept.get((column, ids, predicates), read)

    def drop(self, instance_id: int) -> None:
        """Forget the relations of an instance."""
        self._rows.delete("subject = ? OR object = ?", (instance_id, instance_id))
