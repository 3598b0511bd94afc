"""Match words with labels and descriptions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from list3r.memory.core.description.nouns import nouns_of
from list3r.memory.core.description.spelling import split_words
from list3r.memory.core.description.words import kind_word, vocabulary
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Instance

_IGNORED = frozenset("a an the of in on at with and or some any my thing things object objects".split())
STRUCTURE = frozenset(("floor", "ceiling", "wall"))
"""Kinds of structure that people name."""


def wanted_words(text: str) -> list[str]:
    """Return the words that matter, in order. Raises `OptionError` when none is left."""
    found = [w for w in split_words(text) if w not in _IGNORED]
    if not found:
        raise OptionError(f"{text!r} has no word to search for; name an object, a colour or a shape")
    return list(dict.fromkeys(found))


def is_named(instance: Instance, text: str) -> bool:
    """Tell whether label, kind of structure and description together have all the words, or others for the same."""
    own = vocabulary(instance.label, instance.structure, instance.description, instance.color_name)
    return all(w in own or same_kind(w) in own for w in wanted_words(text))


def same_kind(word: str) -> str:
    """Return the word under which all that is called so is kept, by whatever name; the word itself where none is."""
    found = nouns_of(word)
    return kind_word(found[0]) if found else word


def is_colored(instance: Instance, text: str) -> bool:
    """Tell whether the main colour has all the words: "red" is said of what is dark red, not the other way round."""
    return set(wanted_words(text)) <= set(split_words(instance.color_name))


def no_such_words(words: Sequence[str], things: Iterable[Instance], most: int = 12) -> str:
    """Say that no instance has some words, what most are called (the last words of names), and the share nameless."""
    listed = list(things)
    nameless = sum(not i.label and not i.structure for i in listed)
    last_words = [split_words(i.label or i.structure or i.description.split(",")[0])[-1:] for i in listed]
    count = Counter(word for last in last_words for word in last)
    names = ", ".join(word for word, _ in sorted(count.items(), key=lambda c: (-c[1], c[0]))[:most])
    missing = f"word{'s' if len(words) > 1 else ''} {', '.join(map(repr, words))}"
    return f"no instance has the {missing} in its label or description" + (
        (f"; frequent names: {names}" if names else "")
        + (f"; {nameless / len(listed):.0%} of the things have no name and may be it" if nameless else "")
    )
