"""The tools that ask: each computes an answer from the memory and returns small plain values."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from mcp.server.mcpserver.utilities.types import Image
from pydantic import Field

from list3r.api import SceneMemory
from list3r.memory.core.description.printable import shown
from list3r.memory.core.errors import OptionError
from list3r.queries.match import Match
from list3r.queries.relations import Relations
from list3r.server.mcp.records import (
    MOST,
    change_record,
    instance_record,
    match_record,
    name_of,
    number,
    numbers,
    page,
    relation_record,
)

Id = Annotated[int, Field(description="Id of an instance. An id that was merged resolves to the present instance.")]
Point = Annotated[list[float], Field(description="x, y, z in world units.", min_length=3, max_length=3)]
Limit = Annotated[int, Field(description="Entries of a page.", ge=1, le=MOST)]
Offset = Annotated[int, Field(description="Entries to skip, for further pages.", ge=0)]
Words = Annotated[str, Field(description="Words of a label, description, colour or size.", max_length=500)]

_PICTURE_SIDE_PX = 768
_LEAST_SIDE_PX = 256
"""Smaller crops are enlarged: models see little in a picture of a few dozen pixels."""
_TRACK_POINTS = 60


class ReadingTools:
    """Questions about one memory; each public method is a tool."""

    def __init__(self, memory: SceneMemory) -> None:
        self._memory = memory

    def overview(self) -> dict[str, Any]:
        """Summary of the memory: units, up direction, number of things by name, extent, sessions. Start here."""
        m = self._memory
        everything = m.instances(structure=None)
        things = [i for i in everything if i.structure is None and i.state != "removed"]
        names = Counter(name_of(i) for i in things).most_common(30)
        corners = np.array([i.aabb for i in everything if np.isfinite(i.aabb).all()]).reshape(-1, 3)
        return {
            "memory": shown(m.path.name),
            "units": m.units,
            "metric": m.lengths.metric,
            "metre_deviation": m.lengths.deviation,
            "gravity": m.gravity,
            "up": None if m.gravity == "unknown" else "z",
            "instances": len(things),
            "structure": dict(Counter(i.structure for i in everything if i.structure)),
            "names": dict(names),
            "extent": {"min": numbers(corners.min(axis=0)), "max": numbers(corners.max(axis=0))}
            if len(corners)
            else None,
            "components": len({i.component for i in everything}),
            "sessions": [{"session": s.session_id, "frames": s.frame_count, "state": s.state} for s in m.sessions()],
            "changes": len(m.changes()),
        }

    def rooms(self) -> dict[str, Any]:
        """Rooms with names, areas, ids of the things in them and doorways. `find` takes "lamp in the bedroom"."""
        doors = self._memory.doorways()
        return {
            "rooms": [
                {
                    "id": r.id,
                    "name": None if r.name is None else shown(r.name),
                    "floor": r.floor,
                    "area": number(r.area),
                    "partial": r.partial or None,
                    "ids": list(r.instances),
                    "doorways_to": sorted({d.b if d.a == r.id else d.a for d in doors if r.id in (d.a, d.b)}),
                }
                for r in self._memory.rooms()
            ]
        }

    def find(self, text: Words, limit: Limit = 10) -> dict[str, Any]:
        """Answer a question in plain words: "white mug on the table", "where is the remote?", "something to sit on",
        "chair closest to the door", "second book from the left", "lamp that is not on the desk", "what moved?".

        `count` answers "how many ...?", `answer` is yes or no for "is there ...?". Names may be synonyms, broader
        words, or German, French, Spanish, Italian, Japanese or Chinese. `exact` false: nothing fits, and the matches
        are only the nearest by meaning or look. `notes` name the words that describe nothing.
        """
        found = self._memory.find(text, limit)
        return {**self._matches(found, found.notes), **found.facts(), "unknown_words": list(found.unknown_words)}

    def nearest(
        self,
        id: Id | None = None,
        point: Point | None = None,
        words: Words | None = None,
        limit: Limit = 5,
        max_distance: float | None = None,
        label: str | None = None,
        color: str | None = None,
    ) -> dict[str, Any]:
        """The things nearest to an instance or to a point, by the gap between surfaces; optionally only those with a
        label or colour. With `words` instead: the things that they name best.
        """
        given = [x for x in (id, point, words) if x is not None]
        if len(given) != 1:
            raise OptionError("give either id, point or words")
        found = self._memory.nearest(given[0], limit, max_distance=max_distance, label=label, color=color)
        return self._matches(found, found.notes)

    def within(
        self,
        center: Point | None = None,
        radius: float | None = None,
        lower: Point | None = None,
        upper: Point | None = None,
        limit: Limit = 20,
        offset: Offset = 0,
    ) -> dict[str, Any]:
        """The things in a sphere (center, radius) or in a box (lower and upper corner), the most inside first."""
        found = self._memory.within(lower=lower, upper=upper, center=center, radius=radius)
        return page([match_record(m) for m in found], self._memory.units, limit, offset)

    def relations(
        self,
        subject: Id | None = None,
        predicate: str | None = None,
        object: Id | None = None,
        viewpoint: Annotated[str | None, Field(description="An id, camera, camera:FRAME or x,y,z.")] = None,
        limit: Limit = 20,
        offset: Offset = 0,
    ) -> dict[str, Any]:
        """Relations that match what is given: on, supports, in, contains, above, below, under, next_to, near,
        attached_to; left_of, right_of, in_front_of and behind with a viewpoint. `state` is unknown if the memory
        cannot decide.
        """
        found = self._memory.relations(subject, predicate, object, viewpoint=viewpoint)
        return self._relations(found, limit, offset)

    def between(self, a: Id, b: Id, limit: Limit = 20) -> dict[str, Any]:
        """The things that stand between two instances."""
        found = self._memory.relations(predicate="between", object=a, other=b)
        return self._relations(found, limit, 0)

    def measure(self, a: Id, b: Id) -> dict[str, Any]:
        """How far two instances are apart (gap of surfaces, distance of centres) and which way b lies from a."""
        found = self._memory.measure(a, b)
        upright = self._memory.gravity != "unknown"
        return {
            "a": found.a,
            "b": found.b,
            "gap": number(found.gap),
            "center_distance": number(found.center_distance),
            "from_a_to_b": numbers(found.step),
            "horizontal": number(found.horizontal) if upright else None,
            "height_difference": number(found.height_difference) if upright else None,
            "sigma": number(found.sigma),
            "units": self._memory.units,
        }

    def describe(self, id: Id) -> dict[str, Any]:
        """All that is known of one instance: name, place, size, rotation, times, confidence, relations."""
        m = self._memory
        i = m.instance(id)
        names = self._names()
        found = m.relations_of(i.id)
        return {
            **instance_record(i),
            "label": None if i.label is None else shown(i.label),
            "description": shown(i.description),
            "structure": i.structure,
            "color": i.color_name,
            "axes": [numbers(axis) for axis in i.box.rotation.T],
            "frames": i.observations,
            "first_seen_s": number(i.first_seen_s),
            "last_seen_s": number(i.last_seen_s),
            "state": i.state,
            "moving": i.dynamic,
            "position_sigma": number(i.position_sigma_m),
            "component": i.component,
            "relations": [relation_record(r, names) for r in found][:MOST],
            "units": m.units,
        }

    def picture(
        self,
        id: Id,
        whole: Annotated[bool, Field(description="The whole frame with the outline instead of a crop.")] = False,
    ) -> Image:
        """The stored picture that shows an instance best."""
        from PIL import Image as Picture

        found = self._memory.picture(id)
        image = Picture.fromarray(found.marked() if whole else np.ascontiguousarray(found.crop()))
        image.thumbnail((_PICTURE_SIDE_PX, _PICTURE_SIDE_PX))
        zoom = max(1, round(_LEAST_SIDE_PX / max(image.size)))
        image = image.resize((image.width * zoom, image.height * zoom), Picture.Resampling.BICUBIC)
        out = io.BytesIO()
        image.save(out, format="JPEG", quality=88)
        return Image(data=out.getvalue(), format="jpeg")

    def changes(
        self,
        since: Annotated[int | None, Field(description="Only what sessions after this one showed.")] = None,
        limit: Limit = 20,
        offset: Offset = 0,
    ) -> dict[str, Any]:
        """The things that later sessions moved, removed or added, the newest first."""
        found = self._memory.changes(since)
        return page([change_record(c) for c in found], self._memory.units, limit, offset)

    def path_of(self, id: Id) -> dict[str, Any]:
        """Where an instance was: its track while it moved, its moves between sessions, and when it was seen."""
        m = self._memory
        i = m.instance(id)
        times, places = m.track(i.id)
        keep = np.unique(np.linspace(0, max(len(times) - 1, 0), min(len(times), _TRACK_POINTS)).astype(int))
        seen = m.seen(i.id)
        return {
            "id": i.id,
            "name": name_of(i),
            "moving": i.dynamic,
            "track": [[number(times[k]), *numbers(places[k])] for k in keep] if len(times) else [],
            "moves": [change_record(c) for c in m.changes() if c.instance.id == i.id],
            "seen": [{"session": s, "from_s": number(a), "to_s": number(b)} for s, a, b in seen.spans_s][:MOST],
            "now": numbers(i.center),
            "units": m.units,
        }

    def _matches(self, found: Sequence[Match], notes: Sequence[str]) -> dict[str, Any]:
        return {"units": self._memory.units, "matches": [match_record(m) for m in found], "notes": list(notes)}

    def _relations(self, found: Relations, limit: int, offset: int) -> dict[str, Any]:
        names, notes = self._names(), [found.reason] if found.reason else []
        lines = [relation_record(r, names) for r in found]
        return {**page(lines, self._memory.units, limit, offset, notes), "state": found.state}

    def _names(self) -> dict[int, str]:
        return {i.id: name_of(i) for i in self._memory.instances(structure=None)}
