"""Relations of instances."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

from list3r.memory.records import Relation
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns
from list3r.memory.store.rows.table import Table
from list3r.memory.store.tables.ids import Ids


class RelationTable:
    """The table of relations. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection, ids: Ids) -> None:
        self._connection = connection
        self._ids = ids
        order, columns = "subject, predicate, object", Columns.of(Relation)
        self._rows = Table(connection, "relations", columns, order, checked=True)
        self._unchecked = Table(connection, "relations", columns, order)

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
        return self._unchecked.among(column, sorted(map(int, ids)), f"predicate IN ({kinds})", predicates)

    def pairs(
        self, predicates: Sequence[str], subjects: Iterable[int] | None, objects: Iterable[int] | None
    ) -> list[tuple[int, int]]:
        """Return the (subject, object) of all relations of some predicates between some instances; None is any, not
        for both.

        What leads to an answer: in a table that is not checked as a whole these rows are not, `among` checks those of
        the answer.
        """
        ends = {c: sorted(map(int, ids)) for c, ids in (("subject", subjects), ("object", objects)) if ids is not None}
        first, *other = sorted(ends, key=lambda column: len(ends[column]))
        among = "IN (SELECT value FROM json_each(?))"
        where = f"{first} {among} AND predicate IN ({','.join('?' * len(predicates))})"
        where += "".join(f" AND +{column} {among}" for column in other)
        arguments = (json.dumps(ends[first]), *predicates, *(json.dumps(ends[column]) for column in other))
        return self._connection.rows(f"SELECT subject, object FROM relations WHERE {where}", arguments)

    def drop(self, instance_id: int) -> None:
        """Forget the relations of an instance."""
        self._rows.delete("subject = ? OR object = ?", (instance_id, instance_id))
