"""What the questions print."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from list3r.cli.answer import print_answer
from list3r.cli.ask.memory import instance_dict
from list3r.cli.common import in_column, print_table
from list3r.cli.terminal import note, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from list3r.api import SceneMemory
    from list3r.memory.core.records import BestView, Relation
    from list3r.memory.library.world.scale import Lengths
    from list3r.queries.match import Match
    from list3r.queries.relations import Relations


def match_dict(match: Match) -> dict[str, Any]:
    """A match for machines: the instance, and how it answers; `view` only where the question was about a frame."""
    answer = {
        "score": match.score,
        "distance": match.distance_m,
        "center_distance": match.center_distance_m,
        "reason": match.reason,
        "view": view_dict(match.view),
    }
    return {**instance_dict(match.instance), **answer}


def view_dict(view: BestView | None) -> dict[str, Any] | None:
    """A frame with a box in it, for machines."""
    if view is None:
        return None
    return {"session": view.session_id, "frame": view.frame_index, "box_xyxy": list(view.box_xyxy)}


def print_matches(matches: Sequence[Match], units: Lengths | str, json: bool, **facts: Any) -> None:
    """Matches as a table, or as JSON with more facts; what is to be said of all of them goes to standard error."""
    notes, total = getattr(matches, "notes", ()), getattr(matches, "total", None)
    if json:
        print_answer(map(match_dict, matches), units, notes, **{"total": total, **facts})
        return
    note(*(f"note: {line}" for line in notes))
    if total is not None and total > len(matches):
        note(f"note: the best {len(matches)} of {total}; -k {total} shows all")
    to_surface = any(m.distance_m is not None for m in matches)
    placed = to_surface or any(m.center_distance_m is not None for m in matches)
    if placed and not isinstance(units, str) and units.deviation is not None:
        note(f"note: lengths are about metres, a guess, give or take {units.deviation:.0%}")
    rows = [
        [
            m.instance.id,
            in_column(m.instance.label or m.instance.description),
            m.score,
            *((_length(m.distance_m),) if to_surface else ()),
            *((_length(m.center_distance_m),) if placed else ()),
            "" if m.best_view is None else m.best_view.frame_index,
            m.reason,
        ]
        for m in matches
    ]
    distances = [f"surface ({units})"] * to_surface + [f"centre ({units})"] * placed
    print_table(rows, ["id", "what", "score", *distances, "frame", "why"])


def print_relations(scene: SceneMemory, found: Relations, json: bool) -> None:
    """Relations with notes on the question as a whole."""
    names = {i.id: in_column(i.label or i.description) for i in scene.instances(structure=None)}
    gravity, units = scene.gravity, scene.lengths
    if json:
        notes = [found.reason] if found.reason else []
        print_answer(map(vars, found), units, notes, total=len(found), state=found.state, gravity=gravity)
        return
    if found.state == "unknown":
        say(f"unknown: {found.reason}")
        return
    rows = [
        [r.subject, names[r.subject], r.predicate, r.object, _object(r, names), r.confidence, r.margin] for r in found
    ]
    print_table(rows, ["id", "subject", "predicate", "id", "object", "confidence", f"margin ({units})"])
    if found.reason:
        note(f"note: {found.reason}")


def _object(relation: Relation, names: dict[int, str]) -> str:
    """The object, or both objects of `between`."""
    other = getattr(relation, "other", None)
    return names[relation.object] + ("" if other is None else f" and {other} {names[other]}")


def _length(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
