"""Words that name an instance: of its label, its kind of structure, its description and its colour."""

from __future__ import annotations

import re
from functools import lru_cache

_SYNONYMS = {
    "ground": "floor",
    "gray": "grey",
    "big": "large",
    "little": "small",
    "round": "cylinder",
    "cylindrical": "cylinder",
    "flat": "sheet",
    "desk": "table",
    "board": "panel",
    "violet": "purple",
    "lilac": "purple",
    "turquoise": "teal",
    "cup": "mug",
    "couch": "sofa",
    "telly": "tv",
    "television": "tv",
    "monitor": "screen",
}


def vocabulary(label: str | None, structure: str | None, description: str, color_name: str) -> dict[str, float]:
    """Return the words that an instance has, singular and in one word for many, with how well each names it, in (0,
    1].

    Of the description only what stands before the first comma counts.
    """
    out: dict[str, float] = {}
    kind = split_words(description.split(",")[0])
    color = split_words(color_name)
    for score, words in ((1.0, split_words(label or "")), (0.9, split_words(structure or "")), (0.8, kind)):
        for word in words:
            out[word] = max(out.get(word, 0.0), score)
    for word in color:
        out[word] = 1.0 if len(color) == 1 else 0.9
    if label is None:
        for word in kind[-1:]:
            out[word] = max(out[word], 0.9)
    return out


def split_words(text: str) -> list[str]:
    """Return the words of a text in lower case, plurals as singulars, synonyms as one word."""
    return list(_split(text))


@lru_cache(maxsize=4096)
def _split(text: str) -> tuple[str, ...]:
    """Descriptions repeat: thousands of instances are a small red box."""
    return tuple(_singular(w) for w in re.findall(r"[^\W_]+", text.lower()))


def _singular(word: str) -> str:
    if len(word) > 3 and word.endswith("s") and not word.endswith("ss"):
        word = word[:-2] if word.endswith(("ches", "shes", "xes")) else word[:-1]
    return _SYNONYMS.get(word, word)
