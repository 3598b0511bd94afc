"""The places of instances, session by session: what was seen there, what it looked like, what frames tell about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.geometry import Array, OrientedBox
from list3r.memory.core.records import ChunkRow
from list3r.memory.library.change.records import ChangeSettings
from list3r.memory.library.change.surface_colors import (
    HALF_LIGHT,
    SAME_LIGHT,
    Colors,
    LightBetween,
    color_distance,
    lab,
    meeting,
    small_picture,
)
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.summaries import ChunkSummary, world_unit
from list3r.memory.library.overlap.visibility import (
    DepthView,
    Ints,
    OtherSurface,
    PlaceVisibility,
    VisibilitySettings,
    changed_points,
    chunk_views,
    in_sight_of,
    place_visibility,
    seen_through_shares,
    tally,
)
from list3r.memory.library.relations.instance_geometry import fit_box
from list3r.memory.library.world.session_ties import SessionTies
from list3r.memory.store.store import Store

_PICTURES = 256
"""Small pictures of keyframes that are kept at a time: the next question is about a place near by."""
_SPREAD = 0.02
"""Share of points outside the box at either end by which instances are compared."""


@dataclass(frozen=True)
class GroupLooks:
    """What a group looks like, over the members of some sessions."""

    extent: Array
    """Larger and smaller side of the footprint, height; world units, upright where gravity is known. Shape (3,)."""
    palette: Array
    """Colours of its surface, CIE L*a*b*, lightness at half weight, in the light of the later session. Shape (N, 3)."""


class Places:
    """The groups of local instances as places of instances, numbered."""

    def __init__(
        self,
        store: Store,
        groups: Sequence[Sequence[Key]],
        chunks: Sequence[ChunkRow],
        summaries: Mapping[int, ChunkSummary],
        settings: ChangeSettings,
    ) -> None:
        self.groups = groups
        self.rows = {c.chunk_id: c for c in chunks}
        self._shapes = cache(lambda chunk_id: summaries[chunk_id].shapes)
        self.unit = world_unit(chunks, summaries)
        self.ties = SessionTies(store.edges.all(), self.rows)
        self._upright = store.facts.gravity != "unknown"
        self._first = min(c.component for c in chunks)
        self._store, self._s = store, settings
        self._computed = min((c.session_id for c in chunks if c.scale_kind != "metric"), default=None)
        self._coarse = replace(settings.visibility, noise_share=settings.computed_noise)
        self._views_of, self._sights = cache(self._read_views), cache(self._read_sights)
        self.light, self.extent, self.frames_in = cache(self._light_in), cache(self._box_round), cache(self._frames_in)
        self._member_changed, self._summed_up = cache(self._changed_of_member), cache(self._sum_up)
        self._stayed_box = cache(self._box_in)
        self._structure = store.local_instances.structure(sorted(self.rows))
        self._picture = lru_cache(_PICTURES)(self._read_picture)
        self.sessions = [sorted({self.rows[k].session_id for k, _ in g}) for g in groups]
        self.component = [self.rows[g[0][0]].component for g in groups]

    def _visibility(self, session: int) -> VisibilitySettings:
        """Return how exactly depth of a session and those before tells about places."""
        return self._s.visibility if self._computed is None or session < self._computed else self._coarse

    def members(self, n: int, session: int, *, before: bool, stayed: bool = False) -> list[Key]:
        """Return members of the last session before, or of this one; those that tell of the change, if it has not
        `stayed`.
        """
        wanted = self._told_by(n, session, before=before)
        inside = [k for k in self.groups[n] if self.rows[k[0]].session_id == wanted]
        return inside if stayed else self._pure(n, inside, session, before=before)

    def _told_by(self, n: int, session: int, *, before: bool) -> int:
        """Return the last session before that saw an instance, or this one."""
        return max((s for s in self.sessions[n] if s < session), default=session) if before else session

    def _pure(self, n: int, members: list[Key], session: int, *, before: bool) -> list[Key]:
        """Return those that hold least of what stayed, where what they show has changed: not what is mixed with a
        table.
        """
        if len(members) < 2:
            return members
        shares = np.array([self._member_changed(key, n, session, before) for key in members])
        common = float(np.average(shares, weights=[len(self._points_of(key)) + 1 for key in members]))
        if common < self._s.seen_through / 2:
            return members
        return [k for k, share in zip(members, shares.tolist(), strict=True) if share >= self._s.pure * common]

    def _changed_of_member(self, key: Key, n: int, session: int, before: bool) -> float:
        """Return the share of the surface of one member that is seen through."""
        return self._changed(self._points_of(key), n, session, before=before)

    def points(self, n: int, session: int, *, before: bool, stayed: bool = False) -> Array:
        """Return some surface points, world coordinates. Shape (N, 3)."""
        return self._thinned(n, session, before=before, stayed=stayed)[0]

    def _thinned(self, n: int, session: int, *, before: bool, stayed: bool = False) -> tuple[Array, Colors]:
        """Return the same and their colours. Shape (N, 3) each."""
        keys = self.members(n, session, before=before, stayed=stayed)
        points = np.concatenate([self._points_of(key) for key in keys]) if keys else np.zeros((0, 3))
        rgb = np.concatenate([self._colors_of(key) for key in keys]) if keys else np.zeros((0, 3), np.uint8)
        step = max(1, len(points) // self._s.points)
        return points[::step], rgb[::step]

    def box(self, n: int, session: int, *, before: bool, stayed: bool = False) -> OrientedBox:
        """Return the box of what was seen of it; unless it has stayed, of what of that has changed."""
        if stayed:
            return self._stayed_box(n, self._told_by(n, session, before=before))
        points = self.points(n, session, before=before)
        views = self._views_across(n, session, before=before)
        return self._box_of(n, self._with_foot(points, self._changed_rows(points, views)))

    def _box_in(self, n: int, session: int) -> OrientedBox:
        """Return the box of all that a session saw of it."""
        return self._box_of(n, self.points(n, session, before=False, stayed=True))

    def _box_of(self, n: int, points: Array) -> OrientedBox:
        upright = self._upright and self.component[n] == self._first
        return fit_box(points if len(points) else np.zeros((1, 3)), upright=upright)

    def out_of_sight(self, n: int, session: int) -> bool:
        """Return whether no frame of a session can tell about any surface of an instance."""
        low, high = self.extent(n)
        sights = self._sights(session, self.component[n])
        return not bool(np.all((sights[:, 0] <= high) & (sights[:, 1] >= low), axis=1).any())

    def _read_sights(self, session: int, component: int) -> Array:
        return in_sight_of(self._views_of(session, component), self._s.visibility)

    def far_apart(self, n: int, m: int) -> bool:
        """Return whether two instances are so far apart that no surface of `n` meets `m`, or is in the box of `m`.

        The box of some points reaches beyond them by less than twice the diagonal of their extent.
        """
        a, b = self.extent(n), self.extent(m)
        meets = max(self._s.meets_m, self._s.replaced_link_m) * self.unit
        reach = 2.0 * np.linalg.norm(b[1] - b[0]) + meets
        return bool(np.any((a[0] > b[1] + reach) | (a[1] < b[0] - reach)))

    def _box_round(self, n: int) -> Array:
        """Return the box round all that was ever seen of an instance, world coordinates; NaN where there is nothing.
        Shape (2, 3).
        """
        points = np.concatenate([self._points_of(key) for key in self.groups[n]])
        return np.array([points.min(axis=0), points.max(axis=0)]) if len(points) else np.full((2, 3), np.nan)

    def inside(self, n: int, box: OrientedBox, slack_m: float, session: int, *, before: bool) -> float:
        """Return the share of its surface points in a box."""
        points = self.points(n, session, before=before)
        if len(points) == 0:
            return 0.0
        off = np.abs((points - box.center) @ box.rotation)
        return float(np.mean(np.all(off <= box.size / 2 + slack_m * self.unit, axis=1)))

    def look_after(self, n: int, session: int) -> PlaceVisibility:
        """Return what a session's frames see where an instance was before."""
        return self._look(n, self._views_of(session, self.component[n]), session, before=True)

    def look_before(self, n: int, session: int) -> PlaceVisibility:
        """Return what the frames of the last session that could tell saw where an instance is now.

        A session of which too few frames tell is passed over where one before it can.
        """
        doubtful = PlaceVisibility("unseen", 0.0, ())
        for views in self._views_before(n, session):
            found = self._look(n, views, session, before=False)
            if found.verdict == "unclear" and len(found.frames) < self._s.visibility.least_frames:
                doubtful = found if doubtful.verdict == "unseen" else doubtful
            elif found.verdict != "unseen":
                return found
        return doubtful

    def _look(self, n: int, views: Sequence[DepthView], session: int, *, before: bool) -> PlaceVisibility:
        """Return what frames see at a place, by depth and, where depth sees a surface, by its colours; "unseen" where
        the uncertainty of the session's pose allows that the instance is there.
        """
        (points, rgb), s = self._thinned(n, session, before=before), self._s
        visibility = self._visibility(session)
        found, other = place_visibility(points, views, visibility), None
        if found.verdict in ("there", "unclear"):
            other = self._other_colors(rgb, session, before=before)
            by_color = found if other is None else place_visibility(points, views, visibility, other)
            found = by_color if by_color.verdict == "gone" else found
        if found.verdict == "gone":
            known = visibility.tolerance_m * self.unit
            for shift in self.ties.shifts(session, points.mean(axis=0), s.placed_deviations, known):
                if place_visibility(points + shift, views, visibility, other).verdict != "gone":
                    return PlaceVisibility("unseen", 0.0, ())
        return found

    def _other_colors(self, rgb: Colors, session: int, *, before: bool) -> OtherSurface | None:
        """Return a test whether frames show other colours than points have; None where the light is not known.

        The points were seen `before` the session and the frames are of it, or the other way round. Shape (N, 3).
        """
        light = self.light(session)
        if light is SAME_LIGHT:
            return None
        own, limit = light.lab(rgb) if before else lab(rgb), light.limit(self._s)

        def other(view: DepthView, points: Array, rows: Ints) -> NDArray[np.bool_]:
            picture = self._picture(view.chunk_id, view.frame_index, *view.depth.shape)
            if picture is None:
                return np.zeros(len(rows), bool)
            u, v = view.pixels(points)
            shown = lab(picture[v, u]) if before else light.lab(picture[v, u])
            return color_distance(own[rows], shown) > limit

        return other

    def _read_picture(self, chunk_id: int, frame_index: int, height: int, width: int) -> Colors | None:
        return small_picture(self._store.keyframes.get(chunk_id, frame_index).jpeg, height, width)

    def changed(self, n: int, session: int, *, before: bool) -> float:
        """Return the share of its observed surface that is seen through: of what was, by a session that comes after;
        of what is, by the sessions before.
        """
        return self._changed(self.points(n, session, before=before), n, session, before=before)

    def explained(self, n: int, new: Sequence[int], session: int) -> float:
        """Return the share of the observed surface of an instance that is seen through or near a new instance there."""
        points = self.points(n, session, before=True)
        free, met = tally(points, self._views_of(session, self.component[n]), self._visibility(session))
        known, near = free + met > 0, self._at_new(points, new, session)
        return float(np.mean((near | (free > met))[known])) if known.any() else 0.0

    def told(self, n: int, other: int | None, session: int) -> float:
        """Return the share of all of the surface that an instance had of which frames tell, or which lies at an `other`
        instance that has its place: the rest may still be there.
        """
        points = self.points(n, session, before=True, stayed=True)
        free, met = tally(points, self._views_of(session, self.component[n]), self._visibility(session))
        near = self._at_new(points, [] if other is None else [other], session)
        return float(np.mean(near | (free + met > 0))) if len(points) else 0.0

    def _at_new(self, points: Array, new: Sequence[int], session: int) -> NDArray[np.bool_]:
        """Return which points lie at the surface of something new. Shape (N,)."""
        surfaces = [x for x in (self.points(m, session, before=False) for m in new) if len(x)]
        if not surfaces:
            return np.zeros(len(points), bool)
        return meeting(cKDTree(np.concatenate(surfaces)), points, self._s.replaced_link_m * self.unit)[0]

    def _changed(self, points: Array, n: int, session: int, *, before: bool) -> float:
        lists = [self._views_of(session, self.component[n])] if before else self._views_before(n, session)
        shares = (seen_through_shares([points], views, self._visibility(session))[0] for views in lists)
        return next((share for share in shares if share is not None), 0.0)

    def _views_before(self, n: int, session: int) -> Iterator[list[DepthView]]:
        """Return the views of the sessions before that can tell about an instance, the last session first."""
        component = self.component[n]
        earlier = {c.session_id for c in self.rows.values() if c.component == component and c.session_id < session}
        told_by = (s for s in sorted(earlier, reverse=True) if not self.out_of_sight(n, s))
        return (self._views_of(s, component) for s in told_by)

    def known_before(self, n: int, session: int) -> bool:
        """Return whether an earlier session is in the same world, so that an instance can be new to it."""
        return any(c.component == self.component[n] and c.session_id < session for c in self.rows.values())

    def looks(self, n: int, session: int, *, before: bool, stayed: bool = False) -> GroupLooks:
        """Return its looks, the views that show most of it first; what is there all along is left out of its size,
        unless that has other colours now, so that it has not `stayed` where depth says so.

        `before` a session that does not show it there any more, in all earlier ones, else in the first that does.
        """
        if before:
            keys = [k for k in self.groups[n] if self.rows[k[0]].session_id < session]
            keys = keys if stayed else self._pure(n, keys, session, before=True)
        else:
            keys = self.members(n, session, before=False, stayed=stayed)
        weight = np.array([self._shapes(k).areas_px[self._at(k, i)].max(initial=1) for k, i in keys], float)
        views = [] if stayed else self._views_across(n, session, before=before)
        rgb = [self._colors_of(key)[self._changed_rows(self._points_of(key), views)] for key in keys]
        light = self.light(session) if before else SAME_LIGHT
        return GroupLooks(self._extent(keys, weight, views), light.lab(np.concatenate(rgb)))

    def plainly_other(self, n: int, m: int) -> bool:
        """Return whether two groups cannot be one instance by the size and the colour that chunks say of them."""
        (size_a, lab_a), (size_b, lab_b) = self._summed_up(n), self._summed_up(m)
        ratio = max(size_a, size_b) / max(min(size_a, size_b), 1e-9)
        color = float(np.linalg.norm((lab_a - lab_b) * HALF_LIGHT))
        return ratio > self._s.other_size or color > self._s.other_color

    def _sum_up(self, n: int) -> tuple[float, Array]:
        rows = [(self._shapes(k), self._at(k, i)) for k, i in self.groups[n]]
        sizes, labs = [shape.size[at] / shape.unit for shape, at in rows], [shape.lab[at] for shape, at in rows]
        return float(np.median(sizes)), np.median(labs, axis=0)

    def _light_in(self, session: int) -> LightBetween:
        """Return how the colours of the sessions before come out in a session, by what both have seen."""
        seen_again = [n for n, sessions in enumerate(self.sessions) if session in sessions and sessions[0] < session]
        nothing = np.zeros((0, 3), np.uint8)
        before, after = zip((nothing, nothing), *(self._meeting(n, n, session) for n in seen_again), strict=True)
        return LightBetween.of(np.concatenate(before), np.concatenate(after)) or SAME_LIGHT

    def other_surface(self, n: int, m: int, session: int) -> bool:
        """Return whether a new instance `m` is where the surface of `n` was, in other colours."""
        a, b = self._meeting(n, m, session)
        light = self.light(session)
        if len(a) < self._s.displaced * sum(len(self._points_of(k)) for k in self._surface(n, session, before=True)):
            return False
        return len(a) > 0 and float(np.median(color_distance(light.lab(a), lab(b)))) > light.limit(self._s)

    def _meeting(self, n: int, m: int, session: int) -> tuple[Colors, Colors]:
        """Return the colours of the points of `n` before a session that meet `m` in it, and of what they meet."""
        old, new = self._surface(n, session, before=True), self._surface(m, session, before=False)
        points = [np.concatenate([self._points_of(k) for k in keys]) for keys in (old, new)]
        rgb = [np.concatenate([self._colors_of(k) for k in keys]) for keys in (old, new)]
        if not len(points[0]) or not len(points[1]):
            return rgb[0][:0], rgb[1][:0]
        near, at = meeting(cKDTree(points[1]), points[0], self._s.meets_m * self.unit)
        return rgb[0][near], rgb[1][at]

    def _surface(self, n: int, session: int, *, before: bool) -> list[Key]:
        return self.members(n, session, before=before, stayed=True)

    def _extent(self, keys: Sequence[Key], weight: Array, views: Sequence[DepthView]) -> Array:
        """Return the weighted median over its whole views, so that what one view took from its surroundings does not
        count.
        """
        whole = [self._shapes(k).truncated[self._at(k, i)] < self._s.most_truncated for k, i in keys]
        sizes, weights = [], []
        for key, is_whole, w in zip(keys, whole, weight, strict=True):
            points = self._points_of(key)
            points = self._with_foot(points, self._changed_rows(points, views))
            if len(points) and (is_whole or not any(whole)):
                sizes.append(self._sides(fit_box(points, upright=self._upright, trim=_SPREAD)))
                weights.append(w)
        if not sizes:
            return np.ones(3)
        return np.array([_weighted_median(np.array(sizes)[:, d], np.array(weights)) for d in range(3)])

    def _views_across(self, n: int, session: int, *, before: bool) -> list[DepthView]:
        """Return the views that tell what of an instance has changed: of this session where it was there before, else
        before.
        """
        return self._views_of(session, self.component[n]) if before else next(self._views_before(n, session), [])

    def _changed_rows(self, points: Array, views: Sequence[DepthView]) -> NDArray[np.bool_]:
        """Return which points have changed, where that is enough of them; else all. Shape (N,)."""
        changed = changed_points(points, views, self._s.visibility)
        return changed if changed.sum() >= self._s.least_changed * len(points) else np.ones(len(points), bool)

    def _with_foot(self, points: Array, changed: NDArray[np.bool_]) -> Array:
        """Return the points that have changed, and points below them that depth does not part from their support."""
        if not self._upright or changed.all() or not changed.any():
            return points[changed]
        box = fit_box(points[changed], upright=True, trim=_SPREAD)
        off = np.abs((points - box.center) @ box.rotation)[:, :2]
        lowest = float(box.center[2] - box.size[2] / 2)
        foot = (off <= box.size[:2] / 2).all(axis=1) & (points[:, 2] < lowest)
        foot &= points[:, 2] > lowest - self._s.foot_m * self.unit
        return points[changed | foot]

    def _sides(self, box: OrientedBox) -> Array:
        if not self._upright:
            return np.sort(box.size)[::-1]
        return np.array([*np.sort(box.size[:2])[::-1], box.size[2]])

    def flagged(self, n: int) -> float:
        """Return the share of its members that are flagged as structure."""
        return sum(key in self._structure for key in self.groups[n]) / len(self.groups[n])

    def frames(self, n: int, before: int) -> int:
        """Return frames of earlier sessions in which an instance was seen."""
        return sum(self.frames_in(n, s) for s in self.sessions[n] if s < before)

    def _frames_in(self, n: int, session: int) -> int:
        """Return frames of one session's recording in which an instance was seen."""
        own = [self._shapes(k).stands_for for k, _ in self.groups[n] if self.rows[k].session_id == session]
        return max(own, default=1) * len({f for _, f in self._sightings(n, session)})

    def evidence(self, n: int, session: int) -> tuple[tuple[int, int], ...]:
        """Return the frames of a session that see most of an instance."""
        best: dict[int, int] = {}
        for area, frame in self._sightings(n, session):
            best[frame] = max(area, best.get(frame, 0))
        return tuple((session, f) for f in sorted(best, key=lambda f: (-best[f], f)))

    def _sightings(self, n: int, session: int) -> list[tuple[int, int]]:
        out = []
        for chunk_id, local_id in self.groups[n]:
            if self.rows[chunk_id].session_id == session:
                shape, at = self._shapes(chunk_id), self._at(chunk_id, local_id)
                out += [(int(a), int(f)) for a, f in zip(shape.areas_px[at], shape.frames[at], strict=True)]
        return out

    def _read_views(self, session: int, component: int) -> list[DepthView]:
        rows = [c for c in self.rows.values() if c.session_id == session and c.component == component]
        return [view for c in rows for view in chunk_views(c, self._store.keyframes.of(c.chunk_id), self.unit)]

    def _points_of(self, key: Key) -> Array:
        shape, at = self._shapes(key[0]), self._at(*key)
        start, stop = np.searchsorted(shape.owner, [at, at + 1])
        return np.asarray(self.rows[key[0]].S_world_chunk.apply(shape.points[start:stop]))

    def _colors_of(self, key: Key) -> Colors:
        shape, at = self._shapes(key[0]), self._at(*key)
        start, stop = np.searchsorted(shape.owner, [at, at + 1])
        return shape.rgb[start:stop]

    def _at(self, chunk_id: int, local_id: int) -> int:
        return int(np.searchsorted(self._shapes(chunk_id).local_id, local_id))


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
