"""Words that name an instance: of its label, its kind of structure, its description and its colour."""

from __future__ import annotations

import json
import re
from functools import cache, lru_cache
from pathlib import Path

_HEAD = 0.98
"""How well the last words of a label name a kind of thing, as "chair" does an office chair."""


@cache
def _same() -> dict[str, str]:
    """Irregular plurals, and colours, sizes and shapes in one word for many."""
    table: dict[str, dict[str, str]] = json.loads(Path(__file__).with_name("words.json").read_text(encoding="utf-8"))
    return {word: one for group in table.values() for one, many in group.items() for word in many.split()}


@cache
def adjectives() -> frozenset[str]:
    """Return the words of colour, size and shape that descriptions use: of what none has, it is known."""
    return frozenset(_same().values()) | {"light", "dark", "orange", "beige", "tan", "medium", "box", "bar", "slab"}


def vocabulary(label: str | None, structure: str | None, description: str, color_name: str) -> dict[str, float]:
    """Return the words that an instance has, singular and in one word for many, with how well each names it, in (0,
    1].

    Of the description only what stands before the first comma counts. The kinds of thing that it is called are words
    too, see `kind_word`.
    """
    out: dict[str, float] = {}
    described = description.split(",")[0]
    kind = split_words(described)
    color = split_words(color_name)
    for score, words in ((1.0, split_words(label or "")), (0.9, split_words(structure or "")), (0.8, kind)):
        for word in words:
            out[word] = max(out.get(word, 0.0), score)
    for word in color:
        out[word] = 1.0 if len(color) == 1 else 0.9
    if label is None:
        for word in kind[-1:]:
            out[word] = max(out[word], 0.9)
    return out | _kinds(label, structure, described)


@lru_cache(maxsize=4096)
def _kinds(label: str | None, structure: str | None, described: str) -> dict[str, float]:
    from list3r.memory.description.nouns import nouns_of  # it splits words too

    if label is None:
        return {kind_word(n): 0.9 for text in (structure or "", described) for n in nouns_of(text)}
    first, *others = nouns_of(label) or ("",)
    named = {kind_word(first): 1.0} if first else {}
    return {**named, **{kind_word(n): _HEAD for n in others}}


def kind_word(noun: str) -> str:
    """Return the word under which an index keeps all that is called a noun, by whatever name: "_office_chair"."""
    return "_" + noun.replace(" ", "_")


def split_words(text: str) -> list[str]:
    """Return the words of a text in lower case, plurals as singulars, other spellings of an adjective as one."""
    return list(_split(text))


@lru_cache(maxsize=4096)
def _split(text: str) -> tuple[str, ...]:
    """Descriptions repeat: thousands of instances are a small red box."""
    return tuple(_singular(w) for w in re.findall(r"[^\W_]+", text.lower()))


def _singular(word: str) -> str:
    same = _same()
    if word in same:
        return same[word]
    if len(word) > 3 and word.endswith("s") and not word.endswith(("ss", "us", "is")):
        if word.endswith("ies") and len(word) > 4:
            word = word[:-3] + "y"
        else:
            word = word[:-2] if word.endswith(("ches", "shes", "xes", "sses", "zes")) else word[:-1]
    return same.get(word, word)
