"""Which instances bear words: asked of the table that follows the instances, see `word_index`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from list3r.memory.store.connection import Connection
from list3r.memory.store.word_index import expected_words, up_to_date

_BATCH = 500
"""Rows asked for by id in one statement."""


class WordVerbs(Connection):
    """Reading words and, by many ids at once, what stands in relations."""

    def known_words(self, words: Iterable[str]) -> set[str]:
        """Those of some words that any instance bears."""
        wanted = set(words) - {""}
        if not up_to_date(self._database):
            return wanted & {word for word, _, _ in expected_words(self._database)}
        return {word for word in wanted if self._rows("SELECT 1 FROM words WHERE word = ? LIMIT 1", (word,))}

    def bearing(self, words: Sequence[str], limit: int) -> list[int]:
        """Ids of the instances that bear all of some words, those that they name best first, at most `limit`."""
        wanted = sorted(set(words) - {""})
        if not wanted or wanted != sorted(set(words)):
            return []
        if not up_to_date(self._database):
            return self._bearing_without_index(wanted)[:limit]
        first, *others = sorted(wanted, key=lambda word: (self._count(word), word))
        joins = "".join(
            f" CROSS JOIN words w{n} ON w{n}.word = ? AND w{n}.instance = w.instance" for n in range(len(others))
        )
        weight = "".join(f" + w{n}.weight" for n in range(len(others)))
        query = (
            f"SELECT w.instance FROM words w{joins} WHERE w.word = ? ORDER BY w.weight{weight} DESC, w.instance LIMIT ?"
        )
        return [int(row[0]) for row in self._rows(query, (*others, first, limit))]

    def bearing_most(self, words: Sequence[str], limit: int) -> list[list[int]]:
        """Ids of the instances that bear some words or, of three letters on, words that begin so: those that bear the
        most of them first, one list for each number of words. At most `limit` ids are looked at for each word.
        """
        hits: dict[int, int] = {}
        for word in dict.fromkeys(words):
            last = word + "\U0010ffff" if len(word) >= 3 else word
            query = "SELECT DISTINCT instance FROM words WHERE word BETWEEN ? AND ? LIMIT ?"
            for (instance,) in self._rows(query, (word, last, limit)):
                hits[instance] = hits.get(instance, 0) + 1
        return [sorted(n for n, c in hits.items() if c == most) for most in sorted(set(hits.values()), reverse=True)]

    def _count(self, word: str, most: int = 100_000) -> int:
        query = "SELECT count(*) FROM (SELECT 1 FROM words WHERE word = ? LIMIT ?)"
        return int(self._rows(query, (word, most))[0][0])

    def _bearing_without_index(self, words: Sequence[str]) -> list[int]:
        held: dict[int, dict[str, int]] = {}
        for word, instance, weight in expected_words(self._database):
            if word in words:
                held.setdefault(instance, {})[word] = weight
        found = [(-sum(weights.values()), n) for n, weights in held.items() if len(weights) == len(words)]
        return [n for _, n in sorted(found)]

    def related(
        self, ids: Iterable[int], predicates: Sequence[str], *, as_object: bool
    ) -> list[tuple[int, str, int, float]]:
        """(subject, predicate, object, confidence) of the stored relations in which some instances are the subject, or
        the object.
        """
        column = "object" if as_object else "subject"
        kinds = ",".join("?" * len(predicates))
        known = sorted(map(int, ids))
        rows: list[tuple[int, str, int, float]] = []
        for start in range(0, len(known), _BATCH):
            part = known[start : start + _BATCH]
            query = (
                f"SELECT subject, predicate, object, confidence FROM relations WHERE {column} IN"
                f" ({','.join('?' * len(part))}) AND predicate IN ({kinds})"
            )
            rows += [(int(s), str(p), int(o), float(c)) for s, p, o, c in self._rows(query, (*part, *predicates))]
        return rows

    def structure_among(self, ids: Sequence[int]) -> list[int]:
        """Those of some instances that are structure."""
        out: list[int] = []
        for start in range(0, len(ids), _BATCH):
            part = [int(i) for i in ids[start : start + _BATCH]]
            query = f"SELECT id FROM instances WHERE id IN ({','.join('?' * len(part))}) AND structure IS NOT NULL"
            out += [int(row[0]) for row in self._rows(query, tuple(part))]
        return out

    def largest_id(self) -> int:
        """The largest id that an instance has now, 0 without any: about how many there are."""
        return int(self._rows("SELECT coalesce(max(id), 0) FROM instances")[0][0])

    def sample_ids(self, count: int) -> list[int]:
        """About `count` ids, spread evenly over those given so far; found one by one, whatever the memory holds."""
        last = self.largest_id()
        query = "SELECT id FROM instances WHERE id >= ? ORDER BY id LIMIT 1"
        starts = range(0, last + 1, max(1, last // max(count, 1)))
        return sorted({int(row[0]) for start in starts for row in self._rows(query, (start,))})
