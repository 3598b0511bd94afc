"""How words are spelled: plurals as singulars, other spellings of an adjective as one."""

from __future__ import annotations

import json
import re
from functools import cache, lru_cache
from pathlib import Path


@cache
def _same() -> dict[str, str]:
    """Irregular plurals, and colours, sizes and shapes in one word for many."""
    table: dict[str, dict[str, str]] = json.loads(Path(__file__).with_name("words.json").read_text(encoding="utf-8"))
    return {word: one for group in table.values() for one, many in group.items() for word in many.split()}


@cache
def adjectives() -> frozenset[str]:
    """Return the words of colour, size and shape that descriptions use: of what none has, it is known."""
    return frozenset(_same().values()) | {"light", "dark", "orange", "beige", "tan", "medium", "box", "bar", "slab"}


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
