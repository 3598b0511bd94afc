"""Which instances have a word: a table that follows the instances as a transaction commits, like their checksums.

It is derived: `verify` compares it with the instances, `repair` makes it again, and so does a program whose words are
others than those it was made with (`words.VERSION`), when it opens the file for writing.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from itertools import islice

from list3r.memory.description.words import VERSION, vocabulary

_TEXTS = "label, structure, description, color_name"
_BATCH = 500_000
"""Rows that are sorted at once."""
STAMP = ("", VERSION, 0)
"""A row of no word says which words the table holds."""
ASK_STAMP = "SELECT * FROM words WHERE word = ''"

Weights = dict[str, int]
"""Hundredths by word."""
Texts = tuple[object, object, object, object]
"""Label, structure, description and name of the colour of an instance."""


class WordIndex:
    """Keeps the table of one writing connection."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database
        self._before: dict[int, Texts | None] = {}
        """What instances that were touched were called when the table was last written; None for new ones."""
        database.create_function("list3r_words", 5, self._touch)
        old = ", ".join(f"OLD.{c}" for c in _TEXTS.split(", "))
        for name, event in (("UPDATE", f"UPDATE OF {_TEXTS}"), ("DELETE", "DELETE")):
            database.execute(
                f"CREATE TEMP TRIGGER words_{name} BEFORE {event} ON main.instances"
                f" BEGIN SELECT list3r_words(OLD.id, {old}); END"
            )
        database.execute(
            "CREATE TEMP TRIGGER words_INSERT BEFORE INSERT ON main.instances BEGIN"
            f" SELECT list3r_words(NEW.id, {_TEXTS}) FROM main.instances WHERE id = NEW.id;"
            " SELECT list3r_words(NEW.id, NULL, NULL, NULL, NULL)"
            " WHERE NOT EXISTS (SELECT 1 FROM main.instances WHERE id = NEW.id); END"
        )

    def _touch(self, instance: int, label: object, structure: object, description: object, color: object) -> None:
        if instance not in self._before:
            held = None if description is None else (label, structure, description, color)
            self._before[instance] = held

    def write(self) -> None:
        """Write what has changed since the last call; inside the transaction that changed it."""
        gone: list[tuple[str, int]] = []
        come: list[tuple[str, int, int]] = []
        for instance, held in sorted(self._before.items()):
            row = self._database.execute(f"SELECT {_TEXTS} FROM instances WHERE id = ?", (instance,)).fetchone()
            if row == held:
                continue
            before, now = ({} if texts is None else hundredths(*texts) for texts in (held, row))
            gone += [(word, instance) for word in before if word not in now]
            come += [(word, instance, weight) for word, weight in now.items() if before.get(word) != weight]
        self._database.executemany("DELETE FROM words WHERE word = ? AND instance = ?", gone)
        self._database.executemany("INSERT OR REPLACE INTO words VALUES (?, ?, ?)", sorted(come))
        self._before.clear()

    def forget(self) -> None:
        """What was touched was rolled back."""
        self._before.clear()

    @property
    def pending(self) -> bool:
        """Whether something was touched that is not written yet."""
        return bool(self._before)


def write_words(database: sqlite3.Connection) -> None:
    """Make the whole table again; inside a transaction."""
    database.execute("DELETE FROM words")
    database.execute("INSERT INTO words VALUES (?, ?, ?)", STAMP)
    expected = expected_words(database)
    while rows := sorted(islice(expected, _BATCH)):
        database.executemany("INSERT INTO words VALUES (?, ?, ?)", rows)


def up_to_date(database: sqlite3.Connection) -> bool:
    """Whether the table holds the words that this program knows."""
    return database.execute(ASK_STAMP).fetchall() == [STAMP]


def expected_words(database: sqlite3.Connection) -> Iterator[tuple[str, int, int]]:
    """What the table should hold, by what the instances are called."""
    for instance, *texts in database.execute(f"SELECT id, {_TEXTS} FROM instances"):
        yield from ((word, instance, weight) for word, weight in hundredths(*texts).items())


def hundredths(label: object, structure: object, description: object, color: object) -> Weights:
    """Return the words of texts as they come out of a file, which may be damaged, and how well each names."""
    texts = [text if isinstance(text, str) else "" for text in (label, structure, description, color)]
    named = vocabulary(None if label is None else texts[0], texts[1] or None, texts[2], texts[3])
    return {word: round(100 * weight) for word, weight in named.items()}
