"""Precision and recall of relations between objects that were found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from list3r.memory.core.records import JsonFields

Triple = tuple[int, str, int]


@dataclass(frozen=True)
class PredicateErrors:
    """Agreement on one predicate, or on all."""

    true_count: int
    estimated_count: int
    correct: int
    precision: float | None
    """None where nothing was claimed."""
    recall: float | None
    """None where nothing was to be found."""


@dataclass(frozen=True)
class RelationErrors(JsonFields):
    """Relations over matched objects: relations of unmatched objects are ignored."""

    total: PredicateErrors
    by_predicate: dict[str, PredicateErrors]
    wrong: tuple[Triple, ...]
    """Claimed, in the ids of the truth, but not true."""
    missed: tuple[Triple, ...]
    """True but not claimed."""


def evaluate_relations(
    truth: Iterable[Triple],
    estimate: Iterable[Triple],
    truth_of: Mapping[int, int],
    predicates: Iterable[str] = ("on", "in", "next_to"),
) -> RelationErrors:
    """Compare (subject, predicate, object) triples of the named predicates.

    `truth_of` maps estimated ids to true ids for the matched objects; relations with any other object are left out on
    both sides, so that a missing object is not punished twice.
    """
    names = tuple(dict.fromkeys(predicates))
    known = set(truth_of.values())
    true = {(s, p, o) for s, p, o in truth if p in names and s in known and o in known}
    claimed = {(truth_of[s], p, truth_of[o]) for s, p, o in estimate if p in names and s in truth_of and o in truth_of}
    by_predicate = {
        name: _agreement({t for t in true if t[1] == name}, {t for t in claimed if t[1] == name}) for name in names
    }
    return RelationErrors(
        total=_agreement(true, claimed),
        by_predicate=by_predicate,
        wrong=tuple(sorted(claimed - true)),
        missed=tuple(sorted(true - claimed)),
    )


def _agreement(true: set[Triple], claimed: set[Triple]) -> PredicateErrors:
    correct = len(true & claimed)
    return PredicateErrors(
        true_count=len(true),
        estimated_count=len(claimed),
        correct=correct,
        precision=correct / len(claimed) if claimed else None,
        recall=correct / len(true) if true else None,
    )
