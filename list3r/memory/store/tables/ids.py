"""Ids of instances: what an id stands for today, and which were ever given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from list3r.memory.core.constraints import standing
from list3r.memory.core.errors import UnknownIdError
from list3r.memory.core.records import FIRST_SCRAP
from list3r.memory.store.connection import Connection
from list3r.memory.store.facts import Facts
from list3r.memory.store.rows.columns import Columns
from list3r.memory.store.rows.table import Table
from list3r.memory.store.tables.edits import Edits


@dataclass(frozen=True)
class _Alias:
    id: int
    instance: int


class Ids:
    """The table of aliases beside the ids of instances. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection, facts: Facts) -> None:
        self._connection = connection
        self._facts = facts
        self._aliases = Table(connection, "aliases", Columns.of(_Alias), "id")

    def resolve(self, instance_id: int) -> int:
        """Return the id that stands for an id today.

        Raises `UnknownIdError` for an id the memory has never held, and for one that was deleted, saying so.
        """
        wanted = int(instance_id) if 0 < instance_id < 2**63 else -1
        seen = set()
        current = wanted
        while current not in seen:
            seen.add(current)
            if self._connection.rows("SELECT 1 FROM instances WHERE id = ?", (current,)):
                return current
            target = self._aliases.first("id = ?", (current,))
            current = current if target is None else target.instance
        path, entry = self._connection.path, self._deletion_of(wanted)
        if entry is not None:
            raise UnknownIdError(f"#{wanted} was deleted; `list3r edit undo {path} {entry}` brings it back")
        raise UnknownIdError(f"{path} has no instance {instance_id}; `list3r list {path}` shows the ids")

    def next(self) -> int:
        """Return the smallest id that was never used; ids are not used again."""
        query = "SELECT max((SELECT coalesce(max(id), 0) FROM instances), (SELECT coalesce(max(id), 0) FROM aliases))"
        return max(int(self._connection.rows(query)[0][0]), self._facts.last_id) + 1

    def largest(self) -> int:
        """Return the largest id that an instance has now, scraps apart, 0 without any: about how many there are."""
        query = "SELECT coalesce(max(id), 0) FROM instances WHERE id < ?"
        return int(self._connection.rows(query, (FIRST_SCRAP,))[0][0])

    def sample(self, count: int) -> list[int]:
        """Return about `count` ids, ascending, spread evenly over those given so far."""
        last = self.largest()
        step = max(1, last // max(count, 1))
        query = (
            "WITH RECURSIVE starts(x) AS (SELECT 0 UNION ALL SELECT x + ?1 FROM starts WHERE x + ?1 <= ?2)"
            " SELECT DISTINCT (SELECT id FROM instances WHERE id >= x ORDER BY id LIMIT 1) FROM starts"
        )
        return [int(row[0]) for row in self._connection.rows(query, (step, last)) if row[0] is not None]

    def aliases(self) -> dict[int, int]:
        """Return every retired id and the id it was merged into."""
        return {a.id: a.instance for a in self._aliases.all()}

    def aliases_of(self, instance_id: int) -> list[int]:
        """Return the retired ids that stand for an instance today."""
        older: dict[int, list[int]] = {}
        for old, new in self.aliases().items():
            older.setdefault(new, []).append(old)
        found, waiting = set[int](), [instance_id]
        while waiting:
            fresh = [n for n in older.get(waiting.pop(), []) if n not in found]
            found.update(fresh)
            waiting += fresh
        return sorted(found)

    def add_aliases(self, aliases: Mapping[int, int]) -> None:
        """Let ids resolve to others."""
        self._aliases.put(_Alias(n, into) for n, into in sorted(aliases.items()))

    def drop_revived_aliases(self) -> None:
        """Take out the aliases whose ids name an instance again."""
        self._aliases.delete("id IN (SELECT id FROM instances)")

    def _deletion_of(self, instance_id: int) -> int | None:
        """The standing edit that deleted an instance, by any id that it ever had."""
        aliases = self.aliases()
        names = {instance_id}
        while aliases.get(instance_id, instance_id) not in names:
            instance_id = aliases[instance_id]
            names.add(instance_id)
        deletions = [e for e in standing(Edits(self._connection).all()) if e.kind == "delete"]
        return next((e.entry for e in deletions if any(n in names for n, _, _ in e.before)), None)
