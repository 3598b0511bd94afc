"""The part of the face for Python that edits: for memories opened with `writable=True`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import Instance, id_of
from list3r.memory.store.store import Store

if TYPE_CHECKING:
    from list3r.memory.library.maintenance.edits import EditReport
    from list3r.memory.store.tables.edits import LogEntry


class MemoryEdits:
    """The edits of an operator. The memory keeps each with its author, and obeys it in all later sessions."""

    store: Store
    _lock: AbstractContextManager[Any]
    """Lets one thread in at a time."""

    def merge(self, a: int | Instance, b: int | Instance, *, author: str | None = None) -> EditReport:
        """Say that two instances are one; the older id stays, the other becomes its alias for ever."""
        return self._edit("merge", id_of(a), id_of(b), author=author)

    def split(
        self, instance_id: int | Instance, out: Sequence[tuple[int, int]] | None = None, *, author: str | None = None
    ) -> EditReport:
        """Say that an instance is two. The local instances `out` (chunk id, local id) leave it; by default those that
        the evidence separates best."""
        return self._edit("split", id_of(instance_id), out, author=author)

    def label(self, instance_id: int | Instance, text: str | None, *, author: str | None = None) -> EditReport:
        """Name an instance; None takes the name away."""
        return self._edit("label", id_of(instance_id), text, author=author)

    def name_room(self, room: int, text: str | None, *, author: str | None = None) -> EditReport:
        """Name a room by its id; None takes the name away, and what stands in it names it again."""
        return self._edit("name_room", room, text, author=author)

    def delete(self, instance_id: int | Instance, *, author: str | None = None) -> EditReport:
        """Remove an instance, also from later sessions."""
        return self._edit("delete", id_of(instance_id), author=author)

    def scale(self, anchor: str, *, author: str | None = None) -> EditReport:
        """Give a known length, like `12=0.095m` or `camera_height=1.5m`; lengths are metres from then on."""
        return self._edit("scale", anchor, author=author)

    def undo(self, entry: int | None = None, *, author: str | None = None) -> EditReport:
        """Undo an edit or a decision of the merge log by its entry; by default the last edit that is not undone."""
        return self._edit("undo", entry, author=author)

    def merges(self, instance_id: int | Instance | None = None) -> list[LogEntry]:
        """Return the merge log, oldest first, or only the entries of one instance. Raises `UnknownIdError`."""
        from list3r.memory.library.maintenance.merge_log import merge_log

        with self._lock:
            return merge_log(self.store, None if instance_id is None else id_of(instance_id))

    def _edit(self, verb: str, *arguments: Any, author: str | None) -> EditReport:
        from list3r.memory.library.maintenance import edits

        with self._lock:
            if not self.store.writable:
                raise MemoryFileError(f"{self.store.path} is open for reading; open it with writable=True to edit it")
            report: EditReport = getattr(edits, verb)(self.store, *arguments, author)
            return report
