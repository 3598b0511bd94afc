"""Collect the instances that a question can be about, in a memory with too many to load all.

The word index gives the instances that have the words of a phrase, and the stored relations those of them that stand
as asked; only these are loaded. In a memory of up to `EVERYTHING` instances all are loaded, with the same answers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.words import kind_word
from list3r.memory.core.errors import UnknownIdError
from list3r.memory.core.records import Instance
from list3r.memory.library.relations.predicates import PREDICATES
from list3r.memory.store.store import Store
from list3r.memory.store.tables.words import Bearers
from list3r.queries.finding.grammar import Clause, Phrase
from list3r.queries.finding.naming import tiers
from list3r.queries.match import checked_instance

EVERYTHING = 500
"""Up to this many instances all are loaded."""
_MOST_BEARING = 300_000
"""Ids that have the words of one phrase, at most."""
_MOST = 5_000
"""Instances that are loaded for one phrase, at most."""
_SAMPLE = 1_000
"""Instances that tell how large things are,"""
_NAMED = 250
"""and what they are called."""
_KEPT = 20
"""Of a phrase of which nothing stands as it should: enough to say so."""


@dataclass
class Gathered:
    """Ids to look at."""

    store: Store
    ids: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    """What was left out."""
    _bearing: dict[tuple[str, ...], Bearers] = field(default_factory=dict)

    @cached_property
    def sample(self) -> list[int]:
        """Ids of some of all things, spread evenly."""
        return self.store.ids.sample(_SAMPLE)

    def bearing(self, words: tuple[str, ...]) -> list[int]:
        """Return ids that have all of some words, the best first."""
        ids: list[int] = self.bearers(words)[0].tolist()
        return ids

    def named(self, words: tuple[str, ...]) -> Bearers:
        """Return the instances that are looked at of those that have all of some words, the best first."""
        ids, hundredths = self.bearers(words)
        if len(ids) > _MOST:
            self.notes.append(f"{len(ids)} instances match {_said(words)!r}; {_MOST} of them were considered")
        return ids[:_MOST], hundredths[:_MOST]

    def bearers(self, words: tuple[str, ...]) -> Bearers:
        """Return the instances that have all of some words, the best first."""
        if words not in self._bearing:
            ids, hundredths = self.store.words.bearing(words, _MOST_BEARING + 1)
            if len(ids) > _MOST_BEARING:
                self.notes.append(f"more than {_MOST_BEARING} instances match {_said(words)!r}; add words")
            self._bearing[words] = ids[:_MOST_BEARING], hundredths[:_MOST_BEARING]
        return self._bearing[words]

    def naming(self, phrase: Phrase) -> list[int] | None:
        """Return ids that the words of a phrase name, the best first; None where it may be anything.

        Of the nouns that it may mean only the first that name anything count, as in `find`.
        """
        if phrase.generic:
            return None
        if not phrase.meant:
            return self.bearing(phrase.all_words)
        for nouns in tiers(phrase):
            known = self.store.words.known([kind_word(n) for n in nouns])
            found = dict.fromkeys(n for key in sorted(known) for n in self.bearing((*phrase.words, key)))
            if found:
                return list(found)
        return []

    def sizes_of(self, phrase: Phrase) -> NDArray[np.float64]:
        """Return longest edges of some of things that a phrase names, of any where fewer than four are; ascending."""
        ids = np.array(self.naming(phrase) or [], np.int64)
        ids = ids[:: -(-len(ids) // _SAMPLE)] if len(ids) >= 4 else np.array(self.sample)
        ranks = self.store.instances.ranks(ids)
        return np.sort(ranks.longest_edge[~ranks.structure])


def _said(words: tuple[str, ...]) -> str:
    """Return words for a note, kinds of thing too."""
    return " ".join(w.strip("_").replace("_", " ") for w in words)


def is_large(store: Store) -> bool:
    """Tell whether a memory holds too much to look at all of it."""
    return store.ids.largest() > EVERYTHING


def sample(store: Store) -> list[Instance]:
    """Return all instances, or in a memory that holds too many some that tell what things are called."""
    return store.instances.of(store.ids.sample(_NAMED)) if is_large(store) else store.instances.all()


def gather(store: Store, phrase: Phrase) -> Gathered | None:
    """Collect what to search for a question; None where that is everything."""
    if not is_large(store):
        return None
    out = Gathered(store)
    own = _candidates(store, phrase, out)
    _keep(out, phrase, out.sample if own is None else own)
    return out


def _candidates(store: Store, phrase: Phrase, out: Gathered) -> list[int] | None:
    """Return ids that a phrase may mean, best first; None where it may mean anything. Those of its clauses are kept."""
    found: list[int] | None = None
    if phrase.instance_id is not None:
        with contextlib.suppress(UnknownIdError):
            found = [checked_instance(store, phrase.instance_id).id]
    else:
        found = out.naming(phrase)
    if phrase.order is not None and phrase.order.to is not None:
        ends = _candidates(store, phrase.order.to, out)
        _keep(out, phrase.order.to, out.sample if ends is None else ends)
    for clause in phrase.where:
        objects = _candidates(store, clause.object, out)
        if clause.other is not None:
            _keep(out, clause.other, _candidates(store, clause.other, out) or out.sample)
        if clause.other is not None or clause.negated or not set(clause.predicates) & set(PREDICATES):
            _keep(out, clause.object, out.sample if objects is None else objects)
            continue
        found = _standing(store, phrase, clause, found, objects, out)
    return found


def _standing(
    store: Store, phrase: Phrase, clause: Clause, found: list[int] | None, objects: list[int] | None, out: Gathered
) -> list[int] | None:
    """Return those of `found` that stand so to one of the objects, which are kept."""
    if found is None and objects is None:
        _keep(out, clause.object, out.sample)
        return None
    pairs = set(store.relations.pairs(clause.predicates, found, objects))
    if "near" in clause.predicates:
        near = _near_structure(store, objects or [])
        subjects = set(found) if near and found is not None else set()
        pairs |= {(s, o) for s, o in near if found is None or s in subjects}
    if not pairs:
        _keep(out, clause.object, (objects or out.sample)[:_KEPT])
        return (found or out.sample)[:_KEPT]
    at = {s for s, _ in pairs}, {o for _, o in pairs}
    _keep(out, clause.object, [n for n in objects if n in at[1]] if objects is not None else sorted(at[1]))
    return [n for n in found if n in at[0]] if found is not None else sorted(at[0])


def _near_structure(store: Store, objects: Sequence[int]) -> set[tuple[int, int]]:
    """Return pairs of anything and a wall or floor among some objects, whose boxes nearly meet."""
    out = set()
    ranks = store.instances.ranks(np.array(objects[:_MOST], np.int64))
    for wall in store.instances.of(ranks.ids[ranks.structure][:_KEPT].tolist()):
        reach = 0.1 * float(np.linalg.norm(np.ptp(wall.aabb, axis=0))) + 1.0
        out |= {(n, wall.id) for n in store.instances.ids_in_box(wall.aabb[0] - reach, wall.aabb[1] + reach)[:_MOST]}
    return out


def _keep(out: Gathered, phrase: Phrase, ids: Sequence[int]) -> None:
    if len(ids) > _MOST:
        out.notes.append(f"{len(ids)} instances match {phrase.text!r}; {_MOST} of them were considered")
    out.ids.update(ids[:_MOST])
