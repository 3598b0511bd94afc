"""What household and office nouns mean: a tree of kinds, other names in seven languages, usual sizes, uses.

The table is `nouns.tsv` beside this file, made by `scripts/nouns.py`; its synonyms and kinds are partly WordNet's.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

from list3r.memory.core.description.spelling import split_words

_COLLECTIVE = frozenset("pile stack row pair set bunch group piece pieces pairs lot collection".split())
LANGUAGES = ("de", "fr", "es", "it", "ja", "zh")
"""Of the names beside the English ones."""


@dataclass(frozen=True)
class Noun:
    """One kind of thing."""

    name: str
    broader: tuple[str, ...]
    """Names of what it is a kind of, the nearest."""
    synonyms: tuple[str, ...]
    size_cm: tuple[float, float] | None
    """Least and largest usual longest edge, centimetres; None where it comes in any size."""
    uses: tuple[str, ...]
    """What one does with it, without those of broader names: "sit on"."""
    foreign: dict[str, tuple[str, ...]]
    """Names by language."""


@cache
def all_nouns() -> dict[str, Noun]:
    """Return all nouns by name."""
    head, *rows = Path(__file__).with_name("nouns.tsv").read_text(encoding="utf-8").splitlines()
    columns = head.split("\t")
    return {n.name: n for n in (_noun(dict(zip(columns, row.split("\t"), strict=True))) for row in rows)}


def _noun(row: dict[str, str]) -> Noun:
    low, _, high = row["size_cm"].partition("-")
    return Noun(
        row["name"],
        _parts(row["broader"]),
        _parts(row["synonyms"]),
        (float(low), float(high)) if high else None,
        _parts(row["uses"]),
        {language: _parts(row[language], "/") for language in LANGUAGES},
    )


def _parts(text: str, separator: str = ",") -> tuple[str, ...]:
    return tuple(part for part in text.split(separator) if part)


@cache
def names() -> dict[tuple[str, ...], tuple[str, ...]]:
    """Return the nouns that words mean, by the words in lower case, the English ones as `split_words` has them too.

    A foreign name that is an English one as well ("table") means the English one.
    """
    out: dict[tuple[str, ...], list[str]] = {}

    def add(words: tuple[str, ...], name: str) -> None:
        if name not in out.setdefault(words, []):
            out[words].append(name)

    nouns = all_nouns().values()
    for n in nouns:
        add(raw_words(n.name), n.name)
        add(tuple(split_words(n.name)), n.name)
    own = frozenset(out)
    for noun, text in ((n, text) for n in nouns for text in n.synonyms):
        for words in {raw_words(text), tuple(split_words(text))} - own:
            add(words, noun.name)
    english = frozenset(out)
    for noun, text in ((n, text) for n in nouns for texts in n.foreign.values() for text in texts):
        for words in {raw_words(text), raw_words(text if text.isascii() else unaccented(text))} - english:
            add(words, noun.name)
    return {words: tuple(held) for words, held in out.items()}


def raw_words(text: str) -> tuple[str, ...]:
    """Return the words of a text as they stand, in lower case."""
    return tuple(re.findall(r"[^\W_]+", text.lower()))


def unaccented(text: str) -> str:
    """Return a text without accents, as people type it."""
    return "".join(c for c in unicodedata.normalize("NFD", text) if not unicodedata.combining(c))


@lru_cache(maxsize=4096)
def nouns_of(text: str) -> tuple[str, ...]:
    """Return the nouns that a text ends in, the longest first, each a kind of the next: what an "old office chair" is.

    Empty where it ends in none. Of "box of cereal" what stands before "of" counts, of "pile of books" the rest.
    """
    raw, table = list(raw_words(text)), names()
    whole, words = table.get(tuple(raw)) or table.get(tuple(split_words(text))), raw
    if not whole and "of" in raw[1:-1]:
        head, counted = raw[: raw.index("of")], raw[raw.index("of") + 1 :]
        words = counted if head[-1] in _COLLECTIVE else head
    out: list[str] = list((whole or ())[:1])
    for start in range(len(words)):
        end = tuple(words[start:])
        found = table.get(end) or table.get(tuple(split_words(" ".join(end)))) or ()
        for name in found[:1]:
            if name not in out and (not out or is_a(out[-1], name)):
                out.append(name)
    return tuple(out)


@cache
def kinds_of(name: str) -> tuple[str, ...]:
    """Return all that a noun is a kind of, the nearest first."""
    out: list[str] = []
    level = list(all_nouns()[name].broader)
    while level:
        out += [k for k in level if k not in out]
        level = [b for k in level for b in all_nouns()[k].broader if b not in out]
    return tuple(out)


@cache
def narrower(name: str) -> tuple[str, ...]:
    """Return all nouns that are kinds of one."""
    return tuple(n for n in all_nouns() if name in kinds_of(n))


def is_a(name: str, broader: str) -> bool:
    """Tell whether a name is another, or a kind of it: a chair is a seat, and furniture."""
    if name in all_nouns() and broader in all_nouns():
        return name == broader or broader in kinds_of(name)
    one, other = nouns_of(name), nouns_of(broader)
    return bool(one and other) and other[0] in (*one, *kinds_of(one[0]))
