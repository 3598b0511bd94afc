"""Which instances have words: asked of the table that follows the instances, see `word_index`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import MemoryFileError
from list3r.memory.records import Instance
from list3r.memory.store.connection import Connection
from list3r.memory.store.derived import CurrentCache
from list3r.memory.store.rows.columns import UNREADABLE
from list3r.memory.store.word_index import ASK_STAMP, STAMP, expected_words, hundredths

_FEW = 2_000
"""A word that so few have leads to the others; instances with more frequent ones are read whole and kept."""
_KEPT_BYTES = 64_000_000
"""Of the bearers of frequent words that were asked for last."""
Bearers = tuple[NDArray[np.int64], NDArray[np.int16]]
"""Ids of instances, and how well words name them, in hundredths. Shapes (N,)."""


class Words:
    """The table of words, which the instances write: only asked here."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._kept: CurrentCache[str, Bearers] = CurrentCache(
            connection.stamp, _KEPT_BYTES, lambda bearers: bearers[0].nbytes + bearers[1].nbytes
        )

    def known(self, words: Iterable[str]) -> set[str]:
        """Those of some words that any instance has."""
        wanted = set(words) - {""}
        if not self._is_current():
            return wanted & {word for word, _, _ in self._expected()}
        return {word for word in wanted if self._connection.rows("SELECT 1 FROM words WHERE word = ? LIMIT 1", (word,))}

    def bearing(self, words: Sequence[str], limit: int) -> Bearers:
        """Return the instances that have all of some words, and how well those name them together; the best first, at
        most `limit`.
        """
        wanted = sorted(set(words) - {""})
        if not wanted or wanted != sorted(set(words)):
            return self._bearers([])
        if not self._is_current():
            return self._bearers(self._bearing_without_index(wanted)[:limit])
        first, *others = sorted(wanted, key=lambda word: (self._count(word, _FEW + 1), word))
        if self._count(first, _FEW + 1) > _FEW:
            return self._bearing_frequent(wanted, limit)
        joins = "".join(
            f" CROSS JOIN words w{n} ON w{n}.word = ? AND w{n}.instance = w.instance" for n in range(len(others))
        )
        weight = "".join(f" + w{n}.weight" for n in range(len(others)))
        query = (
            f"SELECT w.instance, w.weight{weight} AS total FROM words w{joins} WHERE w.word = ?"
            " ORDER BY total DESC, w.instance LIMIT ?"
        )
        return self._bearers(self._connection.rows(query, (*others, first, limit)))

    def _bearing_frequent(self, words: Sequence[str], limit: int) -> Bearers:
        (ids, total), *others = sorted((self._bearers_of(word) for word in words), key=lambda b: len(b[0]))
        for other, weights in others:
            both = np.isin(ids, other, assume_unique=True)
            ids, total = ids[both], total[both]
            total = total + weights[np.searchsorted(other, ids)]
        order = np.argsort(-total, kind="stable")[:limit]
        return ids[order], total[order]

    def _bearers_of(self, word: str) -> Bearers:
        """Return all that have a word, from what is kept while the file stays as it is."""
        query = "SELECT instance, weight FROM words WHERE word = ? ORDER BY instance"
        return self._kept.get(word, lambda: self._bearers(self._connection.rows(query, (word,))))

    def bearing_most(self, words: Sequence[str], limit: int) -> list[list[int]]:
        """Ids of the instances that have some words or, of three letters on, words that begin so: those that have the
        most of them first, one list for each number of words. At most `limit` ids are looked at for each word.
        """
        hits: dict[int, int] = {}
        for word in dict.fromkeys(words):
            last = word + "\U0010ffff" if len(word) >= 3 else word
            query = "SELECT DISTINCT instance FROM words WHERE word BETWEEN ? AND ? LIMIT ?"
            for (instance,) in self._connection.rows(query, (word, last, limit)):
                hits[instance] = hits.get(instance, 0) + 1
        return [sorted(n for n, c in hits.items() if c == most) for most in sorted(set(hits.values()), reverse=True)]

    def check(self, instances: Iterable[Instance], words: Iterable[str], totals: Mapping[int, int]) -> None:
        """Raise `MemoryFileError` where instances are not called by some words as well as the table says."""
        wanted = set(words)
        for i in instances:
            weights = hundredths(i.label, i.structure, i.description, i.color_name)
            if sum(weights.get(word, 0) for word in wanted) != totals[i.id] and self._is_current():
                self._connection.refuse(f"words: those of instance {i.id} are not those of its label and description")

    def _bearers(self, rows: Sequence[tuple[int, int]]) -> Bearers:
        try:
            held = np.array(rows, np.int64).reshape(-1, 2)
            return held[:, 0].copy(), held[:, 1].astype(np.int16)
        except UNREADABLE as error:
            raise MemoryFileError(f"words cannot be read ({error}); run `list3r verify` on the file") from error

    def _is_current(self) -> bool:
        """Whether the table holds the words that this program knows."""
        return self._connection.rows(ASK_STAMP) == [STAMP]

    def _expected(self) -> list[tuple[str, int, int]]:
        with self._connection.unchecked() as database:
            return list(expected_words(database))

    def _count(self, word: str, most: int) -> int:
        query = "SELECT count(*) FROM (SELECT 1 FROM words WHERE word = ? LIMIT ?)"
        return int(self._connection.rows(query, (word, most))[0][0])

    def _bearing_without_index(self, words: Sequence[str]) -> list[tuple[int, int]]:
        held: dict[int, dict[str, int]] = {}
        for word, instance, weight in self._expected():
            if word in words:
                held.setdefault(instance, {})[word] = weight
        found = [(-sum(weights.values()), n) for n, weights in held.items() if len(weights) == len(words)]
        return [(n, -total) for total, n in sorted(found)]
