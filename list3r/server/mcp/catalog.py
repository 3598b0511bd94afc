"""The tools that ask a catalogue of many memories, for agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Any

from pydantic import Field

from list3r.catalog import Catalog
from list3r.catalog.records import CatalogAnswers
from list3r.memory.core.description.printable import shown
from list3r.server.mcp.reading import Id, Limit, Offset, Point, Words
from list3r.server.mcp.records import page

Memory = Annotated[str, Field(description="Name of a memory; `memories` lists them.", max_length=200)]
InMemory = Annotated[str | None, Field(description="Name of a memory; without one over all.", max_length=200)]
End = Annotated[str | None, Field(description="Words, or within one memory an id.", max_length=500)]


class CatalogTools:
    """Questions to a catalogue; each public method is a tool."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def memories(self, limit: Limit = 50, offset: Offset = 0) -> dict[str, Any]:
        """The memories of the catalogue: name, file, revision, number of things and sessions. Start here."""
        return page([asdict(e) for e in self._catalog.memories()], "", limit, offset)

    def find(self, text: Words, memory: InMemory = None, limit: Limit = 10) -> dict[str, Any]:
        """Answer a question such as "red toolbox", "mug on table", "how many chairs?", in one memory or over all."""
        return _as_page(self._catalog.find(text, memory, k=limit))

    def nearest(
        self, memory: Memory, id: Id | None = None, point: Point | None = None, limit: Limit = 5
    ) -> dict[str, Any]:
        """The things of one memory nearest to an instance or to a point, by their boxes."""
        return _as_page(self._catalog.nearest(memory, instance_id=id, point=point, k=limit))

    def within(
        self,
        memory: Memory,
        center: Point | None = None,
        radius: float | None = None,
        lower: Point | None = None,
        upper: Point | None = None,
        limit: Limit = 20,
    ) -> dict[str, Any]:
        """The things of one memory in a sphere (center, radius) or in a box (lower and upper corner)."""
        found = self._catalog.within(memory, lower=lower, upper=upper, center=center, radius=radius)
        return _as_page(found, limit)

    def similar(self, memory: Memory, id: Id, everywhere: bool = True, limit: Limit = 10) -> dict[str, Any]:
        """The things that look like a given instance, in all memories or in its own."""
        return _as_page(self._catalog.similar(memory, instance_id=id, anywhere=everywhere, k=limit))

    def relations(
        self,
        memory: InMemory = None,
        subject: End = None,
        predicate: str | None = None,
        object: End = None,
        limit: Limit = 20,
    ) -> dict[str, Any]:
        """Stored relations (on, in, next_to, near, ...) in one memory or over all, by words or ids."""
        return _as_page(self._catalog.relations(memory, subject=subject, predicate=predicate, object=object, k=limit))


def _as_page(found: CatalogAnswers, limit: int | None = None) -> dict[str, Any]:
    """Return answers as plain values; each names its memory, file and units."""
    rows: Sequence[Any] = found if limit is None else found[:limit]
    texts = ("label", "description", "subject_name", "object_name")
    matches = [{k: shown(v) if k in texts and v is not None else v for k, v in asdict(m).items()} for m in rows]
    return {"total": len(found), "matches": matches, "notes": list(found.notes), **found.facts()}
