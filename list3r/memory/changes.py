"""What has changed between sessions: things seen again, moved, removed, added (design 3.9).

Things of two sessions are one where their surfaces meet and they look alike. A thing of an earlier session that the
new one did not find is asked about in the new session's frames: only where they see through its place is it gone,
and what no frame could see stays unseen. What is new is asked about in the frames of the sessions before in the same
way. What is gone from one place and new at another is one thing that moved if it looks and measures the same, one to
one, the best pairs first decided together. A thing that moved keeps what earlier sessions saw of it, but its body is
that of the place where it is now.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from list3r.memory.bodies import fit_box
from list3r.memory.geometry import Array, OrientedBox
from list3r.memory.merging import Key, PairScores
from list3r.memory.records import ChangeEvent, ChunkRow, MergeDecision
from list3r.memory.shapes import ChunkShapes
from list3r.memory.store import Store
from list3r.memory.summaries import ChunkSummary, world_unit
from list3r.memory.visibility import Look, View, VisibilitySettings, look, views_of


@dataclass(frozen=True)
class ChangeSettings:
    """When two sessions show one thing, and when a thing has changed."""

    small_m: float = 0.7
    """Diagonal of a thing that a session sees whole."""
    most_truncated: float = 0.5
    """Share of its frames in which the border may cut a thing that is seen whole."""
    other_color: float = 25.0
    """Between median colours (CIE L*a*b*, lightness at half weight) of two whole things that are not one;"""
    other_size: float = 2.0
    """or the ratio of their diagonals."""
    moved_color: float = 10.0
    """The same for a thing that was moved: it must look"""
    moved_size: float = 1.45
    """and measure the same, in height and in footprint,"""
    moved_cosine: float = 0.8
    """and its feature must agree;"""
    moved_difference: float = 0.7
    """and all of that together, as a share of these limits, must not differ more."""
    replaced: float = 0.4
    """Share of a new thing's surface that must lie where a thing stood that is gone, to be new there;"""
    replaced_slack_m: float = 0.02
    """within this."""
    least_frames: int = 12
    """Frames in which a thing must have been seen for its absence or presence to be an event."""
    most_structure: float = 0.5
    """Share of its members flagged as structure up to which a thing can come and go."""
    points: int = 200
    """Surface points of a thing that frames are asked about."""
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)


@dataclass(frozen=True)
class Change:
    """An event before its thing has an id."""

    first: Key
    """First member of the group that it is about."""
    session_id: int
    kind: str
    from_box: OrientedBox | None
    to_box: OrientedBox | None
    frames: tuple[tuple[int, int], ...]
    confidence: float
    reason: str


@dataclass(frozen=True)
class Changes:
    """What sessions have changed."""

    groups: list[list[Key]]
    """The groups, those that moved joined."""
    current: dict[Key, tuple[Key, ...]]
    """By first member of a group that moved: the members that show it where it is now."""
    states: dict[Key, str]
    """By first member: the state of a group, where it is not `present`."""
    events: tuple[Change, ...]
    decisions: list[MergeDecision]


def across_sessions(
    pairs: Mapping[tuple[int, int], PairScores], shapes: Mapping[int, ChunkShapes], settings: ChangeSettings
) -> dict[tuple[int, int], PairScores]:
    """Scores of pairs without those that plainly are two things of two sessions at one place."""
    if len({s.session_id for s in shapes.values()}) < 2:
        return dict(pairs)
    out = {}
    for (u, v), p in pairs.items():
        a, b = shapes[u], shapes[v]
        if a.session_id == b.session_id:
            out[u, v] = p
            continue
        size_a, size_b = a.size[p.i] / a.unit, b.size[p.j] / b.unit
        whole = (a.truncated[p.i] < settings.most_truncated) & (b.truncated[p.j] < settings.most_truncated)
        whole &= np.maximum(size_a, size_b) < settings.small_m
        color = np.linalg.norm((a.lab[p.i] - b.lab[p.j]) * _LIGHTNESS, axis=1)
        ratio = np.maximum(size_a, size_b) / np.maximum(np.minimum(size_a, size_b), 1e-9)
        keep = ~(whole & ((color > settings.other_color) | (ratio > settings.other_size)))
        out[u, v] = PairScores(*(x[keep] for x in (p.i, p.j, p.i_on_j, p.j_on_i, p.shared, p.frame_iou)))
    return out


def find_changes(
    store: Store,
    groups: Sequence[Sequence[Key]],
    shown: Sequence[bool],
    fixed: frozenset[Key],
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    settings: ChangeSettings,
) -> Changes:
    """Go through the sessions in order and say what each has changed.

    `groups` are the things by overlap, `shown` those that count, `fixed` the first members of those that were seen
    moving and have a story of their own. Nothing is done for a memory of one session.
    """
    plain = [list(g) for g in groups]
    sessions = sorted({c.session_id for c in chunks})
    if len(sessions) < 2:
        return Changes(plain, {}, {}, (), [])
    story = _Story(store, plain, shown, fixed, chunks, summaries, settings)
    for session in sessions[1:]:
        story.tell(session)
    return story.result()


_LIGHTNESS = np.array([0.5, 1.0, 1.0])


@dataclass
class _Thing:
    """One thing and the places it had: groups by overlap, of which one is where it is now."""

    places: list[int]
    now: int
    state: str = "present"


@dataclass(frozen=True)
class _Looks:
    """What a group looks like, over the members of some sessions."""

    lab: Array
    extent: Array
    """Larger and smaller side of the footprint, height; world units, upright where gravity is known. Shape (3,)."""
    feature: NDArray[np.float32]


class _Story:
    """The sessions told one after another."""

    def __init__(
        self,
        store: Store,
        groups: list[list[Key]],
        shown: Sequence[bool],
        fixed: frozenset[Key],
        chunks: Sequence[ChunkRow],
        summaries: Mapping[int, ChunkSummary],
        settings: ChangeSettings,
    ) -> None:
        self._groups, self._s = groups, settings
        self._rows = {c.chunk_id: c for c in chunks}
        self._shapes = {k: v.shapes for k, v in summaries.items()}
        self._unit = world_unit(chunks, summaries)
        self._upright = store.get_value("gravity", "unknown") != "unknown"
        self._store = store
        self._word = store.constraints()
        self._views: dict[tuple[int, int], list[View]] = {}
        self._sessions = [sorted({self._rows[k].session_id for k, _ in g}) for g in groups]
        self._component = [self._rows[g[0][0]].component for g in groups]
        self._movable = [g[0] not in fixed and self._flagged(g) < settings.most_structure for g in groups]
        self._counts = [bool(show) and free for show, free in zip(shown, self._movable, strict=True)]
        self._thing = {n: _Thing([n], n) for n in range(len(groups))}
        self._events: list[tuple[int, Change]] = []
        self._decisions: list[MergeDecision] = []

    # ------------------------------------------------------------------ the story

    def tell(self, session: int) -> None:
        """What one session has changed."""
        components = {c.component for c in self._rows.values() if c.session_id == session}
        gone = self._missing(session, components)
        fresh = [n for n, s in enumerate(self._sessions) if s[0] == session and self._component[n] in components]
        fresh = [n for n in fresh if self._counts[n] and self._known_before(n, session)]
        looks = {n: self._look(n, session, before=False) for n in fresh}
        left = [thing.now for thing, _ in gone]
        for thing, place in self._moved(gone, fresh, session):
            fresh.remove(place)
            self._move(thing, place, session, looks[place])
        gone = [(t, found) for t, found in gone if t.state == "unseen" and self._counts[t.now]]
        for thing, found in gone:
            self._remove(thing, session, found)
        for n in fresh:
            replaces = any(self._replaces(n, place, session) for place in left)
            if looks[n].verdict == "gone" or replaces:
                self._add(n, session, looks[n])

    def _missing(self, session: int, components: set[int]) -> list[tuple[_Thing, Look]]:
        """The things that are gone from where they were; all others that were known are given their state."""
        gone: list[tuple[_Thing, Look]] = []
        for thing in self._things():
            if self._sessions[thing.now][0] >= session or self._component[thing.now] not in components:
                continue
            seen = [n for n in thing.places if session in self._sessions[n]]
            if seen:
                self._seen(thing, seen, session)
            elif thing.state != "removed":
                thing.state = "unseen"
                if self._movable[thing.now] and self._frames(thing.now, session) >= self._s.least_frames:
                    found = self._look(thing.now, session, before=True)
                    if found.verdict == "gone":
                        gone.append((thing, found))
                    elif found.verdict == "there" and self._counts[thing.now]:
                        self._still_there(thing, session, found)
        return gone

    def _things(self) -> list[_Thing]:
        known: list[_Thing] = []
        for n in sorted(self._thing):
            if self._thing[n].places[0] == n:
                known.append(self._thing[n])
        return known

    def _replaces(self, n: int, place: int, session: int) -> bool:
        """Whether a new thing stands where one stood that is gone."""
        box = self._box(place, session, before=True)
        inside = np.abs((self._points(n, session, before=False) - box.center) @ box.rotation)
        slack = self._s.replaced_slack_m * self._unit
        share = float(np.mean(np.all(inside <= box.size / 2 + slack, axis=1)))
        return self._component[n] == self._component[place] and share >= self._s.replaced

    def _seen(self, thing: _Thing, places: list[int], session: int) -> None:
        place = thing.now if thing.now in places else max(places, key=lambda n: (self._frames_in(n, session), -n))
        kind = "seen_again" if place == thing.now else "moved"
        before, after = self._box(thing.now, session, before=True), self._box(place, session, before=False)
        thing.now, thing.state = place, "present" if kind == "seen_again" else "moved"
        if self._counts[place]:
            frames = self._frames_in(place, session)
            reason = f"its surface was found at its place in {frames} frames"
            sure = frames / (frames + 4.0)
            self._tell(thing, session, kind, before, after, self._evidence(place, session), sure, reason)

    def _still_there(self, thing: _Thing, session: int, found: Look) -> None:
        thing.state = "present"
        box = self._box(thing.now, session, before=True)
        reason = f"a surface is measured where it was ({1 - found.free:.0%} of what could be told)"
        self._tell(thing, session, "seen_again", box, box, found.frames, 0.5 * (1 - found.free), reason)

    def _remove(self, thing: _Thing, session: int, found: Look) -> None:
        thing.state = "removed"
        box = self._box(thing.now, session, before=True)
        reason = f"{len(found.frames)} frames see through its place ({found.free:.0%} of what could be told)"
        self._tell(thing, session, "removed", box, None, found.frames, self._sure(found), reason)

    def _add(self, place: int, session: int, found: Look) -> None:
        thing = self._thing[place]
        thing.state = "added"
        box = self._box(place, session, before=False)
        seen = f"{len(found.frames)} frames of earlier sessions see through its place"
        reason = seen if found.verdict == "gone" else "it stands where something else stood that is gone"
        self._tell(thing, session, "added", None, box, self._evidence(place, session), self._sure(found), reason)

    def _move(self, thing: _Thing, place: int, session: int, before: Look) -> None:
        old, new = self._box(thing.now, session, before=True), self._box(place, session, before=False)
        a, b = self._groups[thing.now][0], self._groups[place][0]
        distance = float(np.linalg.norm(new.center - old.center)) / self._unit
        reason = f"gone from its place and found {distance:.2f} m away, of the same look and size"
        scores = {"distance": round(distance, 3), "free_before": round(before.free, 3)}
        self._decisions.append(MergeDecision("merge", f"{a[0]}:{a[1]}", f"{b[0]}:{b[1]}", scores, reason))
        self._tell(thing, session, "moved", old, new, self._evidence(place, session), self._sure(before), reason)
        thing.places.append(place)
        thing.now, thing.state = place, "moved"
        del self._thing[place]

    def _sure(self, found: Look) -> float:
        frames = len(found.frames)
        return float(max(found.free, 0.3) * frames / (frames + 1.0))

    def _tell(
        self,
        thing: _Thing,
        session: int,
        kind: str,
        before: OrientedBox | None,
        after: OrientedBox | None,
        frames: tuple[tuple[int, int], ...],
        confidence: float,
        reason: str,
    ) -> None:
        first = self._groups[thing.places[0]][0]
        change = Change(first, session, kind, before, after, frames[:8], round(confidence, 3), reason)
        self._events.append((thing.places[0], change))

    def _moved(
        self, gone: Sequence[tuple[_Thing, Look]], fresh: Sequence[int], session: int
    ) -> list[tuple[_Thing, int]]:
        """Pairs of what is gone and what is new, one to one, of least difference in all."""
        if not gone or not fresh:
            return []
        cost = np.full((len(gone), len(fresh)), _NEVER)
        for i, (thing, _) in enumerate(gone):
            old = self._looks(thing.now, session, before=True)
            taken = {s for n in thing.places for s in self._sessions[n]}
            for j, n in enumerate(fresh):
                apart = self._word.forbids([k for p in thing.places for k in self._groups[p]], self._groups[n])
                if (
                    not apart
                    and not taken.intersection(self._sessions[n])
                    and self._component[n] == self._component[thing.now]
                ):
                    cost[i, j] = self._difference(old, self._looks(n, session, before=False))
        rows, columns = linear_sum_assignment(cost)
        return [
            (gone[i][0], fresh[j]) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if cost[i, j] < 1.0
        ]

    def _difference(self, a: _Looks, b: _Looks) -> float:
        """0 for things alike, from 1 for two that are not one."""
        s = self._s
        color = float(np.linalg.norm((a.lab - b.lab) * _LIGHTNESS)) / s.moved_color
        ratios = np.abs(np.log(np.maximum(a.extent, 1e-3) / np.maximum(b.extent, 1e-3)))
        size = float(ratios.mean()) / float(np.log(s.moved_size))
        feature = (1.0 - float(a.feature @ b.feature)) / (1.0 - s.moved_cosine)
        difference = float(np.mean([color, size, feature]))
        return difference if max(color, size, feature) < 1.0 and difference < s.moved_difference else _NEVER

    # ------------------------------------------------------------------ what is asked

    def _members(self, n: int, session: int, *, before: bool) -> list[Key]:
        """Members of the last session before, or of this one."""
        group = self._groups[n]
        owner = [self._rows[k].session_id for k, _ in group]
        wanted = session
        if before:
            earlier = [s for s in owner if s < session]
            wanted = max(earlier) if earlier else session
        return [k for k, s in zip(group, owner, strict=True) if s == wanted]

    def _points(self, n: int, session: int, *, before: bool) -> Array:
        parts = []
        for chunk_id, local_id in self._members(n, session, before=before):
            shape, at = self._shapes[chunk_id], self._at(chunk_id, local_id)
            start, stop = np.searchsorted(shape.owner, [at, at + 1])
            parts.append(self._rows[chunk_id].S_world_chunk.apply(shape.points[start:stop]))
        points = np.concatenate(parts) if parts else np.zeros((0, 3))
        return points[:: max(1, len(points) // self._s.points)]

    def _box(self, n: int, session: int, *, before: bool) -> OrientedBox:
        points = self._points(n, session, before=before)
        upright = self._upright and self._component[n] == min(c.component for c in self._rows.values())
        return fit_box(points if len(points) else np.zeros((1, 3)), upright=upright)

    def _look(self, n: int, session: int, *, before: bool) -> Look:
        """What this session's frames see where a thing was before, or what those before saw where it is now."""
        points = self._points(n, session, before=before)
        if len(points) == 0:
            return Look("unseen", 0.0, ())
        wanted = [session] if before else [s for s in self._all_sessions() if s < session]
        views = [v for s in wanted for v in self._views_of(s, self._component[n])]
        return look(points, views, self._s.visibility)

    def _views_of(self, session: int, component: int) -> list[View]:
        if (session, component) not in self._views:
            rows = [c for c in self._rows.values() if c.session_id == session and c.component == component]
            keyframes = {c.chunk_id: self._store.keyframes(c.chunk_id) for c in rows}
            self._views[session, component] = views_of(rows, keyframes, self._unit)
        return self._views[session, component]

    def _all_sessions(self) -> list[int]:
        return sorted({c.session_id for c in self._rows.values()})

    def _known_before(self, n: int, session: int) -> bool:
        """Whether an earlier session lies in the same world, so that a thing can be new to it."""
        return any(c.component == self._component[n] and c.session_id < session for c in self._rows.values())

    def _looks(self, n: int, session: int, *, before: bool) -> _Looks:
        keys = self._members(n, session, before=before)
        shapes = [(self._shapes[k], self._at(k, i)) for k, i in keys]
        weight = np.array([max(len(c.frames[at]), 1) for c, at in shapes], float)
        feature = np.average([c.feature[at] for c, at in shapes], axis=0, weights=weight)
        length = float(np.linalg.norm(feature))
        return _Looks(
            np.average([c.lab[at] for c, at in shapes], axis=0, weights=weight),
            self._extent(n, session, before=before),
            np.asarray(feature / max(length, 1e-12), np.float32),
        )

    def _extent(self, n: int, session: int, *, before: bool) -> Array:
        """Median over its whole views, so that what one view took from its surroundings does not count."""
        keys = self._members(n, session, before=before)
        shapes = [self._shapes[k] for k, _ in keys]
        whole = [c.truncated[self._at(*k)] < self._s.most_truncated for c, k in zip(shapes, keys, strict=True)]
        sizes = []
        for c, key, is_whole in zip(shapes, keys, whole, strict=True):
            start, stop = np.searchsorted(c.owner, [self._at(*key), self._at(*key) + 1])
            if stop > start and (is_whole or not any(whole)):
                points = self._rows[key[0]].S_world_chunk.apply(c.points[start:stop])
                sizes.append(self._sides(fit_box(points, upright=self._upright, trim=_SPREAD)))
        return np.median(sizes, axis=0) if sizes else np.ones(3)

    def _sides(self, box: OrientedBox) -> Array:
        if not self._upright:
            return np.sort(box.size)[::-1]
        return np.array([*np.sort(box.size[:2])[::-1], box.size[2]])

    def _flagged(self, group: Sequence[Key]) -> float:
        return float(np.mean([self._shapes[k].structure[self._at(k, i)] for k, i in group]))

    def _frames(self, n: int, before: int) -> int:
        """Frames of earlier sessions in which a thing was seen."""
        return sum(self._frames_in(n, s) for s in self._sessions[n] if s < before)

    def _frames_in(self, n: int, session: int) -> int:
        return len({f for _, f, _ in self._sightings(n, session)})

    def _evidence(self, n: int, session: int) -> tuple[tuple[int, int], ...]:
        """The frames of a session that see most of a thing."""
        best: dict[int, int] = {}
        for area, frame, _ in self._sightings(n, session):
            best[frame] = max(area, best.get(frame, 0))
        return tuple((session, f) for f in sorted(best, key=lambda f: (-best[f], f)))

    def _sightings(self, n: int, session: int) -> list[tuple[int, int, int]]:
        out = []
        for chunk_id, local_id in self._groups[n]:
            if self._rows[chunk_id].session_id == session:
                shape, at = self._shapes[chunk_id], self._at(chunk_id, local_id)
                out += [(int(a), int(f), chunk_id) for a, f in zip(shape.areas_px[at], shape.frames[at], strict=True)]
        return out

    def _at(self, chunk_id: int, local_id: int) -> int:
        return int(np.searchsorted(self._shapes[chunk_id].local_id, local_id))

    # ------------------------------------------------------------------ what comes out

    def result(self) -> Changes:
        """The groups as the story leaves them."""
        groups, current, states = [], {}, {}
        names: dict[int, Key] = {}
        for thing in self._things():
            keys = sorted(k for n in thing.places for k in self._groups[n])
            groups.append(keys)
            names[thing.places[0]] = keys[0]
            if len(thing.places) > 1:
                current[keys[0]] = tuple(self._groups[thing.now])
            if thing.state != "present":
                states[keys[0]] = thing.state
        events = tuple(Change(names[n], *(getattr(c, f) for f in _FIELDS)) for n, c in self._events if n in names)
        return Changes(sorted(groups), current, states, events, self._decisions)


_NEVER = 1e3
_SPREAD = 0.04
"""Share of points outside the box at either end by which things are compared."""
_FIELDS = ("session_id", "kind", "from_box", "to_box", "frames", "confidence", "reason")


def as_events(changes: Changes, ids: Mapping[Key, int | None]) -> list[ChangeEvent]:
    """The events of things that have an id, by the first member of their groups."""
    out = []
    for c in changes.events:
        instance = ids.get(c.first)
        if instance is not None:
            out.append(
                ChangeEvent(c.session_id, instance, c.kind, c.from_box, c.to_box, c.frames, c.confidence, c.reason)
            )
    return out
