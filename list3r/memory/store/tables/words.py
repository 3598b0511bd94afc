"""Which instances have words: SQLite's full text search, a column for each weight of a word."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.words import vocabulary
from list3r.memory.core.records import Instance
from list3r.memory.store.connection import Connection

_WEIGHTS = (100, 98, 90, 80)
"""How well a word names an instance, in hundredths, see `memory.core.description.words`; each is a column."""
_MOST_WORDS = 6
"""Of a phrase that are ranked by their weights; the others must be there."""
Bearers = tuple[NDArray[np.int64], NDArray[np.int16]]
"""Ids of instances, and how well words name them, in hundredths. Shapes (N,)."""


class Words:
    """The table of words, which follows the instances. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def put(self, instances: Iterable[Instance]) -> None:
        """Write the words of instances."""
        self._connection.execute_many(
            "INSERT OR REPLACE INTO words (rowid, w100, w98, w90, w80) VALUES (?, ?, ?, ?, ?)", map(_row, instances)
        )

    def drop(self, instance_id: int) -> None:
        """Forget the words of an instance."""
        self._connection.execute("DELETE FROM words WHERE rowid = ?", (instance_id,))

    def known(self, words: Iterable[str]) -> set[str]:
        """Those of some words that any instance has."""
        return {word for word in set(words) - {""} if self._ids(_quoted(word), 1)}

    def bearing(self, words: Sequence[str], limit: int) -> Bearers:
        """Return the instances that have all of some words, and how well those name them together; the best first, at
        most `limit`.
        """
        wanted = sorted(set(words))
        ids: list[int] = []
        totals: list[int] = []
        if wanted and "" not in wanted:
            for total, match in self._matches(wanted):
                found = self._ids(match, limit - len(ids))
                ids += found
                totals += [total] * len(found)
                if len(ids) == limit:
                    break
        return np.array(ids, np.int64), np.array(totals, np.int16)

    def _matches(self, words: Sequence[str]) -> list[tuple[int, str]]:
        """Return what to match for words in each choice of their columns, the best first; none but the last is met by
        any instance twice, for a word is in one column of an instance.
        """
        ranked, rest = words[:_MOST_WORDS], "".join(f" AND {_quoted(word)}" for word in words[_MOST_WORDS:])
        columns = [
            [(weight, match) for weight in _WEIGHTS if self._ids(match := f"w{weight} : {_quoted(word)}", 1)]
            for word in ranked
        ]
        chosen = [(sum(w for w, _ in c), " AND ".join(f"({m})" for _, m in c) + rest) for c in product(*columns)]
        return sorted(chosen, key=lambda c: -c[0])

    def _ids(self, match: str, limit: int) -> list[int]:
        query = "SELECT rowid FROM words WHERE words MATCH ? ORDER BY rowid LIMIT ?"
        return [n for (n,) in self._connection.rows(query, (match, limit))]


def _quoted(word: str) -> str:
    """A word as FTS5 reads it."""
    return '"' + word.replace('"', '""') + '"'


def _row(instance: Instance) -> tuple[int | str, ...]:
    held = vocabulary(instance.label, instance.structure, instance.description, instance.color_name)
    texts = (" ".join(word for word, score in held.items() if round(100 * score) == weight) for weight in _WEIGHTS)
    return (instance.id, *texts)
