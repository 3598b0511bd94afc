"""Answers as small plain values: what an agent reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from list3r.memory.core.description.printable import shown
from list3r.memory.core.records import Instance, Relation
from list3r.queries.changes import Changed
from list3r.queries.match import Match

MOST = 100
"""Entries of one page at most."""


def name_of(instance: Instance) -> str:
    """Return what an instance is called: its label, its kind of structure, or its description up to the comma."""
    return shown(instance.label or instance.structure or instance.description.split(",")[0] or "thing")


def numbers(values: ArrayLike) -> list[float | None]:
    """Return a list of finite numbers to a tenth of a millimetre, None for what is none."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    return [round(float(v), 4) + 0.0 if np.isfinite(v) else None for v in flat]


def number(value: float | None) -> float | None:
    """Return one such number."""
    return None if value is None else numbers([value])[0]


def instance_record(instance: Instance) -> dict[str, Any]:
    """Return the line of an instance in a list."""
    out: dict[str, Any] = {
        "id": instance.id,
        "name": name_of(instance),
        "center": numbers(instance.center),
        "size": numbers(instance.box.size),
        "confidence": number(instance.confidence),
    }
    if instance.state != "present":
        out["state"] = instance.state
    return out


def match_record(match: Match) -> dict[str, Any]:
    """Return the line of an answer: the instance with its score, distances and reason."""
    out = {**instance_record(match.instance), "score": number(match.score), "reason": match.reason}
    if match.distance_m is not None:
        out["distance"] = number(match.distance_m)
    if match.center_distance_m is not None:
        out["center_distance"] = number(match.center_distance_m)
    return out


def relation_record(relation: Relation, names: dict[int, str]) -> dict[str, Any]:
    """Return the line of a relation, with the names of what it relates."""
    out: dict[str, Any] = {
        "subject": relation.subject,
        "subject_name": names.get(relation.subject, "?"),
        "predicate": relation.predicate,
        "object": relation.object,
        "object_name": names.get(relation.object, "?"),
        "confidence": number(relation.confidence),
    }
    other = getattr(relation, "other", None)
    return out if other is None else {**out, "other": other, "other_name": names.get(other, "?")}


def change_record(change: Changed) -> dict[str, Any]:
    """Return the line of a change: what happened to which instance, from where to where."""
    event = change.event
    return {
        "id": change.instance.id,
        "name": name_of(change.instance),
        "session": event.session_id,
        "kind": event.kind,
        "from": None if event.from_box is None else numbers(event.from_box.center),
        "to": None if event.to_box is None else numbers(event.to_box.center),
        "distance": number(change.distance_m),
        "confidence": number(event.confidence),
        "reason": event.reason,
    }


def page(
    entries: Sequence[Any], units: str, limit: int = MOST, offset: int = 0, notes: Sequence[str] = ()
) -> dict[str, Any]:
    """Return a page of matches with unit and notes, how many there are in all, and where the next page begins."""
    limit, offset = min(max(limit, 1), MOST), max(offset, 0)
    end = offset + limit
    more = {"next_offset": end} if end < len(entries) else {}
    matches = list(entries[offset:end])
    return {"units": units, "total": len(entries), "matches": matches, "notes": list(notes), **more}
