"""Write a page to read: plan, searchable list, crops, relations and changes in one HTML file that needs no network."""

from __future__ import annotations

import base64
import html
import re
import tempfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from list3r.exporters.output import replacing
from list3r.exporters.pages import embedded, numbers, thumbnails
from list3r.memory.core.description.printable import shown
from list3r.queries.trust import path_in_words

if TYPE_CHECKING:
    from list3r.api import SceneMemory
    from list3r.memory.core.records import Instance


@dataclass(frozen=True)
class ReportSettings:
    """Content of a page."""

    crops: int = 500
    """Number of instances with a picture, the most seen ones."""
    crop_px: int = 160
    """Longer side of a picture."""


def write_report(memory: SceneMemory, path: str | Path, settings: ReportSettings | None = None) -> tuple[Path, ...]:
    """Write the page. Returns the file written.

    All data are in it as JSON, which a script of ours shows as text, never as markup; a policy in its head forbids it
    to load anything.
    """
    path, settings = Path(path), settings or ReportSettings()
    page = resources.files("list3r.exporters.report").joinpath("page.html").read_text(encoding="utf-8")
    with replacing(path) as temporary:
        instances = memory.instances(structure=None)
        data = {
            "about": _about(memory) | {"most_crops": settings.crops},
            "instances": [_instance(i) for i in instances],
            "relations": _relations(memory, instances),
            "changes": [_change(c) for c in memory.changes()],
            "crops": thumbnails(memory, instances, settings.crops, settings.crop_px),
        }
        parts = {"title": html.escape(shown(memory.path.name)), "plan": _plan(memory), "data": embedded(data)}
        text = re.sub(r"\{(title|plan|data)\}", lambda found: parts[found[1]], page)
        temporary.write_text(text, encoding="utf-8")
    return (path,)


def _about(memory: SceneMemory) -> dict[str, Any]:
    facts = memory.info()
    kept = ("scale", "gravity", "frames", "posed", "lost", "chunks", "components", "loops", "instances", "structure")
    sessions = [f"session {s['id']}: {s['frames']} frames, {s['state']}" for s in facts["sessions"]]
    trust = path_in_words(facts["trust"], memory.units)
    return {"units": memory.units, "facts": {k: facts[k] for k in kept}, "sessions": sessions, "trust": trust}


def _instance(i: Instance) -> dict[str, Any]:
    return {
        "id": i.id,
        "label": i.label,
        "description": i.description,
        "structure": i.structure,
        "center": numbers(i.center),
        "size": numbers(i.box.size),
        "color": [int(v) for v in i.color_rgb],
        "confidence": round(float(i.confidence), 2),
        "frames": i.observations,
        "seen_s": numbers([i.first_seen_s, i.last_seen_s]),
        "state": "moving" if i.dynamic else i.state,
    }


def _relations(memory: SceneMemory, instances: list[Instance]) -> list[tuple[int, str, int, float]]:
    """Return each relation once; of two inverse ones the first in the list, and no `near` of `next_to`."""
    known = {i.id for i in instances}
    inverse = {"supports": "on", "contains": "in", "below": "above"}
    found = [r for r in memory.relations() if r.subject in known and r.object in known and r.predicate not in inverse]
    pairs = {(min(r.subject, r.object), max(r.subject, r.object)): r for r in found if r.predicate == "near"}
    pairs |= {(min(r.subject, r.object), max(r.subject, r.object)): r for r in found if r.predicate == "next_to"}
    kept = [r for r in found if r.predicate not in ("near", "next_to")] + list(pairs.values())
    return [(r.subject, r.predicate, r.object, round(float(r.confidence), 2)) for r in kept]


def _change(change: Any) -> dict[str, Any]:
    event = change.event
    distance = change.distance_m
    return {
        "session": event.session_id,
        "id": change.instance.id,
        "kind": event.kind,
        "distance": None if distance is None or not np.isfinite(distance) else round(float(distance), 3),
        "confidence": round(float(event.confidence), 2),
        "reason": event.reason,
    }


def _plan(memory: SceneMemory) -> str:
    with tempfile.TemporaryDirectory() as folder:
        picture = memory.export("plan", Path(folder) / "plan.png")[0].read_bytes()
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")
