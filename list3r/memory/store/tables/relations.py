"""Relations of instances, and the log of what was merged."""

from __future__ import annotations

import json
from collections.abc import Iterable

from list3r.memory.records import MergeDecision, Relation
from list3r.memory.store.codec import to_json
from list3r.memory.store.tables.observations import ObservationVerbs


class RelationVerbs(ObservationVerbs):
    """Writing and reading relations and the merge log. Writing verbs are called inside `transaction()`."""

    def replace_relations(self, subjects: Iterable[int] | None, relations: Iterable[Relation]) -> None:
        """Replace all relations that touch these instances (all relations when `subjects` is None)."""
        if subjects is None:
            self._database.execute("DELETE FROM relations")
        else:
            ids = [(int(i),) for i in subjects]
            self._database.executemany("DELETE FROM relations WHERE subject = ?", ids)
            self._database.executemany("DELETE FROM relations WHERE object = ?", ids)
        self._database.executemany(
            "INSERT OR REPLACE INTO relations VALUES (?, ?, ?, ?, ?)",
            [(r.subject, r.predicate, r.object, float(r.confidence), float(r.margin)) for r in relations],
        )

    def relations(
        self, subject: int | None = None, predicate: str | None = None, object: int | None = None
    ) -> list[Relation]:
        """Relations that match what is given; ids may be aliases."""
        clauses: list[str] = []
        arguments: list[int | str] = []
        for column, value in (("subject", subject), ("object", object)):
            if value is not None:
                clauses.append(f"{column} = ?")
                arguments.append(self.resolve(value))
        if predicate is not None:
            clauses.append("predicate = ?")
            arguments.append(predicate)
        where = f"WHERE {' AND '.join(clauses)}" if clauses else ""
        query = (
            f"SELECT subject, predicate, object, confidence, margin FROM relations {where}"
            " ORDER BY subject, predicate, object"
        )
        return [Relation(*r) for r in self._believed("relations", self._rows(query, tuple(arguments)))]

    def log_decisions(self, chunk_id: int, decisions: Iterable[MergeDecision]) -> None:
        """Append to the merge log what was decided when a chunk arrived."""
        self._database.executemany(
            "INSERT INTO merges (chunk_id, kind, a, b, scores, reason) VALUES (?, ?, ?, ?, ?, ?)",
            [(chunk_id, d.kind, d.a, d.b, to_json(d.scores), d.reason) for d in decisions],
        )

    def has_decided(self, kind: str, a: str, b: str) -> bool:
        """Whether the log holds a decision of this kind on these two."""
        return bool(self._rows("SELECT 1 FROM merges WHERE a = ? AND b = ? AND kind = ? LIMIT 1", (a, b, kind)))

    def decisions(self) -> list[MergeDecision]:
        """The merge log, oldest first."""
        query = "SELECT kind, a, b, scores, reason FROM merges ORDER BY entry"
        return [MergeDecision(r[0], r[1], r[2], json.loads(r[3]), r[4]) for r in self._rows(query)]
