"""Find instances by a question: attributes, a noun, relations, counts, orders; see `finding.grammar`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.nouns import kinds_of
from list3r.memory.core.description.spelling import adjectives, split_words
from list3r.memory.core.description.words import kind_word, vocabulary
from list3r.memory.core.errors import OptionError, UnknownIdError
from list3r.memory.core.records import Instance
from list3r.memory.library.rooms.naming import title
from list3r.memory.store.store import Store
from list3r.queries.changes import changes
from list3r.queries.finding.free_words import WordEncoder, like, named_by_vectors
from list3r.queries.finding.grammar import IN_ROOM, Clause, Phrase, Question, parse
from list3r.queries.finding.naming import SYNONYM, called, looser, name_score, tiers, why_named
from list3r.queries.finding.ordering import ordered, sized
from list3r.queries.finding.related import PhraseMatch, PhraseSearch, related
from list3r.queries.finding.words import STRUCTURE, no_such_words, wanted_words
from list3r.queries.match import Filters, Match, Matches, checked_count, checked_instance, of_one_state
from list3r.queries.relations import Place, viewer_from
from list3r.queries.rooms import room_of, rooms_of
from list3r.queries.views.gather import Gathered, gather, is_large, sample

_EQUAL = 0.02
"""Difference of two scores below which two answers are equally good."""
_PERHAPS = 0.4
"""How well what is known by its kind alone answers for one name of that kind."""
_LOOK = 0.8
"""Most that likeness to words counts."""
_MOST_LABELLED = 1_000
"""Instances with all words of a question that are looked at for their label."""
_HOLDING = ("on", "in", "attached_to")
_COMMON = 5_000
"""Instances of one name from which those near a place are looked for around it."""
_NEAREST = "nothing fits; these are the nearest by "


class Found(Matches):
    """Ranked answers; `notes` name words without a match, unknown relations, and how many answers are equal."""

    def __init__(
        self,
        matches: Iterable[Match] = (),
        notes: Sequence[str] = (),
        unknown_words: Sequence[str] = (),
        total: int | None = None,
    ) -> None:
        super().__init__(matches, notes, total)
        self.unknown_words = tuple(dict.fromkeys(unknown_words))
        """Words that no instance of the memory has."""
        self.exact = True
        """False where nothing fits, and the matches are only the nearest by meaning or look."""
        self.counted: int | None = None
        """How many there are, for a question that asks so; None too where the memory cannot know it."""
        self.answer: str | None = None
        """yes or no, for a question that asks so; None too where the memory cannot know it."""
        self.mentioned: dict[int, float] = {}
        """Ids of all that the question names, the table of "mug on the table" too, with how well."""

    @property
    def ambiguous(self) -> bool:
        """Whether the second answer is as good as the first."""
        return len(self) > 1 and self[0].score - self[1].score < _EQUAL

    def facts(self) -> dict[str, object]:
        """Return what is said of the answer as a whole, for machines."""
        return {
            "total": self.total,
            "count": self.counted,
            "answer": self.answer,
            "exact": self.exact,
            "ambiguous": self.ambiguous,
            "unknown_words": self.unknown_words,
        }


@of_one_state
def find(
    store: Store, text: str, k: int = 5, *, viewpoint: Place | None = None, encoder: WordEncoder | None = None
) -> Found:
    """Answer a question: "white mug on table", "how many chairs are there?", "where did I leave the remote control?".

    A name is matched with labels first, then by other names of the same thing, then by kinds of it, then by use; only
    the first of these that names anything counts, and `reason` says which. Small and large are relative to the other
    instances of the kind; every relation must hold. Where nothing fits, the nearest by meaning, or with an `encoder` of
    a space that the memory holds by look, come back with a low score, and `exact` is False; the `notes` name the words
    that no instance has and the relations that the memory cannot know. Left, right, front and behind are judged from
    `viewpoint` (see `relations.Place`) or from where the question says, otherwise in the picture that shows the other
    instance best. The score is how well the words match times how sure the relations are. Raises `OptionError` for a
    text without a letter or digit.
    """
    k = checked_count(k)
    question = parse(text)
    if viewpoint is not None:
        viewer_from(store, viewpoint)
    found = _by_words_alone(store, question, k) if viewpoint is None else None
    if found is None:
        found = _labelled(store, question, k) or _asked(store, question, k, viewpoint, encoder)
    unsure = question.kind in ("count", "exists") and not found.exact and _may_be(store, question, viewpoint)
    if question.kind == "count":
        found.counted = found.total if found.exact else None if unsure else 0
    found.answer = None if unsure else found.answer
    if question.kind in ("where", "room") and found.exact:
        found[:] = [_placed(store, m) for m in found]
    found.mentioned |= {m.instance.id: m.score for m in found}
    found.notes = tuple(dict.fromkeys((*found.notes, *question.notes)))
    return found


def _may_be(store: Store, question: Question, viewpoint: Place | None) -> bool:
    """Tell whether all but the name fits something with a broader one: a cup on the table may be a mug."""
    for phrase in question.phrases:
        for kind in dict.fromkeys(k for m in phrase.meant for k in kinds_of(m)):
            wider = replace(phrase, noun=tuple(split_words(kind)), meant=(kind,))
            if any(kind in called(c.instance) for c in meant(store, wider, viewpoint)[0]):
                return True
    return False


def _labelled(store: Store, question: Question, k: int) -> Found | None:
    """Return what bears the whole text as its label, where the text could mean more than a name: "left shoe"."""
    words = split_words(question.text)
    if question.kind != "which" or len(words) < 2 or question.phrases == (_plain(question.phrases[0]),):
        return None
    bearing = store.instances.of(store.words.bearing(words, _MOST_LABELLED)[0].tolist())
    named = [i for i in bearing if i.state != "removed" and split_words(i.label or "") == words]
    matches = [Match(i, 1.0, None, None, f"named {i.label}") for i in named[:k]]
    return Found(matches, (), (), len(named)) if named else None


def _plain(phrase: Phrase) -> Phrase:
    """Return what a phrase is without relations, sizes, orders and uses."""
    return Phrase(phrase.text, phrase.words, phrase.noun, phrase.meant)


def _asked(store: Store, question: Question, k: int, viewpoint: Place | None, encoder: WordEncoder | None) -> Found:
    notes: list[str] = []
    unknown: list[str] = []
    mentioned: dict[int, float] = {}
    if question.seen_from is not None and viewpoint is None:
        seen_from, _ = meant(store, question.seen_from)
        viewpoint = seen_from[0].instance.id if seen_from else None
        if not seen_from:
            notes.append(f"no instance matches {question.seen_from.text!r} to look from")
    best: dict[int, PhraseMatch] = {}
    fits: list[bool] = []
    undecided = by_look = False
    order = question.phrases[0].order if all(p.order is None for p in question.phrases[1:]) else None
    shared = order if len(question.phrases) > 1 else None
    for phrase in question.phrases:
        asked = replace(phrase, order=None) if shared else phrase
        found, search = meant(store, asked, viewpoint, encoder)
        fits.append(_fits(store, question, phrase, len(found)) and not search.by_look)
        strange = phrase.meant and any(w in search.unknown and w not in adjectives() for w in phrase.words)
        undecided, by_look = undecided or search.undecided or bool(strange), by_look or search.by_look
        notes += search.notes
        unknown += search.unknown
        mentioned |= search.mentioned
        for c in found:
            if c.instance.id not in best or best[c.instance.id].score < c.score:
                best[c.instance.id] = c
    if shared is not None and best:  # which is larger, the sofa or the armchair
        best = {c.instance.id: c for c in ordered(search, list(best.values()), shared, [])}
    exact = bool(best) and not by_look
    best = (_perhaps(store, question, viewpoint) if exact else {}) | best
    if not any(_says_something(p) for p in question.phrases) and question.kind == "which":
        return Found((), ["say what to look for, such as: white mug on table"])
    if not best:
        best = _nearest_by_meaning(store, question.phrases, encoder)
    ranked = sorted(best.values(), key=lambda c: (-c.score, -c.instance.confidence, c.instance.id))
    matches = [Match(c.instance, round(c.score, 4), None, None, _reason(c)) for c in ranked[:k]]
    out = Found(matches, notes, unknown, len(ranked))
    out.exact, out.mentioned = exact, mentioned
    if question.kind == "exists":
        yes = all(fits) if question.every else any(fits)
        out.answer = "yes" if yes else None if undecided else "no"
    if len(ranked) > 1 and exact:
        equal = sum(c.score > ranked[0].score - _EQUAL for c in ranked)
        if equal > 1 and out.ambiguous and question.kind != "count":
            out.notes = (*out.notes, f"{equal} instances match equally well; add words to tell them apart")
    if not exact and ranked:
        out.notes = (*out.notes, _NEAREST + ("look" if by_look else "meaning"))
    return out


def _perhaps(store: Store, question: Question, viewpoint: Place | None) -> dict[int, PhraseMatch]:
    """Return what may be meant, for nothing but its kind is known: the "seat" that can be a chair."""
    asked = [p for p in question.phrases if p.meant and p.order is None and p.use is None]
    named = store.detected_labels.all() if asked and question.kind == "which" else {}
    branches = {n: d.label for n, d in named.items() if d.level == "branch"}
    out = {}
    for phrase in asked:
        for kind in sorted(set(branches.values()).intersection(*map(kinds_of, phrase.meant))):
            found, _ = meant(store, replace(phrase, noun=tuple(split_words(kind)), meant=(kind,)), viewpoint)
            why = f"may be a {phrase.meant[0]}: all that is known is that it is a {kind}"
            for c in (c for c in found if branches.get(c.instance.id) == kind):
                out[c.instance.id] = PhraseMatch(c.instance, c.score * _PERHAPS, (*c.reasons[1:], why))
    return out


def _fits(store: Store, question: Question, phrase: Phrase, count: int) -> bool:
    """Whether so many are enough for a yes."""
    if question.all_of and phrase.noun:
        return count == len(meant(store, Phrase(phrase.text, (), phrase.noun, phrase.meant))[0]) > 0
    return question.at_least <= count and (question.at_most is None or count <= question.at_most)


def _says_something(phrase: Phrase) -> bool:
    return phrase != Phrase("anything")


def _reason(c: PhraseMatch) -> str:
    return "; ".join(r for r in c.reasons if r) or "any instance"


def _placed(store: Store, m: Match) -> Match:
    """Return a match whose reason says what holds it and when it was seen last."""
    i = m.instance
    held = [r for r in store.relations.all(i.id, None, None) if r.predicate in _HOLDING]
    room = room_of(store, i.id)
    parts = [m.reason] if room is None or f"in {title(room)}" in m.reason else [m.reason, f"in {title(room)}"]
    if held:
        best = max(held, key=lambda r: r.confidence)
        o = store.instances.get(best.object)
        parts.append(f"{best.predicate.replace('_', ' ')} #{o.id} {o.label or o.description}")
    if i.best_view is not None:
        parts.append(f"last seen at {i.last_seen_s:.1f} s")
    return replace(m, reason="; ".join(parts))


def _nearest_by_meaning(store: Store, phrases: Iterable[Phrase], encoder: WordEncoder | None) -> dict[int, PhraseMatch]:
    """Return the nearest to what was asked for where nothing fits, with scores that say so."""
    for phrase in phrases:
        for other, score, why in looser(phrase):
            found, search = meant(store, other, None, encoder)
            if found and not search.by_look:
                return {c.instance.id: PhraseMatch(c.instance, c.score * score, (*c.reasons, why)) for c in found}
    return {}


def named_by(
    store: Store, words: str, filters: Filters, encoder: WordEncoder | None, notes: list[str]
) -> list[tuple[Instance, float, str]]:
    """Return what words mean that passes the filters, with how well and why, for `nearest`."""
    phrases, found = [p for p in parse(words).phrases if _says_something(p)], dict[int, PhraseMatch]()
    for phrase in phrases:
        matches, search = meant(store, phrase, encoder=encoder)
        notes += search.notes
        for c in (c for c in matches if filters.passes(c.instance)):
            found.setdefault(c.instance.id, c)
    if not found:
        nearest = _nearest_by_meaning(store, phrases, encoder)
        found = {n: c for n, c in nearest.items() if filters.passes(c.instance)}
        notes += [_NEAREST + "meaning"] if found else []
    return [(c.instance, round(c.score, 4), _reason(c)) for c in found.values()]


def only_common(store: Store, words: str) -> bool:
    """Tell whether the words only name, and so many have them that it is better to look around than at all of them."""
    if not is_large(store) or any(p != _plain(p) for p in parse(words).phrases):
        return False
    return len(store.words.bearing(wanted_words(words), _COMMON + 1)[0]) > _COMMON


def _by_words_alone(store: Store, question: Question, k: int) -> Found | None:
    """Return what words alone name in a large memory, of which only the answers are read; None for all other
    questions, and where no instance has the words.
    """
    phrase = question.phrases[0]
    if question.kind != "which" or question.phrases != (_plain(phrase),) or phrase.generic or not is_large(store):
        return None
    if len(phrase.meant) > 1:
        return None
    words = (*phrase.words, *map(kind_word, phrase.meant)) if phrase.meant else phrase.all_words
    gathered = Gathered(store)
    ids, hundredths = gathered.named(words)
    total = dict(zip(ids.tolist(), hundredths.tolist(), strict=True))
    ranks = store.instances.ranks(ids)
    ranks = ranks.among(~ranks.removed)
    if STRUCTURE.isdisjoint(phrase.all_words) and not ranks.structure.all():
        ranks = ranks.among(~ranks.structure)
    if len(ranks.ids) == 0:
        return None
    spent = np.array([total[n] for n in ranks.ids.tolist()])
    if phrase.meant:
        spent = spent - _of_other_names(gathered, phrase, ranks.ids)
    scores = spent / (100 * len(words))
    order = np.lexsort((ranks.ids, -ranks.confidence, -scores))[:k]
    best = store.instances.of(ranks.ids[order].tolist())
    score = dict(zip(ranks.ids[order].tolist(), scores[order].tolist(), strict=True))
    matches = [Match(i, round(score[i.id], 4), None, None, why_named(phrase, i, kind=False)) for i in best]
    equal = int((scores > scores.max() - _EQUAL).sum())
    notes = [f"{equal} instances match equally well; add words to tell them apart"] if equal > 1 and k > 1 else []
    return Found(matches, (*gathered.notes, *notes), (), len(ranks.ids))


def _of_other_names(gathered: Gathered, phrase: Phrase, ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the hundredths by which those are worse that are named by another word of the same meaning."""
    key = kind_word(phrase.meant[0])
    by_name, (known, weight) = gathered.bearers((*phrase.noun, key))[0], gathered.bearers((key,))
    if len(by_name) == len(known):
        return np.zeros(len(ids), np.int64)
    order = np.argsort(known)
    named = weight[order][np.searchsorted(known[order], ids)].astype(np.int64)
    return np.where(np.isin(ids, by_name), 0, np.maximum(0, named - round(100 * SYNONYM)))


# ---------------------------------------------------------------------------------------------- phrases


def meant(
    store: Store, phrase: Phrase, viewpoint: Place | None = None, encoder: WordEncoder | None = None
) -> tuple[list[PhraseMatch], PhraseSearch]:
    """Return all that a phrase means, the best first, and the search with its notes and unknown words."""
    gathered = gather(store, phrase)
    if gathered is None:  # looser names are tried on the same
        loaded = store.current.get("words", lambda: _with_words(store.instances.all()))
    else:
        loaded = _with_words(store.instances.of(sorted(gathered.ids)))
    looked_at = [(i, words) for i, words in loaded if i.state != "removed" or phrase.change]
    things, words = {i.id: i for i, _ in looked_at}, {i.id: w for i, w in looked_at}
    search = PhraseSearch(store, things, words, encoder, viewpoint, gathered)
    search.notes += [] if gathered is None else gathered.notes
    found = sorted(_meaning(search, phrase), key=lambda c: (-c.score, -c.instance.confidence, c.instance.id))
    return found, search


def _meaning(search: PhraseSearch, phrase: Phrase) -> list[PhraseMatch]:
    """Return what a phrase means: words, then relations, then size and order among what is left."""
    found = _numbered(search, phrase) if phrase.instance_id is not None else _named(search, phrase)
    if phrase.change is not None:
        found = _changed(search, found, phrase.change)
    if phrase.size is not None:
        found = sized(search, found, phrase)
    for clause in phrase.where:
        if not found and clause.predicates != (IN_ROOM,):
            # The rest is searched all the same, so that all words without a match are named.
            _meaning(search, clause.object)
            if clause.other:
                _meaning(search, clause.other)
            continue
        if clause.predicates == (IN_ROOM,):
            found = _in_room(search, found, clause)
            continue
        ends = _meaning(search, clause.object), _meaning(search, clause.other) if clause.other else []
        if not clause.negated:
            found = related(search, found, clause, ends, phrase.text)
            continue
        hit = related(search, found, clause, ends, phrase.text, silent=True) if clause.predicates else ends[0]
        gone = {c.instance.id for c in hit}
        found = [
            PhraseMatch(c.instance, c.score, (*c.reasons, f"not {clause.object.text}"))
            for c in found
            if c.instance.id not in gone
        ]
    if phrase.order is not None and found:
        to = _meaning(search, phrase.order.to) if phrase.order.to is not None else []
        found = ordered(search, found, phrase.order, to)
    return found


def _in_room(search: PhraseSearch, found: list[PhraseMatch], clause: Clause) -> list[PhraseMatch]:
    """Return what is in the rooms of a name, or what is not; all of it, with a note, where no room is called so."""
    try:
        rooms = rooms_of(search.store, clause.object.text)
    except OptionError as error:
        search.notes.append(f"{error}: {clause.object.text!r} was left out")
        return found
    home = {n: r for r in rooms for n in r.instances}
    if clause.negated:
        return [c for c in found if c.instance.id not in home]
    inside = [c for c in found if c.instance.id in home]
    return [replace(c, reasons=(*c.reasons, f"in {title(home[c.instance.id])}")) for c in inside]


def _numbered(search: PhraseSearch, phrase: Phrase) -> list[PhraseMatch]:
    """Return the instance of a number, if it bears the words too."""
    try:
        i = checked_instance(search.store, phrase.instance_id or 0)
    except UnknownIdError as error:
        search.notes.append(str(error))
        return []
    if not _bears(search, i.id, phrase.all_words):
        search.notes.append(f"#{i.id} is not named {' '.join(phrase.all_words)}")
        return []
    return [PhraseMatch(i, 1.0, (f"#{i.id}",))]


def _changed(search: PhraseSearch, found: list[PhraseMatch], kind: str) -> list[PhraseMatch]:
    """Return those that a session showed to have changed so, the newest change of each."""
    kinds = ("moved", "removed", "added") if kind == "changed" else (kind,)
    newest = {c.instance.id: c for c in reversed(changes(search.store, None, kinds))}
    out = [(c, newest[c.instance.id]) for c in found if c.instance.id in newest]
    if not out:
        search.notes.append(f"no session shows that anything of this was {kind}")
    return [PhraseMatch(c.instance, c.score * e.score, (*c.reasons, f"{e.event.kind}: {e.reason}")) for c, e in out]


def _with_words(instances: Iterable[Instance]) -> list[tuple[Instance, dict[str, float]]]:
    return [(i, _vocabulary(i)) for i in instances]


def _vocabulary(i: Instance) -> dict[str, float]:
    """Return words that an instance has, with how well each names it."""
    return vocabulary(i.label, i.structure, i.description, i.color_name)


def _named(search: PhraseSearch, phrase: Phrase) -> list[PhraseMatch]:
    """Return what has the words of a phrase, by the first of its meanings that names anything."""
    unknown = _unknown(search, phrase)
    if unknown:
        by_vector = _by_vector(search, phrase)
        if by_vector is not None:
            search.by_look = True
            return by_vector
        search.unknown += unknown
        named = search.things.values() if search.gathered is None else sample(search.store)
        search.notes.append(no_such_words(unknown, named))
        return []
    bound = not STRUCTURE.isdisjoint((*phrase.all_words, *phrase.meant))
    if phrase.generic:
        things = [i for i in search.things.values() if not _bounds(i)]
        return [PhraseMatch(i, 1.0) for i in things]
    for nouns in tiers(phrase):
        out = []
        for n, i in search.things.items():
            score = _score(search, n, phrase, nouns)
            if score > 0.0:
                out.append(PhraseMatch(i, score, (why_named(phrase, i, kind=nouns != phrase.meant),)))
        kept = [c for c in out if bound or not _bounds(c.instance)]
        if kept or out:
            search.mentioned |= {c.instance.id: c.score for c in kept or out}
            return kept or out
    if phrase.use is not None:
        search.notes.append(f"no instance is known to be for this: {phrase.use}")
    elif len(phrase.all_words) > 1:
        said = ", ".join(repr(w) for w in phrase.all_words)
        search.notes.append(f"no instance matches all of the words {said}")
    return []


def _score(search: PhraseSearch, n: int, phrase: Phrase, nouns: tuple[str, ...]) -> float:
    """Return the mean of how well each word, and the name, fit an instance; 0 where one does not."""
    vocabulary = search.vocabulary[n]
    if not phrase.meant:
        return _mean([vocabulary.get(w, 0.0) for w in phrase.all_words])
    return _mean([*(vocabulary.get(w, 0.0) for w in phrase.words), name_score(phrase, vocabulary, nouns)])


def _mean(scores: list[float]) -> float:
    return sum(scores) / len(scores) if min(scores) > 0.0 else 0.0


def _bounds(i: Instance) -> bool:
    """Whether it bounds the room, as structure or by its label."""
    return i.structure is not None or not STRUCTURE.isdisjoint(called(i))


def _unknown(search: PhraseSearch, phrase: Phrase) -> list[str]:
    """Return words that no instance has."""
    keys = [kind_word(n) for nouns in tiers(phrase) for n in nouns]
    words = phrase.words if phrase.meant else phrase.all_words
    if search.gathered is not None:
        known = search.store.words.known((*words, *keys))
    else:
        wanted = {*words, *keys}
        known = {w for v in search.vocabulary.values() for w in wanted & v.keys()}
    out = [w for w in words if w not in known]
    return out + (list(phrase.noun) if phrase.noun and keys and known.isdisjoint(keys) else [])


def _bears(search: PhraseSearch, n: int, words: Sequence[str]) -> bool:
    return all(w in search.vocabulary[n] for w in words)


def _by_vector(search: PhraseSearch, phrase: Phrase) -> list[PhraseMatch] | None:
    """Return instances by the likeness of their vectors to the phrase; None where no vectors of the encoder's space are
    there."""
    if search.encoder is None:
        return None
    text = " ".join(phrase.all_words)
    try:
        cosine = named_by_vectors(search.store, search.encoder, text)
    except OptionError as error:  # the memory has come to a machine without the model's weights
        search.notes.append(f"free words cannot be compared: {error}")
        return None
    if cosine is None:
        return None
    if search.gathered is not None:
        _look_at_too(search, list(cosine))
    return [
        PhraseMatch(search.things[n], min(c, _LOOK), (like(text, c, search.encoder.space),))
        for n, c in cosine.items()
        if n in search.things and search.things[n].structure is None
    ]


def _look_at_too(search: PhraseSearch, ids: Sequence[int]) -> None:
    fresh = search.store.instances.of([n for n in ids if n not in search.things])
    for i in (i for i in fresh if i.state != "removed"):
        search.things[i.id], search.vocabulary[i.id] = i, _vocabulary(i)
