"""The tools that edit: registered only where the server was started with `--write`. Every edit can be undone."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from list3r.api import SceneMemory
from list3r.server.mcp.reading import Id

_AUTHOR = "agent"


class WritingTools:
    """Edits of one memory; each public method is a tool."""

    def __init__(self, memory: SceneMemory) -> None:
        self._memory = memory

    def label(self, id: Id, text: Annotated[str | None, Field(max_length=200)]) -> dict[str, Any]:
        """Name an instance; null removes the name."""
        return self._memory.label(id, text, author=_AUTHOR).as_dict()

    def merge(self, a: Id, b: Id) -> dict[str, Any]:
        """Merge two instances that are one thing; the older id stays."""
        return self._memory.merge(a, b, author=_AUTHOR).as_dict()

    def split(self, id: Id) -> dict[str, Any]:
        """Split an instance that is two things, where the evidence separates them best."""
        return self._memory.split(id, author=_AUTHOR).as_dict()

    def delete(self, id: Id) -> dict[str, Any]:
        """Remove an instance from the memory."""
        return self._memory.delete(id, author=_AUTHOR).as_dict()

    def undo(self, entry: int | None = None) -> dict[str, Any]:
        """Undo an edit by the entry that it returned; by default the last edit that is not undone."""
        return self._memory.undo(entry, author=_AUTHOR).as_dict()
