"""Words that name an instance: of its label, its kind of structure, its description and its colour."""

from __future__ import annotations

import re
from functools import lru_cache

from list3r.memory.core.description.nouns import nouns_of
from list3r.memory.core.description.spelling import split_words

_HEAD = 0.98
"""How well the last words of a label name a kind of thing, as "chair" does an office chair."""


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
    if label is None:
        return {kind_word(n): 0.9 for text in (structure or "", described) for n in nouns_of(text)}
    first, *others = nouns_of(label) or ("",)
    named = {kind_word(first): 1.0} if first else {}
    return {**named, **{kind_word(n): _HEAD for n in others}}


def kind_word(noun: str) -> str:
    """Return the word under which an index keeps all that is called a noun, by whatever name: "_office_chair"."""
    return "_" + re.sub(r"\W+", "_", noun)
