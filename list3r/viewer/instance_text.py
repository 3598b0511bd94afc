"""The panel's text of an instance."""

from __future__ import annotations

from list3r.api import SceneMemory
from list3r.memory.core.records import Relation
from list3r.queries.path import telling
from list3r.viewer.world import ShownWorld

_MOST_RELATIONS = 14


def described(memory: SceneMemory, world: ShownWorld, instance_id: int, relations: list[Relation]) -> str:
    """Return the panel's text of an instance as Markdown: name, place, confidence, times, relations, history."""
    i, units = world.instances[instance_id], memory.units
    size = " x ".join(f"{v:.2f}" for v in i.box.size)
    place = ", ".join(f"{v:.2f}" for v in i.center)
    sigma = "" if i.position_sigma_m is None else f", give or take {i.position_sigma_m:.2f} {units}"
    lines = [
        f"### {i.id} {plain(world.name(i.id))}",
        plain(i.description),
        "",
        f"at {place} {units}{sigma}  ",
        f"{size} {units}  ",
        f"confidence {i.confidence:.2f}, seen in {i.observations} frames  ",
        f"seen {i.first_seen_s:.1f} s to {i.last_seen_s:.1f} s{_state(i.state, i.dynamic)}",
    ]
    own = sorted((r for r in relations if r.subject == i.id and r.object in world.instances), key=telling)
    if own:
        first = {r.object: r for r in reversed(own)}  # of each other instance the most telling
        kept = [r for r in own if first[r.object] is r]
        sentences = [f"- {r.predicate.replace('_', ' ')} {r.object} {plain(world.name(r.object))}" for r in kept]
        lines += ["", "**Relations**", "", *sentences[:_MOST_RELATIONS]]
        lines += [f"- and {len(sentences) - _MOST_RELATIONS} more"] if len(sentences) > _MOST_RELATIONS else []
    history = [c for c in memory.changes() if c.instance.id == i.id]
    if history:
        lines += ["", "**History**", ""]
        for c in history:
            far = "" if c.distance_m is None else f" by {c.distance_m:.2f} {units}"
            lines.append(f"- session {c.event.session_id}: {c.event.kind}{far} ({c.event.confidence:.2f})")
    return "\n".join(lines)


def _state(state: str, dynamic: bool) -> str:
    return ", seen moving" if dynamic else "" if state == "present" else f", {state}"


def plain(text: str) -> str:
    """Text that Markdown and HTML take as it is: names are written by anybody."""
    marks = {"<": "&lt;", ">": "&gt;", "&": "&amp;", "{": "&#123;", "}": "&#125;"}
    return "".join(marks.get(c, f"\\{c}" if c in "\\`*_[]()#!|" else c) for c in text)
