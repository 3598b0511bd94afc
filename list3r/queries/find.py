"""Find instances by a phrase: attributes, a noun and relations to other instances; see `grammar`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from list3r.memory.description.words import vocabulary
from list3r.memory.errors import OptionError
from list3r.memory.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.finding.free_words import WordEncoder, like, named_by_vectors
from list3r.queries.finding.grammar import SIZES, SUPERLATIVES, Phrase, parse
from list3r.queries.finding.related import PhraseMatch, PhraseSearch, related
from list3r.queries.finding.words import STRUCTURE, no_such_words
from list3r.queries.match import Match, Matches, checked_count, checked_instance, of_one_state
from list3r.queries.relations import Place, viewer_from
from list3r.queries.views.gather import Gathered, gather, is_large, sample

_EQUAL = 0.02
"""Difference of two scores below which two answers are equally good."""
_ALIKE = 0.1
"""Sizes that differ by less than this share are equally the biggest."""


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

    @property
    def ambiguous(self) -> bool:
        """Whether the second answer is as good as the first."""
        return len(self) > 1 and self[0].score - self[1].score < _EQUAL


@of_one_state
def find(
    store: Store, text: str, k: int = 5, *, viewpoint: Place | None = None, encoder: WordEncoder | None = None
) -> Found:
    """Find the instances that a text describes, the best first: "white mug on table", "chair next to 12".

    Every word must occur in the label, kind of structure, description or colour; small and large are relative to the
    other instances of the kind; every relation must hold. Without a match the answer is empty, never a guess: its
    `notes` name the words that no instance has and the relations that the memory cannot know. Left, right, front and
    behind are judged from `viewpoint` (see `relations.Place`), otherwise in the picture that shows the other instance
    best. With an `encoder` of a space that the memory holds, phrases with words that no instance has are compared by
    their vectors. The score is how well the words match times how sure the relations are. Raises `OptionError` for a
    text without sense and `UnknownIdError` for a number that was never an id.
    """
    k = checked_count(k)
    phrase = parse(text)
    if viewpoint is None and (of_words := _by_words_alone(store, phrase, k)) is not None:
        return of_words
    found, search = meant(store, phrase, viewpoint, encoder)
    matches = [
        Match(c.instance, round(c.score, 4), None, None, "; ".join(c.reasons) or "any instance") for c in found[:k]
    ]
    out = Found(matches, search.notes, search.unknown, len(found))
    if out.ambiguous and len(found) > 1:
        equal = sum(c.score > found[0].score - _EQUAL for c in found)
        out.notes = (*out.notes, f"{equal} instances match equally well; add words to tell them apart")
    return out


def _by_words_alone(store: Store, phrase: Phrase, k: int) -> Found | None:
    """Return what words alone name in a large memory, of which only the answers are read; None for all other
    questions, and where no instance has the words.
    """
    words, more = phrase.words, (phrase.where, phrase.size, phrase.superlative)
    if not words or any(more) or phrase.instance_id is not None or not is_large(store):
        return None
    gathered = Gathered(store)
    ids, hundredths = gathered.named(words)
    total = dict(zip(ids.tolist(), hundredths.tolist(), strict=True))
    ranks = store.instances.ranks(ids)
    ranks = ranks.among(~ranks.removed)
    if STRUCTURE.isdisjoint(words) and not ranks.structure.all():
        ranks = ranks.among(~ranks.structure)
    if len(ranks.ids) == 0:
        return None
    scores = np.array([total[n] for n in ranks.ids.tolist()]) / (100 * len(words))
    order = np.lexsort((ranks.ids, -ranks.confidence, -scores))[:k]
    best = store.instances.of(ranks.ids[order].tolist())
    score = dict(zip(ranks.ids[order].tolist(), scores[order].tolist(), strict=True))
    matches = [Match(i, round(score[i.id], 4), None, None, f"named {' '.join(words)}") for i in best]
    equal = int((scores > scores.max() - _EQUAL).sum())
    notes = [f"{equal} instances match equally well; add words to tell them apart"] if equal > 1 and k > 1 else []
    return Found(matches, (*gathered.notes, *notes), (), len(ranks.ids))


# ---------------------------------------------------------------------------------------------- phrases


def meant(
    store: Store, phrase: Phrase, viewpoint: Place | None = None, encoder: WordEncoder | None = None
) -> tuple[list[PhraseMatch], PhraseSearch]:
    """Return all that a phrase may mean, the best first, and the search with its notes and unknown words."""
    if viewpoint is not None:
        viewer_from(store, viewpoint)
    gathered = gather(store, phrase)
    loaded = store.instances.all() if gathered is None else store.instances.of(sorted(gathered.ids))
    things = {i.id: i for i in loaded if i.state != "removed"}
    search = PhraseSearch(store, things, {n: _vocabulary(i) for n, i in things.items()}, encoder, viewpoint, gathered)
    search.notes += [] if gathered is None else gathered.notes
    found = sorted(_meaning(search, phrase), key=lambda c: (-c.score, -c.instance.confidence, c.instance.id))
    return found, search


def _meaning(search: PhraseSearch, phrase: Phrase) -> list[PhraseMatch]:
    """Return what a phrase may mean: words, then relations, then size among what is left."""
    if phrase.instance_id is not None:
        i = checked_instance(search.store, phrase.instance_id)
        found = [PhraseMatch(i, 1.0, (f"#{i.id}",))]
        if not _bears(search, i.id, phrase.words):
            search.notes.append(f"#{i.id} is not named {' '.join(phrase.words)}")
            found = []
    else:
        found = _named(search, phrase)
    if phrase.size is not None:
        found = _sized(search, found, phrase)
    for clause in phrase.where:
        if not found:
            # The rest is searched all the same, so that all words without a match are named.
            _meaning(search, clause.object)
            if clause.other:
                _meaning(search, clause.other)
            continue
        ends = _meaning(search, clause.object), _meaning(search, clause.other) if clause.other else []
        found = related(search, found, clause, ends, phrase.text)
    if phrase.superlative is not None and found:
        found = _extreme(found, phrase.superlative)
    return found


def _vocabulary(i: Instance) -> dict[str, float]:
    """Return words that an instance has, with how well each names it."""
    return vocabulary(i.label, i.structure, i.description, i.color_name)


def _named(search: PhraseSearch, phrase: Phrase) -> list[PhraseMatch]:
    unknown = _unknown(search, phrase.words)
    if unknown:
        by_vector = _by_vector(search, phrase)
        if by_vector is not None:
            return by_vector
        search.unknown += unknown
        named = search.things.values() if search.gathered is None else sample(search.store)
        search.notes.append(no_such_words(unknown, named))
        return []
    structure = not STRUCTURE.isdisjoint(phrase.words) or bool(
        phrase.words
        and not any(_bears(search, n, phrase.words) for n, i in search.things.items() if i.structure is None)
    )
    out = []
    for n, i in search.things.items():
        if (i.structure is None or structure) and _bears(search, n, phrase.words):
            score = sum(search.vocabulary[n][w] for w in phrase.words) / len(phrase.words) if phrase.words else 1.0
            reasons = (f"named {' '.join(phrase.words)}",) if phrase.words else ()
            out.append(PhraseMatch(i, score, reasons))
    if not out and len(phrase.words) > 1:
        search.notes.append("no instance matches all of the words " + ", ".join(repr(w) for w in phrase.words))
    return out


def _unknown(search: PhraseSearch, words: Sequence[str]) -> list[str]:
    """Return words that no instance has."""
    if search.gathered is not None:
        known = search.store.words.known(words)
        return [w for w in words if w not in known]
    return [w for w in words if not any(w in v for v in search.vocabulary.values())]


def _bears(search: PhraseSearch, n: int, words: Sequence[str]) -> bool:
    return all(w in search.vocabulary[n] for w in words)


def _by_vector(search: PhraseSearch, phrase: Phrase) -> list[PhraseMatch] | None:
    """Return instances by the likeness of their vectors to the phrase; None where no vectors of the encoder's space are
    there."""
    if search.encoder is None:
        return None
    text = " ".join(phrase.words)
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
        PhraseMatch(search.things[n], c, (like(text, c, search.encoder.space),))
        for n, c in cosine.items()
        if n in search.things and search.things[n].structure is None
    ]


def _look_at_too(search: PhraseSearch, ids: Sequence[int]) -> None:
    fresh = search.store.instances.of([n for n in ids if n not in search.things])
    for i in (i for i in fresh if i.state != "removed"):
        search.things[i.id], search.vocabulary[i.id] = i, _vocabulary(i)


# ---------------------------------------------------------------------------------------------- sizes


def _sized(search: PhraseSearch, found: list[PhraseMatch], phrase: Phrase) -> list[PhraseMatch]:
    """Return those of a size, relative to the others that fit the words, or to all things where those are fewer than
    four."""
    size = phrase.size
    assert size is not None
    edges = np.array([]) if search.gathered is None else search.gathered.sizes_of(phrase.words)
    if len(edges) == 0:
        among = [c.instance for c in found]
        if len(among) < 4:
            among = [i for i in search.things.values() if i.structure is None] or among
        edges = np.sort([_edge(i) for i in among])
    low, high = SIZES[size]
    out = []
    for c in found:
        rank = float(np.mean(edges < _edge(c.instance)) + 0.5 * np.mean(edges == _edge(c.instance)))
        weight = search.vocabulary[c.instance.id].get(size, 0.0)
        fit = 1.0 - rank if high <= 0.5 else rank if low >= 0.5 else 1.0 - 2.0 * abs(rank - 0.5)
        if weight > 0.0 or low <= rank <= high:
            score = max(weight, 0.5 + 0.5 * fit)
            why = f"{size}: longest edge {_edge(c.instance):.2f}, {1.0 - rank:.0%} of the others are larger"
            out.append(PhraseMatch(c.instance, c.score * score, (*c.reasons, why)))
    return out


def _extreme(found: list[PhraseMatch], superlative: str) -> list[PhraseMatch]:
    """Return the largest or smallest, and what is practically as large."""
    kind = SUPERLATIVES[superlative]
    sizes = [_edge(c.instance) if abs(kind) == 1 else float(np.ptp(c.instance.aabb[:, 2])) for c in found]
    best = max(sizes) if kind > 0 else min(sizes)
    out = []
    for c, size in zip(found, sizes, strict=True):
        share = min(size, best) / max(size, best, 1e-12)
        if share >= 1.0 - _ALIKE:
            what = "longest edge" if abs(kind) == 1 else "height"
            out.append(PhraseMatch(c.instance, c.score * share, (*c.reasons, f"{superlative}: {what} {size:.2f}")))
    return out


def _edge(i: Instance) -> float:
    return float(np.max(i.box.size))
