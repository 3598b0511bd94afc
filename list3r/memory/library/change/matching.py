"""Match the instances of one session after another: seen again, moved, removed, added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.core.constraints import Constraints
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import MergeDecision
from list3r.memory.library.change.moves import Missing, Move, MoveSearch, PlacedInstance
from list3r.memory.library.change.places import Places
from list3r.memory.library.change.records import Change, Changes, ChangeSettings, OverlapGroups
from list3r.memory.library.change.surface_colors import palette_distance
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.visibility import PlaceVisibility


class ChangeMatching:
    """Finds what each session has changed; the result is complete when all sessions were taken, in order."""

    def __init__(
        self, places: Places, found: OverlapGroups, constraints: Constraints, settings: ChangeSettings
    ) -> None:
        self._p, self._s = places, settings
        self._search = MoveSearch(places, constraints, settings)
        self._movable = [
            g[0] not in found.moving and places.flagged(n) < settings.most_structure
            for n, g in enumerate(places.groups)
        ]
        self._counts = [bool(show) and loose for show, loose in zip(found.shown, self._movable, strict=True)]
        self._placed = {n: PlacedInstance([n], n) for n in range(len(places.groups))}
        self._instead: set[int] = set()
        """New instances that stand where others stood, and those others."""
        self._events: list[tuple[int, Change]] = []
        self._decisions: list[MergeDecision] = []
        self._told_gone: set[int] = set()
        """First places of instances that were told to be gone."""
        self._vacated: dict[int, OrientedBox] = {}
        """Places whose instances a session found at other places that they had before."""
        self._elsewhere: list[PlacedInstance] = []
        """Instances that a session did not find, though nothing tells it that they have just gone."""

    def match(self, session: int) -> None:
        """What one session has changed."""
        p = self._p
        components = {c.component for c in p.rows.values() if c.session_id == session}
        fresh = [n for n, s in enumerate(p.sessions) if s[0] == session and p.component[n] in components]
        fresh = [n for n in fresh if self._counts[n] and p.known_before(n, session)]
        looks = {n: p.look_before(n, session) for n in fresh}
        self._vacated, self._elsewhere = {}, []
        gone = self._missing(session, components, [n for n in fresh if looks[n].verdict != "unseen"])
        left = self._vacated | {placed.now: p.box(placed.now, session, before=True) for placed, _ in gone}
        boxes = {n: p.box(n, session, before=False) for n in fresh}
        replaced = {n for n in fresh if n in self._instead or self._replaces(n, left, session)}
        came = {n: box for n, box in boxes.items() if looks[n].verdict == "gone" or n in replaced}
        eligible = [n for n in fresh if looks[n].verdict != "there" or n in replaced]
        news = {n: boxes[n] for n in eligible}
        whole = [n for n in eligible if not self._scrap(n, news, session, before=False)]
        missing = [Missing(t, found) for t, found in gone if not self._scrap(t.now, left, session, before=True)]
        missing += [Missing(placed) for placed in self._elsewhere]
        ways = []
        for move in self._search.moves(missing, whole, came, self._instead, session):
            fresh.remove(move.place)
            if move.placed.now in left:
                ways.append((move.place, left[move.placed.now], boxes[move.place]))
            self._move(move, session, looks[move.place])
        for placed, found in gone:
            if placed.state == "unseen" and self._counts[placed.now]:
                along = any(self._went_along(placed.now, *way, session) for way in ways)
                if along or self._scrap(placed.now, left, session, before=True):
                    placed.state = "removed"
                elif found.told >= self._s.told:
                    self._remove(placed, session, found)
        for n in fresh:
            scrap = n in came and self._scrap(n, came, session, before=False)
            if n in came and not scrap and not any(self._came_along(n, *way, session) for way in ways):
                self._add(n, session, looks[n])

    def _replaces(self, n: int, left: dict[int, OrientedBox], session: int) -> bool:
        """Return whether a new instance stands where one stood that is gone."""
        p, s = self._p, self._s
        return any(
            p.component[n] == p.component[place]
            and p.inside(n, box, s.replaced_slack_m, session, before=False) >= s.replaced
            for place, box in left.items()
        )

    def _missing(
        self, session: int, components: set[int], fresh: Sequence[int]
    ) -> list[tuple[PlacedInstance, PlaceVisibility]]:
        """Return the instances that are gone from where they were; all others that were known are given their state."""
        p = self._p
        gone: list[tuple[PlacedInstance, PlaceVisibility]] = []
        for placed in self._instances():
            if p.sessions[placed.now][0] >= session or p.component[placed.now] not in components:
                continue
            seen = [n for n in placed.places if session in p.sessions[n]]
            if seen:
                self._seen(placed, seen, session)
                continue
            found = None if placed.state == "removed" else self._look_for(placed, fresh, session)
            if found is not None:
                gone.append((placed, found))
            elif self._may_be_elsewhere(placed, session):
                self._elsewhere.append(placed)
        return gone

    def _may_be_elsewhere(self, placed: PlacedInstance, session: int) -> bool:
        """Return whether an instance was told to be gone, or nothing is told of it."""
        if placed.state == "removed":
            return placed.places[0] in self._told_gone
        return placed.state == "unseen" and self._counts[placed.now] and self._well_seen(placed.now, session)

    def _look_for(self, placed: PlacedInstance, fresh: Sequence[int], session: int) -> PlaceVisibility | None:
        """Return what frames tell about the place of an instance that was not found again, if it is gone from there."""
        p = self._p
        placed.state = "unseen"
        fresh = [m for m in fresh if not p.far_apart(placed.now, m)]
        if not fresh and p.out_of_sight(placed.now, session):
            return None
        if not self._movable[placed.now] or not self._well_seen(placed.now, session):
            return None
        found = p.look_after(placed.now, session)
        other = self._displaced_by(placed.now, fresh, session)
        if found.verdict == "gone" or other is not None or self._taken(placed.now, found, fresh, session):
            self._instead.update([] if other is None else [other, placed.now])
            return replace(found, told=p.told(placed.now, other, session))
        if found.verdict == "there" and self._counts[placed.now]:
            self._still_there(placed, session, found)
        return None

    def _well_seen(self, n: int, before: int) -> bool:
        return self._p.frames(n, before) >= self._s.least_frames

    def _taken(self, n: int, found: PlaceVisibility, fresh: Sequence[int], session: int) -> bool:
        """Return whether something new stands where an instance was: what is not seen through of it lies at that."""
        p, s = self._p, self._s
        if len(found.frames) < s.visibility.least_frames or p.changed(n, session, before=True) < s.seen_through:
            return False
        new = [m for m in fresh if p.component[m] == p.component[n]]
        new = [m for m in new if p.changed(m, session, before=False) >= s.seen_through / 2]
        return p.explained(n, new, session) >= s.explained

    def _displaced_by(self, n: int, fresh: Sequence[int], session: int) -> int | None:
        """Something new of other looks that is where most of an instance was: two instances are never at one place."""
        p, s = self._p, self._s
        for m in fresh:
            if p.component[m] != p.component[n]:
                continue
            if p.other_surface(n, m, session):
                return m
            if p.changed(m, session, before=False) >= s.mostly_new:
                box = p.box(m, session, before=False, stayed=True)
                if p.inside(n, box, 0.0, session, before=True) < s.displaced:
                    continue
                old, new = (p.looks(k, session, before=k == n).palette for k in (n, m))
                if palette_distance(old, new) > s.other_palette:
                    return m
        return None

    def _instances(self) -> list[PlacedInstance]:
        return [placed for n, placed in sorted(self._placed.items()) if placed.places[0] == n]

    def _scrap(self, n: int, boxes: dict[int, OrientedBox], session: int, *, before: bool) -> bool:
        """Return whether it is a scrap of a larger instance that went or came with it."""
        own = float(np.prod(boxes[n].size))
        return any(
            float(np.prod(box.size)) > own
            and self._p.inside(n, box, self._s.replaced_slack_m, session, before=before) >= self._s.part
            for m, box in boxes.items()
            if m != n and self._p.component[m] == self._p.component[n]
        )

    def _went_along(self, n: int, place: int, old: OrientedBox, new: OrientedBox, session: int) -> bool:
        """Return whether it is a part of an instance that moved, which was found whole where that is now.

        Either the tops or the bottoms of what was found of it in both places are the same.
        """
        p, s = self._p, self._s
        if p.component[n] != p.component[place]:
            return False
        way, taller = new.center - old.center, _height(new) - _height(old)
        boxes = [replace(new, center=new.center - way - np.array([0.0, 0.0, end * taller / 2])) for end in (-1.0, 1.0)]
        return any(p.inside(n, box, s.replaced_link_m, session, before=True) >= s.part for box in boxes)

    def _came_along(self, n: int, place: int, old: OrientedBox, new: OrientedBox, session: int) -> bool:
        """Return whether it is a part of an instance that moved, of which another part was found in its new place."""
        p, s = self._p, self._s
        if p.component[n] != p.component[place]:
            return False
        sides = np.maximum(np.sort(old.size[:2]), np.sort(new.size[:2]))[np.argsort(np.argsort(new.size[:2]))]
        whole = replace(new, size=np.array([*sides, max(old.size[2], new.size[2])]))
        return p.inside(n, whole, s.replaced_link_m, session, before=False) >= s.part

    def _seen(self, placed: PlacedInstance, places: list[int], session: int) -> None:
        p = self._p
        place = placed.now if placed.now in places else max(places, key=lambda n: (p.frames_in(n, session), -n))
        kind, reason = ("seen_again" if place == placed.now else "moved"), "its surface was found at its place in"
        before: OrientedBox | None = p.box(placed.now, session, before=True, stayed=True)
        if placed.state == "removed":
            kind, reason, before = "added", "it was gone, and its surface was found again in", None
        elif kind == "moved":
            self._vacated[placed.now] = p.box(placed.now, session, before=True, stayed=True)
        after = p.box(place, session, before=False, stayed=True)
        placed.now, placed.state = place, "present" if kind == "seen_again" else kind
        if self._counts[place]:
            frames = p.frames_in(place, session)
            reason = f"{reason} {frames} frames"
            sure = frames / (frames + self._s.half_sure_frames)
            self._record(
                placed,
                Change(self._first(placed), session, kind, before, after, p.evidence(place, session), sure, reason),
            )

    def _still_there(self, placed: PlacedInstance, session: int, found: PlaceVisibility) -> None:
        placed.state = "present"
        box = self._p.box(placed.now, session, before=True, stayed=True)
        reason = f"a surface is measured where it was ({1 - found.free:.0%} of what could be judged)"
        self._record(
            placed,
            Change(self._first(placed), session, "seen_again", box, box, found.frames, 0.5 * (1 - found.free), reason),
        )

    def _remove(self, placed: PlacedInstance, session: int, found: PlaceVisibility) -> None:
        placed.state = "removed"
        self._told_gone.add(placed.places[0])
        box = self._p.box(placed.now, session, before=True)
        reason = f"{_frames_see(found)} ({found.free:.0%} of what could be judged)"
        self._record(
            placed, Change(self._first(placed), session, "removed", box, None, found.frames, self._sure(found), reason)
        )

    def _add(self, place: int, session: int, found: PlaceVisibility) -> None:
        placed = self._placed[place]
        placed.state = "added"
        box = self._p.box(place, session, before=False)
        seen = _frames_see(found, " of an earlier session")
        known = found.verdict == "gone"
        reason = seen if known else "it stands where something else stood that is gone"
        sure = self._sure(found) if known else 0.5
        self._record(
            placed,
            Change(self._first(placed), session, "added", None, box, self._p.evidence(place, session), sure, reason),
        )

    def _move(self, move: Move, session: int, look: PlaceVisibility) -> None:
        """An instance is at another place now, of which earlier sessions saw what `look` tells."""
        p, placed, place, found = self._p, move.placed, move.place, move.missing.gone
        old, new = p.box(placed.now, session, before=True), p.box(place, session, before=False)
        a, b = p.groups[placed.now][0], p.groups[place][0]
        way = new.center - old.center
        distance = float(np.linalg.norm(way)) / p.unit
        lies = p.ties.covariance(session, old.center)
        stayed = bool(lies.any()) and float(way @ np.linalg.solve(lies, way)) <= self._s.placed_deviations**2
        kind, state = ("seen_again", "present") if stayed else ("moved", "moved")
        reason = f"gone from its place and found {distance:.2f} m away, of the same look and size"
        if placed.state == "removed":
            kind, state = "added", "added"
            reason = f"it was gone, and was found {distance:.2f} m from where it had been, of the same look and size"
        elif stayed:
            reason = f"found {distance:.2f} m away, which is within the uncertainty of how the sessions lie"
        elif move.missing.hidden:
            reason = f"found {distance:.2f} m away, of the same look and size; no frame tells of where it was"
        scores = {"distance": round(distance, 3), "deviations": round(move.deviations, 3), "chance": move.chance}
        self._decisions.append(MergeDecision("merge", f"{a[0]}:{a[1]}", f"{b[0]}:{b[1]}", scores, reason))
        before = None if kind == "added" else old
        sure = move.chance * (self._sure(found or look) if found or look.verdict == "gone" else 0.5)
        self._record(
            placed, Change(self._first(placed), session, kind, before, new, p.evidence(place, session), sure, reason)
        )
        self._join(placed, place, state)

    def _join(self, placed: PlacedInstance, place: int, state: str) -> None:
        """An instance is at another place now."""
        placed.places.append(place)
        placed.now, placed.state = place, state
        del self._placed[place]

    def _sure(self, found: PlaceVisibility) -> float:
        """Return how certain it is that what frames see through is gone."""
        frames = len(found.frames)
        return float(max(found.free, self._s.least_sure) * frames / (frames + 1.0))

    def _first(self, placed: PlacedInstance) -> Key:
        return self._p.groups[placed.places[0]][0]

    def _record(self, placed: PlacedInstance, change: Change) -> None:
        change = replace(change, frames=change.frames[:8], confidence=round(change.confidence, 3))
        self._events.append((placed.places[0], change))

    def result(self) -> Changes:
        """Return the groups as the matching leaves them."""
        groups, current, states = [], {}, {}
        names: dict[int, Key] = {}
        for placed in self._instances():
            keys = sorted(k for n in placed.places for k in self._p.groups[n])
            groups.append(keys)
            names[placed.places[0]] = keys[0]
            if len(placed.places) > 1:
                current[keys[0]] = tuple(self._p.groups[placed.now])
            if placed.state != "present":
                states[keys[0]] = placed.state
        events = tuple(replace(c, first=names[n]) for n, c in self._events if n in names)
        return Changes(sorted(groups), current, states, events, self._decisions)


def _frames_see(found: PlaceVisibility, of: str = "") -> str:
    what = "see another surface in its place" if found.by_color else "see through its place"
    return f"{len(found.frames)} frames{of} {what}"


def _height(box: OrientedBox) -> float:
    """Return the extent of a box along the world's z."""
    return float(np.abs(box.rotation[2]) @ box.size)
