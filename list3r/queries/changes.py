"""List what sessions have changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from list3r.memory.core.errors import check_choice, check_share
from list3r.memory.core.records import ChangeEvent, Instance
from list3r.memory.store.store import Store

KINDS = ("moved", "removed", "added", "seen_again")


@dataclass(frozen=True)
class Changed:
    """One instance that a session showed to have changed."""

    instance: Instance
    """As it is today."""
    event: ChangeEvent
    """What happened, where from and where to, and the frames that show it."""

    @property
    def distance_m(self) -> float | None:
        """How far the middle of it went, world units; None for what was removed or added."""
        if self.event.from_box is None or self.event.to_box is None:
            return None
        return float(np.linalg.norm(self.event.to_box.center - self.event.from_box.center))

    @property
    def score(self) -> float:
        """How sure it is, in [0, 1]."""
        return self.event.confidence

    @property
    def reason(self) -> str:
        """Why, in words."""
        return self.event.reason


def changes(
    store: Store, since: int | None = None, kinds: tuple[str, ...] = KINDS[:3], min_confidence: float = 0.0
) -> list[Changed]:
    """Return what was moved, removed and added in the sessions after `since` (all where it is None), the newest session
    first.

    Within a session by kind, the surest first. A thing that no frame could look at has no event. Raises `OptionError`
    for a session or a kind that there is not.
    """
    if since is not None:
        store.sessions.check(since)
    for kind in kinds:
        check_choice("kind of change", kind, KINDS)
    check_share("min_confidence", min_confidence)
    wanted = [
        e
        for e in store.events.all()
        if e.kind in kinds and e.confidence >= min_confidence and (since is None or e.session_id > since)
    ]
    things = {i.id: i for i in store.instances.all()}
    found = [Changed(things[e.instance_id], e) for e in wanted if e.instance_id in things]
    return sorted(found, key=lambda c: (-c.event.session_id, KINDS.index(c.event.kind), -c.score, c.event.instance_id))
