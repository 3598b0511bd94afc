"""Which instances a phrase names: by its label, then by another name, then as a kind of it, then by its use."""

from __future__ import annotations

from collections.abc import Mapping

from list3r.memory.core.description.nouns import all_nouns, kinds_of, narrower, nouns_of
from list3r.memory.core.description.spelling import split_words
from list3r.memory.core.description.words import kind_word
from list3r.memory.core.records import Instance
from list3r.queries.finding.grammar import Phrase

SYNONYM, NARROWER, USEFUL = 0.95, 0.9, 0.85
"""How well another name, a kind of what is asked for, and what can be used so, name a thing."""


def tiers(phrase: Phrase) -> tuple[tuple[str, ...], ...]:
    """Return the nouns that a phrase means, those that name it before the kinds of them; the first that anything bears
    count."""
    kinds = tuple(dict.fromkeys(k for m in phrase.meant for k in narrower(m)))
    if phrase.use is not None:
        return ((*phrase.meant, *kinds),)
    return (phrase.meant, kinds) if kinds else (phrase.meant,)


def name_score(phrase: Phrase, words: Mapping[str, float], nouns: tuple[str, ...]) -> float:
    """Return how well one of some nouns names what has these words, 0 where none does."""
    best = max((words.get(kind_word(n), 0.0) for n in nouns), default=0.0)
    if phrase.use is not None:
        return min(best, USEFUL)
    if nouns != phrase.meant:
        return min(best, NARROWER)
    return best if all(w in words for w in phrase.noun) else min(best, SYNONYM)


def why_named(phrase: Phrase, i: Instance, *, kind: bool) -> str:
    """Say why a phrase names an instance; `kind` where it is called by a narrower name."""
    if phrase.generic:
        return ""
    called = i.label or i.structure or i.description.split(",")[0]
    if phrase.use is not None:
        return f"{called}: to {' '.join(_spoken(phrase.use))}"
    said = " ".join(phrase.all_words)
    if not phrase.meant or set(phrase.noun) <= set(split_words(f"{called} {i.description}")):
        return f"named {said}"
    if kind:
        return f"{called}: a kind of {phrase.meant[0]}"
    return f"named {called}, another word for {' '.join(phrase.noun)}"


def _spoken(use: str) -> list[str]:
    return [w for w in use.split() if w not in ("to", "for", "i", "you", "we", "can", "could", "one", "use")]


def looser(phrase: Phrase) -> list[tuple[Phrase, float, str]]:
    """Return what is nearest to a phrase that nothing fits, with a score below that of an answer, and in words."""
    bare = Phrase(phrase.text, (), phrase.noun, phrase.meant, phrase.use)
    out = [(Phrase(phrase.text, phrase.words, phrase.noun, phrase.meant, phrase.use), 0.6, "not known to stand so")]
    if phrase.noun or phrase.use:
        out.append((bare, 0.5, "not known to look so"))
    for m in phrase.meant if phrase.use is None else ():
        near = list(dict.fromkeys((*_closest_kinds(m), *kinds_of(m))))[:3]
        out += [(Phrase(k, (), tuple(split_words(k)), (k,)), 0.4, f"no {m} is known, but this {k}") for k in near]
    return [o for o in out if not o[0].generic]


def _closest_kinds(noun: str) -> tuple[str, ...]:
    return all_nouns()[noun].broader


def called(i: Instance) -> tuple[str, ...]:
    """Return the nouns that an instance is called."""
    return nouns_of(i.label or i.structure or i.description.split(",")[0])
