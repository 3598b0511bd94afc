"""What instances are called by detectors and by discoverers with class names: votes kept for local instances.

Votes are log odds that add up, kept for each local instance and each source, so that labels follow
whatever becomes of the groups, and a source that looks again replaces what it said itself and nothing else. An
operator's word always wins, a name that an operator took away stays away, and structure is never named.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from list3r.memory.core.constraints import Key
from list3r.memory.core.description.nouns import is_a, kinds_of, nouns_of
from list3r.memory.core.records import DetectedLabel, Instance, Votes
from list3r.memory.core.settings import stored_settings
from list3r.memory.store.store import Store

_SCORES = (0.02, 0.98)
"""No score of a discoverer is taken for less or more than this."""
PRIOR_ODDS = math.log(0.02 / 0.98)
"""Log odds that an instance is of a given class before anything is seen: some fifty kinds of instances stand in
rooms."""


@dataclass(frozen=True)
class LabelSettings:
    """When votes make a label."""

    min_found: float = 1.2
    """Independent pictures in which the class was found, weighted by how well they see the instance: one is not
    enough."""
    min_confidence: float = 0.5
    """Probability of the class."""
    min_detected: float = 0.8
    """The same where other sources than the learned discoverer name it: of a detector's 15 names in the red kitchen the
    four wrong ones had 0.58 to 0.78, the right ones 0.77 to 0.97."""
    min_own: float = 0.63
    """The same where only the learned discoverer names it: 0.65 of what it says, the highest at which 0.6 of the things
    of left-out rooms are named (decision 0144)."""
    min_branch: float = 0.95
    """Probability of a kind of things ("seat") where no name is probable enough: those of the names in it, summed."""
    likeness: float = 0.4
    """Correlation of what a detector says in two pictures of one instance: n pictures say as much as n / (1 + likeness
    (n - 1)) of different ones would, never more than 1 / likeness (decision 0024)."""
    always_wrong: float = 0.03
    """A detector may be wrong in the same way in every picture; no label is surer than one less this."""


def put_votes(
    store: Store,
    chunk_id: int,
    source: str,
    votes: Mapping[int, Votes],
    class_names: Iterable[str] | None = None,
) -> None:
    """Keep what a source saw of a chunk, instead of what the same one saw before. Call inside `transaction()`.

    `class_names` are the classes that it knows, where that is a closed list: it says nothing against others.
    """
    store.votes.put(
        chunk_id,
        source,
        {
            n: Votes(
                round(v.missed, 4),
                {c: (round(a, 4), round(b, 4)) for c, (a, b) in v.classes.items()},
                round(v.looks, 4),
            )
            for n, v in votes.items()
        },
    )
    known = dict(store.facts.label_classes or {})
    names = None if class_names is None else sorted(class_names)
    if source not in known or known[source] != names:
        store.facts.label_classes = {**known, source: names}


def votes_of_names(names: Iterable[tuple[str, float]]) -> Votes:
    """Return what a discoverer with class names says of a local instance, from its names and scores on the anchors.

    A score is taken for the probability of the class; anchors that follow one another see nearly the same view with the
    same mistakes, so each has half a voice.
    """
    classes: dict[str, tuple[float, float]] = {}
    looks = 0.0
    for name, score in names:
        looks += 0.5
        p = min(max(score, _SCORES[0]), _SCORES[1])
        classes[name] = _plus(classes.get(name, (0.0, 0.0)), (0.5, 0.5 * (math.log(p / (1.0 - p)) - PRIOR_ODDS)))
    return Votes(0.0, classes, looks)


OWN_NAMES = "learned"
"""The source of names that the learned discoverer tells; every other source overrules it."""
_OWN_LOOKS = 1.5
"""Pictures that all views of a chunk together count as, where their names were pooled already. One network judges the
same thing in every chunk, with the same mistakes: several chunks are as sure as they are in the mean, no surer."""


def votes_of_probabilities(named: Iterable[tuple[str, float]], likeness: float = LabelSettings.likeness) -> Votes:
    """Return votes by which `decide`, hearing nothing else, gives names the probabilities that they have here."""
    rest = max(1.0 - sum(p for _, p in named), _SCORES[0])
    scale = 1.0 + likeness * (_OWN_LOOKS - 1.0)
    classes = {name: (_OWN_LOOKS, scale * (math.log(max(p, _SCORES[0] / 10) / rest) - PRIOR_ODDS)) for name, p in named}
    return Votes(0.0, classes, _OWN_LOOKS)


def decide(
    votes: Mapping[str, Votes],
    known: Mapping[str, Collection[str] | None] | None = None,
    settings: LabelSettings | None = None,
) -> tuple[str, float, float] | None:
    """Return (class, its probability, frames in which it was found), None where no class is likely enough.

    `votes` are those of each source, `known` the classes that each knows, None or absent for one that speaks of every
    class. The classes exclude one another and all of them may be wrong, which has the odds of 1.
    """
    s = settings or LabelSettings()
    probable = _probabilities(votes, known, s)
    if not probable:
        return None
    best = min(probable, key=lambda c: (-probable[c][0], c))
    confidence, found = probable[best]
    return (best, confidence, found) if confidence >= s.min_confidence and found >= s.min_found else None


def decide_kind(
    votes: Mapping[str, Votes],
    known: Mapping[str, Collection[str] | None] | None = None,
    settings: LabelSettings | None = None,
) -> tuple[str, float, float] | None:
    """Return what `decide` does for the narrowest kind of thing that is probable enough: "seat" of chair and stool.

    A kind is as probable as all names in it together.
    """
    s = settings or LabelSettings()
    kinds: dict[str, tuple[float, float]] = {}
    for name, (p, found) in sorted(_probabilities(votes, known, s).items()):
        noun = next(iter(nouns_of(name)), None)
        for kind in () if noun is None else dict.fromkeys((noun, *kinds_of(noun))):
            total, most = kinds.get(kind, (0.0, 0.0))
            kinds[kind] = total + p, max(most, found)
    sure = [k for k, (p, found) in kinds.items() if p >= s.min_branch and found >= s.min_found]
    if not sure:
        return None
    best = min(sure, key=lambda k: (-len(kinds_of(k)), -kinds[k][0], k))
    return (best, *kinds[best])


def _probabilities(
    votes: Mapping[str, Votes], known: Mapping[str, Collection[str] | None] | None, s: LabelSettings
) -> dict[str, tuple[float, float]]:
    """Return by class its probability and in how many pictures it was found."""
    odds: dict[str, float] = {}
    found: dict[str, float] = {}
    for name in sorted({c for v in votes.values() for c in v.classes}):
        said = [_said(v, name, source, (known or {}).get(source), s.likeness) for source, v in sorted(votes.items())]
        odds[name] = PRIOR_ODDS + sum(evidence for _, evidence in said)
        found[name] = sum(pictures for pictures, _ in said)
    top = max(0.0, *odds.values()) if odds else 0.0
    total = math.exp(-top) + sum(math.exp(v - top) for v in odds.values())
    return {c: ((1.0 - s.always_wrong) * math.exp(v - top) / total, found[c]) for c, v in odds.items()}


def decide_by_rank(
    votes: Mapping[str, Votes],
    known: Mapping[str, Collection[str] | None] | None = None,
    settings: LabelSettings | None = None,
) -> tuple[str, float, float] | None:
    """Return what `decide` says of all sources but the learned discoverer, and of that one where they name nothing."""
    s = settings or LabelSettings()
    others = {source: v for source, v in votes.items() if source != OWN_NAMES}
    own = {source: v for source, v in votes.items() if source == OWN_NAMES}
    return decide(others, known, replace(s, min_confidence=max(s.min_confidence, s.min_detected))) or decide(
        own, known, replace(s, min_confidence=max(s.min_confidence, s.min_own))
    )


def _said(votes: Votes, name: str, source: str, known: Collection[str] | None, likeness: float) -> tuple[float, float]:
    """Return pictures in which a source found a class, and its log odds for it; one that it does not know is not
    missed.
    """
    found, got = votes.classes.get(name, (0.0, 0.0))
    missed = votes.missed if known is None or name in known else 0.0
    chunks = max(votes.looks / _OWN_LOOKS, 1.0) if source == OWN_NAMES else 1.0
    return found, (got - missed) / chunks / (1.0 + likeness * max(votes.looks / chunks - 1.0, 0.0))


def label_source(instance: Instance, detected: DetectedLabel | None) -> dict[str, Any]:
    """Return who gave an instance its label and how sure that is, for JSON; nothing for one without a label."""
    if instance.label is None:
        return {}
    if detected is None:
        return {"label_source": "operator", "label_confidence": 1.0, "label_level": "leaf"}
    return {
        "label_source": detected.detector,
        "label_confidence": round(detected.confidence, 4),
        "label_level": detected.level,
    }


def apply_labels(
    store: Store, settings: LabelSettings | None = None, written: Collection[int] | None = None
) -> dict[int, DetectedLabel]:
    """Name the instances by what detectors saw of them; what was named so before and is not any more loses its name.

    `written` are the ids that were written anew or are gone since, where only those need it; the labels of those are
    returned. Nothing is done to a memory that no detector looked at. Call inside `transaction()`, after the library was
    derived.
    """
    known = store.facts.label_classes
    if known is None:
        return {}
    settings = settings or stored_settings(store, LabelSettings, "library", "labels")
    before = store.detected_labels.all()
    instances = store.instances.all() if written is None else store.instances.of(sorted(written))
    members: dict[int, list[Key]] = {i.id: [] for i in instances}
    for o in store.observations.all():
        if o.instance_id in members:
            members[o.instance_id].append((o.chunk_id, o.local_id))
    home = {key: n for n, keys in members.items() for key in keys}
    votes = {chunk_id: store.votes.of(chunk_id) for chunk_id in sorted({k for k, _ in home})}
    spoken = _named_by_operators(store, home)
    out: dict[int, DetectedLabel] = {}
    changed: dict[int, str | None] = {}
    for i in instances:
        if i.id in spoken:
            continue
        label = None if i.structure is not None else _label(members[i.id], votes, known, settings)
        if label is not None:
            out[i.id] = label
        text = None if label is None else label.label
        if i.label != text and (text is not None or i.id in before):
            changed[i.id] = text
    store.instances.set_labels(changed)
    store.detected_labels.replace(
        {n: replace(d, confidence=round(d.confidence, 4), found=round(d.found, 2)) for n, d in out.items()},
        None if written is None else written,
    )
    return out


def _add(total: dict[str, Votes], votes: Mapping[str, Mapping[int, Votes]], local_id: int) -> None:
    for source, found in votes.items():
        if local_id in found:
            total[source] = total.get(source, Votes(0.0, {})) + found[local_id]


def _label(
    keys: Iterable[Key],
    votes: Mapping[int, Mapping[str, Mapping[int, Votes]]],
    known: Mapping[str, Collection[str] | None],
    settings: LabelSettings | None,
) -> DetectedLabel | None:
    total: dict[str, Votes] = {}
    for chunk_id, local_id in sorted(keys):
        _add(total, votes.get(chunk_id, {}), local_id)
    leaf = decide_by_rank(total, known, settings)
    chosen = leaf or decide_kind(total, known, settings)
    if chosen is None:
        return None
    name, confidence, pictures = chosen
    said = [s for s in sorted(total) if any(name == c or (leaf is None and is_a(c, name)) for c in total[s].classes)]
    return DetectedLabel(name, confidence, pictures, ", ".join(said), "branch" if leaf is None else "leaf")


def _named_by_operators(store: Store, home: Mapping[Key, int]) -> Collection[int]:
    """Return instances of which an operator said what they are called, or that they are called nothing."""
    return {home[k] for keys, _ in store.edits.constraints().labels for k in keys if k in home}


def _plus(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    return a[0] + b[0], a[1] + b[1]
