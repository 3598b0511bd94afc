"""What has changed between the sessions that have ended, and how the groups by overlap are one instance by that.

The chunks of a session that has not ended come to the groups by overlap alone: what had moved stays one instance whose
box is where it was last.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from list3r.memory.core.records import MergeDecision
from list3r.memory.library.change.detection import OverlapGroups, find_changes
from list3r.memory.library.change.records import Change
from list3r.memory.library.grouping import Group
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.summaries import SomeSummaries
from list3r.memory.library.scene import Scene


@dataclass(frozen=True)
class SessionChanges:
    """The groups with those joined that are the places of one instance, and what sessions say of them."""

    groups: list[Group]
    current: Mapping[Key, Group] = field(default_factory=dict)
    """By first member of a group that was at several places: the members that show it where it is now."""
    states: Mapping[Key, str] = field(default_factory=dict)
    """By first member: the state of a group, where it is not `present`."""
    events: tuple[tuple[Key, Change], ...] = ()
    """Events, each with the first member of the group that it is of."""
    decisions: Sequence[MergeDecision] = ()


def find_session_changes(
    scene: Scene, places: Sequence[Group], shown: Sequence[bool], moving: Sequence[Key], *, ended: bool
) -> SessionChanges:
    """Find what the sessions that are complete have changed, or all of them where the last one has just `ended`.

    `places` are the groups by overlap, `moving` the first members of those that were seen moving.
    """
    complete = {s.session_id for s in scene.store.sessions.all() if ended or s.state == "complete"}
    sessions = {c.session_id for c in scene.rows.values()} & complete
    if len(sessions) < 2:
        return SessionChanges(list(places))
    told = {g: tuple(k for k in g if scene.session(k[0]) in sessions) for g in places}
    whole = {part[0]: g for g, part in told.items() if part}
    seen = [(told[g], show) for g, show in zip(places, shown, strict=True) if told[g]]
    chunks = sorted(k for k, c in scene.rows.items() if c.session_id in sessions)
    moves = frozenset(told[g][0] for g in places if g[0] in set(moving) and told[g])
    found = find_changes(
        scene.store,
        OverlapGroups([g for g, _ in seen], [show for _, show in seen], moves),
        [scene.rows[k] for k in chunks],
        SomeSummaries(scene.summaries, chunks, scene.world.unit),
        scene.settings.changes,
    )
    home = {key: g for g in whole.values() for key in g}
    joined = {g[0]: _together({home[key] for key in g}) for g in found.groups}
    groups = sorted([*joined.values(), *(g for g in places if not told[g])])
    later = {g[0] for g in groups if any(scene.session(k) not in sessions for k, _ in g)}
    return SessionChanges(
        groups,
        {joined[first][0]: home[now[0]] for first, now in found.current.items()},
        {joined[k][0]: state for k, state in found.states.items() if joined[k][0] not in later},
        tuple((joined[e.first][0], e) for e in found.events),
        found.decisions,
    )


def _together(places: set[Group]) -> Group:
    """Return the places of one instance as one group."""
    return tuple(sorted(key for place in places for key in place))
