"""When an instance was seen, and what is visible from a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

from list3r.memory.core.errors import OptionError, check_share
from list3r.memory.core.records import BestView
from list3r.memory.store.store import Store
from list3r.queries.match import FilterOptions, Filters, Match, checked_instance, of_one_state
from list3r.queries.views.camera import PosedCamera
from list3r.queries.views.visibility import Visibility, in_front, look

LEAST_VISIBLE = 0.1
"""Share of an instance's outline that must be visible for a camera to see it, in [0, 1]."""
_WHOLE = 0.995
"""Share of an instance inside the picture from which all of it is."""


@dataclass(frozen=True)
class Sighting:
    """One frame in which an instance was followed."""

    session_id: int
    frame_index: int
    time_s: float
    box_xyxy: tuple[float, float, float, float]
    """px."""
    visible_fraction: float
    """Share of its surface inside the frame that nothing hid, in [0, 1]."""


@dataclass(frozen=True)
class Sightings:
    """All frames in which an instance was followed, in the order of session and frame."""

    instance_id: int
    frames: tuple[Sighting, ...]
    spans_s: tuple[tuple[int, float, float], ...]
    """(session, from, to) of the stretches without a break longer than `gap_s`."""


def seen(store: Store, instance_id: int, *, gap_s: float = 1.0) -> Sightings:
    """Return when and in which frames an instance was seen; of frames that two chunks share, the better view counts.

    Raises `UnknownIdError`, and `OptionError` for a gap that is none.
    """
    if not gap_s >= 0.0:
        raise OptionError(f"gap {gap_s} must be a number of seconds, 0 or more")
    instance = checked_instance(store, instance_id)
    sessions = {c.chunk_id: c.session_id for c in store.chunks.all()}
    best: dict[tuple[int, int], tuple[float, tuple[float, ...]]] = {}
    for o in store.observations.of(instance.id):
        track = store.local_instances.mask_track(o.chunk_id, o.local_id)
        views = zip(track.frames.tolist(), track.visible_fraction.tolist(), track.boxes_xyxy.tolist(), strict=True)
        for frame, visible, box in views:
            key = (sessions[o.chunk_id], frame)
            best[key] = max(best.get(key, (-1.0, ())), (visible, tuple(box)))
    times = {(f.session_id, f.frame_index): f.time_s for f in store.frames.all()}
    frames = []
    for key in sorted(k for k in best if k in times):
        visible, (x0, y0, x1, y1) = best[key]
        frames.append(Sighting(*key, times[key], (x0, y0, x1, y1), round(visible, 4)))
    return Sightings(instance.id, tuple(frames), _spans(frames, gap_s))


def _spans(frames: list[Sighting], gap_s: float) -> tuple[tuple[int, float, float], ...]:
    out: list[tuple[int, float, float]] = []
    for f in frames:
        if out and out[-1][0] == f.session_id and f.time_s - out[-1][2] <= gap_s:
            out[-1] = (f.session_id, min(out[-1][1], f.time_s), max(out[-1][2], f.time_s))  # clocks may step back
        else:
            out.append((f.session_id, f.time_s, f.time_s))
    return tuple(out)


@of_one_state
def visible(
    store: Store,
    camera: PosedCamera,
    *,
    min_visible: float = LEAST_VISIBLE,
    max_depth: float | None = None,
    occlusion: bool = True,
    **options: Unpack[FilterOptions],
) -> list[Match]:
    """Return what a camera sees: things of which at least `min_visible` of the outline in the picture is not hidden.

    The score is that share times the share of the thing that lies in the picture; the distance is from the camera to
    the nearest point that shows. For a camera of a frame the reason says whether the thing was followed in it. What
    hides is everything the memory holds, structure too, `max_depth` (world units) away at most; what moves is where it
    was last. Filters: see `Filters`. Raises `OptionError`.
    """
    check_share("min_visible", min_visible)
    if max_depth is not None and not 0.0 < max_depth < float("inf"):
        raise OptionError(f"max_depth {max_depth} must be a finite length above 0")
    filters = Filters.of(store, options)
    followed = _followed(store, camera)
    found = []
    for s in look(store, camera, in_front(store, camera, max_depth), max_depth=max_depth, occlusion=occlusion):
        if s.visible >= min_visible and filters.passes(s.instance):
            found.append(_match(s, camera, followed))
    return sorted(found, key=lambda m: (-m.score, m.distance_m or 0.0, m.instance.id))


def _match(s: Visibility, camera: PosedCamera, followed: set[int] | None) -> Match:
    reason = f"{s.visible:.0%} of its outline shows, {s.picture:.1%} of the picture"
    if s.inside < _WHOLE:
        reason += f", {s.inside:.0%} of it inside"
    if followed is not None:
        reason += ", followed in this frame" if s.instance.id in followed else ", not followed in this frame"
    view = None if camera.frame is None else BestView(camera.session_id, camera.frame.frame_index, s.box_xyxy)
    away = float(((s.instance.center - camera.place) ** 2).sum() ** 0.5)
    return Match(s.instance, round(s.visible * s.inside, 4), s.distance, away, reason, view)


def _followed(store: Store, camera: PosedCamera) -> set[int] | None:
    """Return instances whose masks are in the camera's frame, by the chunk that places it; None without a frame."""
    if camera.frame is None:
        return None
    out = set()
    for o in store.observations.all():
        if o.chunk_id == camera.frame.chunk_id:
            if camera.frame.frame_index in store.local_instances.mask_track(o.chunk_id, o.local_id).frames:
                out.add(o.instance_id)
    return out
