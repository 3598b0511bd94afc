"""The merge log by number, and the edits of operators: appended, never rewritten."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from list3r.memory.constraints import Constraints, Edit, Key, standing
from list3r.memory.errors import MemoryFileError, UnknownIdError
from list3r.memory.records import MergeDecision
from list3r.memory.store.codec import to_json
from list3r.memory.store.tables.relations import RelationVerbs

EDIT_KINDS = ("merge", "split", "label", "delete", "scale", "undo")


@dataclass(frozen=True)
class LogEntry:
    """One line of the merge log."""

    entry: int
    """Its number."""
    chunk_id: int
    """The last chunk then."""
    decision: MergeDecision


class EditVerbs(RelationVerbs):
    """Reading and writing what operators said. Writing verbs are called inside `transaction()`."""

    @property
    def writable(self) -> bool:
        """Whether the file was opened for writing."""
        return self._lock is not None

    def resolve(self, instance_id: int) -> int:
        """The id that stands for an id today. Raises `UnknownIdError`, which says so of what was deleted."""
        wanted = int(instance_id) if 0 < instance_id < 2**63 else -1
        try:
            return super().resolve(wanted)
        except UnknownIdError:
            entry = self._deletion_of(wanted)
            if entry is not None:
                raise UnknownIdError(
                    f"#{wanted} was deleted; `list3r undo {self.path} {entry}` brings it back"
                ) from None
            raise UnknownIdError(
                f"{self.path} has no instance {instance_id}; `list3r list {self.path}` shows the ids"
            ) from None

    def _deletion_of(self, instance_id: int) -> int | None:
        """The standing edit that deleted an instance, by any id that it ever had."""
        aliases = self.aliases()
        names = {instance_id}
        while aliases.get(instance_id, instance_id) not in names:
            instance_id = aliases[instance_id]
            names.add(instance_id)
        deletions = [e for e in standing(self.edits()) if e.kind == "delete"]
        return next((e.entry for e in deletions if any(n in names for n, _, _ in e.before)), None)

    def log_entries(self) -> list[LogEntry]:
        """The merge log with its numbers, oldest first."""
        query = "SELECT entry, chunk_id, kind, a, b, scores, reason FROM merges ORDER BY entry"
        return [
            LogEntry(r[0], r[1], MergeDecision(r[2], r[3], r[4], json.loads(r[5]), r[6])) for r in self._rows(query)
        ]

    def add_log_entry(self, chunk_id: int, decision: MergeDecision) -> int:
        """Append one line to the merge log; its number."""
        cursor = self._database.execute(
            "INSERT INTO merges (chunk_id, kind, a, b, scores, reason) VALUES (?, ?, ?, ?, ?, ?)",
            (chunk_id, decision.kind, decision.a, decision.b, to_json(decision.scores), decision.reason),
        )
        return int(cursor.lastrowid or 0)

    def add_edit(self, edit: Edit) -> None:
        """Append an edit."""
        arguments: dict[str, Any] = {
            "parts": edit.parts,
            "through": edit.through,
            "before": edit.before,
            "text": edit.text,
            "target": edit.target,
        }
        if edit.scale is not None:
            arguments["scale"] = edit.scale
        self._database.execute(
            "INSERT INTO edits (entry, created_at, author, kind, arguments) VALUES (?, ?, ?, ?, ?)",
            (edit.entry, edit.created_at, edit.author, edit.kind, to_json(arguments)),
        )

    def edits(self) -> list[Edit]:
        """All edits, oldest first, those that were taken back among them."""
        query = "SELECT entry, created_at, author, kind, arguments FROM edits ORDER BY entry"
        return [_edit(self, row) for row in self._rows(query)]

    def constraints(self) -> Constraints:
        """What the edits that stand come to."""
        return Constraints.of(self.edits())

    def set_labels(self, labels: Mapping[int, str | None]) -> None:
        """Name instances, by id; None takes a name away."""
        self._database.executemany(
            "UPDATE instances SET label = ? WHERE id = ?", [(text, n) for n, text in sorted(labels.items())]
        )

    def add_aliases(self, aliases: Mapping[int, int]) -> None:
        """Let ids resolve to others."""
        self._database.executemany("INSERT OR REPLACE INTO aliases VALUES (?, ?)", sorted(aliases.items()))

    def drop_revived_aliases(self) -> None:
        """Ids that name an instance again are no aliases any more."""
        self._database.execute("DELETE FROM aliases WHERE id IN (SELECT id FROM instances)")


def _edit(store: EditVerbs, row: tuple[Any, ...]) -> Edit:
    entry, created_at, author, kind, arguments = row
    try:
        told = json.loads(arguments)
        if kind not in EDIT_KINDS or (kind in ("merge", "split") and len(told["parts"]) != 2):
            raise ValueError
        return Edit(
            entry=int(entry),
            created_at=str(created_at),
            author=str(author),
            kind=str(kind),
            parts=tuple(_keys(part) for part in told["parts"]),
            through=int(told["through"]),
            before=tuple((int(n), label, _keys(keys)) for n, label, keys in told["before"]),
            text=told["text"],
            target=told["target"],
            scale=None if told.get("scale") is None else (int(told["scale"][0]), float(told["scale"][1])),
        )
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise MemoryFileError(f"{store.path}: edit {entry} is damaged; run `list3r verify {store.path}`") from error


def _keys(pairs: Any) -> tuple[Key, ...]:
    return tuple((int(chunk), int(local)) for chunk, local in pairs)
