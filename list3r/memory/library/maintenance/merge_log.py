"""The merge log as people read it: all of it, or what concerns one instance."""

from __future__ import annotations

from list3r.memory.core.constraints import standing
from list3r.memory.store.store import Store
from list3r.memory.store.tables.edits import LogEntry


def merge_log(store: Store, instance_id: int | None = None) -> list[LogEntry]:
    """Return the log, oldest first; with an id, the entries that name it, an id that became it, or a part of it.

    Raises `UnknownIdError` for an id that the memory does not hold.
    """
    entries = store.merges.all()
    if instance_id is None:
        return entries
    current = store.ids.resolve(instance_id)
    names = {f"#{current}", *(f"#{old}" for old in store.ids.aliases_of(current))}
    names |= {f"{o.chunk_id}:{o.local_id}" for o in store.observations.of(current)}
    edits = {e.entry for e in store.edits.all() if any(f"#{n}" in names for n, _, _ in e.before)}
    return [e for e in entries if e.entry in edits or e.decision.a in names or e.decision.b in names]


def states(store: Store) -> dict[int, str]:
    """Of the entries that are edits: `stands` or `undone`."""
    edits = store.edits.all()
    in_force = {e.entry for e in standing(edits)}
    return {e.entry: "stands" if e.entry in in_force else "undone" for e in edits}
