"""Which instances words mean, for `nearest`: a phrase as `find` reads it, else those that have the words."""

from __future__ import annotations

from collections.abc import Sequence

from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.find import meant
from list3r.queries.finding.free_words import WordEncoder, like, named_by_vectors
from list3r.queries.finding.grammar import Phrase, parse
from list3r.queries.finding.naming import looser
from list3r.queries.finding.words import STRUCTURE, no_such_words, wanted_words, word_score
from list3r.queries.match import Filters
from list3r.queries.views.gather import is_large, sample

_LOADED = 5_000
"""Instances that are looked at because of what they are called, in a memory that holds many."""
_NAMED = 100_000
"""Most instances that have one word."""


def named_by(
    store: Store,
    words: str,
    origin: Instance | None,
    filters: Filters,
    encoder: WordEncoder | None,
    notes: list[str],
) -> list[tuple[Instance, float, str]]:
    """Return what the words say, with how well and why: a phrase as `find` reads it, else things that have them."""
    phrases = [p for p in parse(words).phrases if not p.generic or p.where or p.order or p.size]
    if _says_more(phrases) or not is_large(store):
        named, said = _meant(store, phrases, filters, encoder)
        if named or _says_more(phrases):
            notes += said
            return named
    others = [i for i in _with_words(store, words, filters, notes) if origin is None or i.id != origin.id]
    named = _named(others, words) or _meant(store, phrases, filters)[0]
    for phrase, share, why in (n for p in phrases for n in looser(p)) if not named and encoder is None else ():
        found, _ = _meant(store, [phrase], filters)
        named = named or [(i, round(share * score, 4), f"{reason}; {why}") for i, score, reason in found]
    if not named and encoder is not None:
        named = _alike(store, encoder, words, filters, notes)
    if not named and (unknown := [w for w in wanted_words(words) if w not in store.words.known([w])]):
        notes.append(no_such_words(unknown, sample(store)))
    return named


def _meant(
    store: Store, phrases: Sequence[Phrase], filters: Filters, encoder: WordEncoder | None = None
) -> tuple[list[tuple[Instance, float, str]], list[str]]:
    """Return what phrases mean that passes the filters, with how well and why, and notes."""
    found: dict[int, tuple[Instance, float, str]] = {}
    notes: list[str] = []
    for phrase in phrases:
        matches, search = meant(store, phrase, encoder=encoder)
        notes += search.notes
        for c in (c for c in matches if filters.passes(c.instance)):
            found.setdefault(c.instance.id, (c.instance, round(c.score, 4), "; ".join(filter(None, c.reasons))))
    return list(found.values()), notes


def _says_more(phrases: Sequence[Phrase]) -> bool:
    """Tell whether phrases say more than names."""
    return any(p.where or p.size or p.order or p.use or p.instance_id is not None for p in phrases)


def only_common(store: Store, words: str) -> bool:
    """Tell whether the words only name, and so many have them that it is better to look around than at all of them."""
    if _says_more(parse(words).phrases):
        return False
    return len(store.words.bearing(wanted_words(words), _LOADED + 1)[0]) > _LOADED


def _with_words(store: Store, words: str, filters: Filters, notes: list[str]) -> list[Instance]:
    """Return what passes the filters: all; of a large memory those that have the most of the words."""
    if not is_large(store):
        return filters.select(store.instances.all())
    parts = (
        (ids, start)
        for ids in store.words.bearing_most(wanted_words(words), _NAMED + 1)
        for start in range(0, len(ids), _LOADED)
    )
    for ids, start in parts:
        found = filters.select(store.instances.of(ids[start : start + _LOADED]))
        if not _named(found, words):
            continue
        if len(ids) > start + _LOADED:
            count = f"more than {_NAMED}" if len(ids) > _NAMED else f"{len(ids)}"
            notes.append(f"{count} instances match {words!r}; {start + _LOADED} of them were considered")
        return found
    return []


def _alike(
    store: Store, encoder: WordEncoder, words: str, filters: Filters, notes: list[str]
) -> list[tuple[Instance, float, str]]:
    """Return things whose vectors fit words that no instance has."""
    try:
        cosine = named_by_vectors(store, encoder, words) or {}
    except OptionError as error:  # the memory has come to a machine without the model's weights
        notes.append(f"free words cannot be compared: {error}")
        return []
    alike = filters.select(store.instances.of(list(cosine)))
    return [(i, round(cosine[i.id], 4), like(words, cosine[i.id], encoder.space)) for i in alike]


def _named(candidates: Sequence[Instance], words: str) -> list[tuple[Instance, float, str]]:
    """Return those that have the words: all of them where some thing does, else as many as any thing does."""
    wanted = wanted_words(words)
    found = [(i, *word_score(i, wanted)) for i in candidates]
    most = max((len(hit) for _, _, hit in found), default=0)
    return [(i, score, _named_so(hit, wanted)) for i, score, hit in found if hit and len(hit) == most]


def _named_so(hit: Sequence[str], wanted: Sequence[str]) -> str:
    missing = [w for w in wanted if w not in hit]
    return f"named {' '.join(hit)}" + (f", not {' '.join(missing)}" if missing else "")


def names_structure(words: str) -> bool:
    """Tell whether words name a kind of structure."""
    return not STRUCTURE.isdisjoint(wanted_words(words))
