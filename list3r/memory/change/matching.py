"""Match the instances of one session after another: seen again, moved, removed, added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from list3r.memory.change.places import Places, difference
from list3r.memory.change.records import Change, Changes, ChangeSettings, OverlapGroups
from list3r.memory.change.surface_colors import palette_distance
from list3r.memory.constraints import Constraints
from list3r.memory.geometry import Array, OrientedBox
from list3r.memory.merging.edges import Key
from list3r.memory.overlap.visibility import PlaceVisibility
from list3r.memory.records import MergeDecision

_NEVER = 1e6


@dataclass
class _PlacedInstance:
    """One instance and the places it had: groups by overlap, of which one is where it is now."""

    places: list[int]
    now: int
    state: str = "present"


@dataclass(frozen=True)
class _Move:
    """An instance that is gone from one place and found at another."""

    placed: _PlacedInstance
    place: int
    deviations: float
    """Sum of squared deviations between what is gone and what is found."""
    chance: float
    """Of being the same instance rather than one of the other candidates or none, in [0, 1]."""


class ChangeMatching:
    """Finds what each session has changed; the result is complete when all sessions were taken, in order."""

    def __init__(
        self, places: Places, found: OverlapGroups, constraints: Constraints, settings: ChangeSettings
    ) -> None:
        self._p, self._s, self._constraints = places, settings, constraints
        self._movable = [
            g[0] not in found.moving and places.flagged(n) < settings.most_structure
            for n, g in enumerate(places.groups)
        ]
        self._counts = [bool(show) and loose for show, loose in zip(found.shown, self._movable, strict=True)]
        self._placed = {n: _PlacedInstance([n], n) for n in range(len(places.groups))}
        self._instead: set[int] = set()
        """New instances that stand where others stood, and those others."""
        self._events: list[tuple[int, Change]] = []
        self._decisions: list[MergeDecision] = []

    def match(self, session: int) -> None:
        """What one session has changed."""
        p = self._p
        components = {c.component for c in p.rows.values() if c.session_id == session}
        fresh = [n for n, s in enumerate(p.sessions) if s[0] == session and p.component[n] in components]
        fresh = [n for n in fresh if self._counts[n] and p.known_before(n, session)]
        looks = {n: p.look_before(n, session) for n in fresh}
        gone = self._missing(session, components, [n for n in fresh if looks[n].verdict != "unseen"])
        left = {placed.now: p.box(placed.now, session, before=True) for placed, _ in gone}
        came = {n: p.box(n, session, before=False) for n in fresh}
        found_gone = {placed.now: found for placed, found in gone}
        replaced = {n for n in fresh if n in self._instead or self._replaces(n, left, session)}
        eligible = [n for n in fresh if looks[n].verdict != "there" or n in replaced]
        news = {n: came[n] for n in eligible}
        whole = [n for n in eligible if not self._scrap(n, news, session, before=False)]
        lost = [(t, found) for t, found in gone if not self._scrap(t.now, left, session, before=True)]
        moves = self._moves(lost, whole, session)
        ways = [(m.place, left[m.placed.now], came[m.place]) for m in moves]
        for move in moves:
            fresh.remove(move.place)
            self._move(move, session, found_gone[move.placed.now])
        for placed, found in gone:
            if placed.state == "unseen" and self._counts[placed.now]:
                along = any(self._went_along(placed.now, *way, session) for way in ways)
                if along or self._scrap(placed.now, left, session, before=True):
                    placed.state = "removed"
                else:
                    self._remove(placed, session, found)
        came = {n: box for n, box in came.items() if looks[n].verdict == "gone" or n in replaced}
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
    ) -> list[tuple[_PlacedInstance, PlaceVisibility]]:
        """Return the instances that are gone from where they were; all others that were known are given their state."""
        p = self._p
        gone: list[tuple[_PlacedInstance, PlaceVisibility]] = []
        for placed in self._instances():
            if p.sessions[placed.now][0] >= session or p.component[placed.now] not in components:
                continue
            seen = [n for n in placed.places if session in p.sessions[n]]
            if seen:
                self._seen(placed, seen, session)
            elif placed.state != "removed":
                found = self._look_for(placed, fresh, session)
                gone += [] if found is None else [(placed, found)]
        return gone

    def _look_for(self, placed: _PlacedInstance, fresh: Sequence[int], session: int) -> PlaceVisibility | None:
        """Return what frames tell about the place of an instance that was not found again, if it is gone from there."""
        p = self._p
        placed.state = "unseen"
        fresh = [m for m in fresh if not p.far_apart(placed.now, m)]
        if not fresh and p.out_of_sight(placed.now, session):
            return None
        if not self._movable[placed.now] or p.frames(placed.now, session) < self._s.least_frames:
            return None
        found = p.look_after(placed.now, session)
        other = self._displaced_by(placed.now, fresh, session)
        if found.verdict == "gone" or other is not None or self._taken(placed.now, found, fresh, session):
            self._instead.update([] if other is None else [other, placed.now])
            return found
        if found.verdict == "there" and self._counts[placed.now]:
            self._still_there(placed, session, found)
        return None

    def _taken(self, n: int, found: PlaceVisibility, fresh: Sequence[int], session: int) -> bool:
        """Return whether something new stands where an instance was: what is not seen through of it lies at that."""
        p, s = self._p, self._s
        if found.verdict == "unseen" or p.changed(n, session, before=True) < s.seen_through:
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

    def _instances(self) -> list[_PlacedInstance]:
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

    def _seen(self, placed: _PlacedInstance, places: list[int], session: int) -> None:
        p = self._p
        place = placed.now if placed.now in places else max(places, key=lambda n: (p.frames_in(n, session), -n))
        kind, reason = ("seen_again" if place == placed.now else "moved"), "its surface was found at its place in"
        before: OrientedBox | None = p.box(placed.now, session, before=True, stayed=True)
        if placed.state == "removed":
            kind, reason, before = "added", "it was gone, and its surface was found again in", None
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

    def _still_there(self, placed: _PlacedInstance, session: int, found: PlaceVisibility) -> None:
        placed.state = "present"
        box = self._p.box(placed.now, session, before=True, stayed=True)
        reason = f"a surface is measured where it was ({1 - found.free:.0%} of what could be judged)"
        self._record(
            placed,
            Change(self._first(placed), session, "seen_again", box, box, found.frames, 0.5 * (1 - found.free), reason),
        )

    def _remove(self, placed: _PlacedInstance, session: int, found: PlaceVisibility) -> None:
        placed.state = "removed"
        box = self._p.box(placed.now, session, before=True)
        reason = f"{len(found.frames)} frames see through its place ({found.free:.0%} of what could be judged)"
        self._record(
            placed, Change(self._first(placed), session, "removed", box, None, found.frames, self._sure(found), reason)
        )

    def _add(self, place: int, session: int, found: PlaceVisibility) -> None:
        placed = self._placed[place]
        placed.state = "added"
        box = self._p.box(place, session, before=False)
        seen = f"{len(found.frames)} frames of an earlier session see through its place"
        known = found.verdict == "gone"
        reason = seen if known else "it stands where something else stood that is gone"
        sure = self._sure(found) if known else 0.5
        self._record(
            placed,
            Change(self._first(placed), session, "added", None, box, self._p.evidence(place, session), sure, reason),
        )

    def _move(self, move: _Move, session: int, found: PlaceVisibility) -> None:
        p, placed, place = self._p, move.placed, move.place
        old, new = p.box(placed.now, session, before=True), p.box(place, session, before=False)
        a, b = p.groups[placed.now][0], p.groups[place][0]
        way = new.center - old.center
        distance = float(np.linalg.norm(way)) / p.unit
        lies = p.ties.covariance(session, old.center)
        stayed = bool(lies.any()) and float(way @ np.linalg.solve(lies, way)) <= self._s.placed_deviations**2
        kind = "seen_again" if stayed else "moved"
        reason = f"gone from its place and found {distance:.2f} m away, of the same look and size"
        if stayed:
            reason = f"found {distance:.2f} m away, which is within the uncertainty of how the sessions lie"
        scores = {"distance": round(distance, 3), "deviations": round(move.deviations, 3), "chance": move.chance}
        self._decisions.append(MergeDecision("merge", f"{a[0]}:{a[1]}", f"{b[0]}:{b[1]}", scores, reason))
        sure = self._sure(found) * move.chance
        self._record(
            placed, Change(self._first(placed), session, kind, old, new, p.evidence(place, session), sure, reason)
        )
        placed.places.append(place)
        placed.now, placed.state = place, "present" if stayed else "moved"
        del self._placed[place]

    def _sure(self, found: PlaceVisibility) -> float:
        """Return how certain it is that what frames see through is gone."""
        frames = len(found.frames)
        return float(max(found.free, self._s.least_sure) * frames / (frames + 1.0))

    def _first(self, placed: _PlacedInstance) -> Key:
        return self._p.groups[placed.places[0]][0]

    def _record(self, placed: _PlacedInstance, change: Change) -> None:
        change = replace(change, frames=change.frames[:8], confidence=round(change.confidence, 3))
        self._events.append((placed.places[0], change))

    def _moves(
        self, gone: Sequence[tuple[_PlacedInstance, PlaceVisibility]], fresh: Sequence[int], session: int
    ) -> list[_Move]:
        """Return pairs of what is gone and what is new, one to one, of least difference in all."""
        from scipy.optimize import linear_sum_assignment

        if not gone or not fresh:
            return []
        p = self._p
        cost = np.full((len(gone), len(fresh)), _NEVER)
        new = [p.looks(n, session, before=False, stayed=n in self._instead) for n in fresh]
        for i, (placed, _) in enumerate(gone):
            old = p.looks(placed.now, session, before=True, stayed=placed.now in self._instead)
            taken = {s for n in placed.places for s in p.sessions[n]}
            own = [k for n in placed.places for k in p.groups[n]]
            for j, n in enumerate(fresh):
                if (
                    p.component[n] == p.component[placed.now]
                    and not taken.intersection(p.sessions[n])
                    and not self._constraints.forbids(own, list(p.groups[n]))
                ):
                    cost[i, j] = min(difference(old, new[j], self._s, p.unit), _NEVER)
        # For every instance that is gone there is one more column: that it was not found, at the price of the limit.
        rest = np.full((len(gone), len(gone)), _NEVER)
        np.fill_diagonal(rest, self._s.most_deviations)
        rows, columns = linear_sum_assignment(np.hstack([cost, rest]))
        return [
            _Move(gone[i][0], fresh[j], float(cost[i, j]), _chance(cost, i, j, self._s.most_deviations))
            for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
            if j < len(fresh) and cost[i, j] < _NEVER
        ]

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


def _height(box: OrientedBox) -> float:
    """Return the extent of a box along the world's z."""
    return float(np.abs(box.rotation[2]) @ box.size)


def _chance(cost: Array, i: int, j: int, none: float) -> float:
    """Return how likely a pair is, beside the other candidates of either and that there is none, by their
    deviations.
    """
    others = np.concatenate([np.delete(cost[i], j), np.delete(cost[:, j], i), [none]])
    odds = float(np.exp(-0.5 * (others - cost[i, j])).sum())
    return round(1.0 / (1.0 + odds), 3)
