"""The world as it was after an earlier session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from list3r.memory.core.records import ChangeEvent, Instance
from list3r.memory.store.store import Store

_STATES = {"seen_again": "present", "moved": "moved", "removed": "removed", "added": "added"}


def world_at(store: Store, session_id: int) -> list[Instance]:
    """Return the instances known after a session, by id, where they were then and in the state that they had then.

    What was seen only later is left out; an instance that went later is where it was before. Sizes and words are
    those of today, which rest on all that was ever seen of an instance. Raises `OptionError` for a session that there
    is not.
    """
    store.sessions.check(session_id)
    owner = {c.chunk_id: c.session_id for c in store.chunks.all()}
    seen: dict[int, set[int]] = {}
    for o in store.observations.all():
        seen.setdefault(o.instance_id, set()).add(owner[o.chunk_id])
    story: dict[int, list[ChangeEvent]] = {}
    for event in store.events.all():
        story.setdefault(event.instance_id, []).append(event)
    latest = _latest(store, session_id)
    out = []
    for instance in store.instances.all():
        events = story.get(instance.id, [])
        known = seen.get(instance.id, set()) | {e.session_id for e in events}
        if known and min(known) <= session_id:
            state = _state(events, seen.get(instance.id, set()), session_id, latest.get(instance.component, session_id))
            out.append(replace(_where(instance, events, session_id), state=state))
    return out


def _latest(store: Store, session_id: int) -> dict[int, int]:
    """By component: the last session up to this one that saw it."""
    out: dict[int, int] = {}
    for c in store.chunks.all():
        if c.session_id <= session_id:
            out[c.component] = max(c.session_id, out.get(c.component, 0))
    return out


def _state(events: list[ChangeEvent], seen: set[int], session_id: int, latest: int) -> str:
    before = [e for e in events if e.session_id <= session_id]
    if before and before[-1].kind == "removed":
        return "removed"
    if before and before[-1].session_id == latest:
        return _STATES[before[-1].kind]
    return "present" if latest in seen else "unseen"


def _where(instance: Instance, events: list[ChangeEvent], session_id: int) -> Instance:
    """Return the instance where it was before it first went after the session, or where it had been if it was gone."""
    later = [e for e in events if e.session_id > session_id and e.kind in ("moved", "removed")]
    known = [e for e in events if e.session_id <= session_id]
    gone = known[-1:] if known and known[-1].kind == "removed" else []
    box = next((e.from_box for e in (*gone, *later)), None)
    if box is None:
        return instance
    corners = box.corners()
    aabb = np.stack([corners.min(axis=0), corners.max(axis=0)])
    return replace(instance, center=box.center, aabb=aabb, box=box)
