"""Which way is up: the big planes of a memory and the way its cameras were held.

Where planes decide, up is estimated. Where they do not, it is assumed that the camera was held upright (`held`), and
the surfaces that agree with that make it more exact; where they speak against it, up is unknown.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array, Sim3, rotation_exp
from list3r.memory.core.records import UpEstimate
from list3r.memory.core.settings import stored_settings
from list3r.memory.library.overlap.planes import Planes, place_planes
from list3r.memory.library.overlap.summaries import cameras_of, chunk_summaries, sample_of, world_unit
from list3r.memory.library.world.held import HeldSettings, HeldUp, up_as_held
from list3r.memory.store.store import Store

_MOST_NUMBERS = 1 << 19
"""Of directions with planes or cameras at a time; 4 MiB."""
_LEAN_DEG = 15.0
"""In a world that leans by more, things on a table stand beside it."""


@dataclass(frozen=True)
class GravitySettings:
    """When the evidence is enough."""

    plane_area_m2: float = 0.05
    """Planes smaller than this have no vote."""
    level_deg: float = 12.0
    """A plane this near to level (or to upright) counts as a floor or table (or as a wall)."""
    max_camera_tilt_deg: float = 65.0
    """Between up and the cameras' mean up: a camera that looks down at a table is tilted by 30 to 60 degrees."""
    max_roll_deg: float = 20.0
    """Median roll of the cameras about their line of sight: people hold a camera level."""
    max_spread_deg: float = 6.0
    """RMS of the voting planes about the direction found."""
    min_level_area_m2: float = 0.15
    """Level surface that must have been seen."""
    floor_area_m2: float = 0.25
    """Smallest visible patch that can be the floor."""
    floor_below: float = 0.03
    """Share of all other support points that may lie under the floor."""
    floor_depth_m: float = 0.1
    """What lies this much under it is under the floor: depth noise at the far end of a room is as large."""
    floor_thickness_m: float = 0.08
    """Level surfaces up to this much above the lowest one are the floor too: chunks do not lie alike."""
    floor_low_cameras: float = 0.05
    """Share of the cameras that may come nearer to the floor than `floor_camera_height_m`."""
    floor_camera_height_m: float = 0.8
    """A level surface that the cameras come nearer to than this is a table, not the floor."""
    hysteresis_deg: float = 0.4
    """An estimate that differs by less from the one before is not worth moving the world for."""
    hysteresis_m: float = 0.02
    """The same for the height of the floor."""
    held: HeldSettings = field(default_factory=HeldSettings)
    most_assumed_deg: float = 10.0
    """Up is not assumed where it is known less surely (one deviation)."""
    computed_deg: float = 3.0
    """What surfaces of computed depth leave open at best; 0.5 to 4.8 degrees in clips of RedKitchen."""
    near_deviations: float = 2.5
    """Surfaces within so many deviations of up as held may correct it,"""
    near_deg: float = 35.0
    """and no further away than this."""
    rival_deg: float = 15.0
    """A direction further from the best one than this is another one:"""
    rival_share: float = 0.8
    """with so many of its votes, nobody knows which of the two;"""
    against: float = 1.5
    """with so many times its votes, and not near as held, surfaces speak against the cameras."""
    shown: float = 0.1
    """Share of the surfaces that must tell each of the two angles of up."""
    ceiling: float = 3.0
    """Where so many times more surface faces down than up, and"""
    ceiling_share: float = 0.03
    """this share of all does, the camera was held upside down: rooms show more floor and tables than ceiling."""
    held_deviations: float = 3.0
    """Planes of computed depth that are further than this from up as held speak against it."""


@dataclass(frozen=True)
class Gravity:
    """Up in the frame of the pose graph, and how sure."""

    status: str
    """known, estimated, assumed or unknown."""
    up: Array
    """Unit vector; the cameras' mean up where unknown. Shape (3,)."""
    floor_height: float | None
    """Of the floor along `up`, from the origin of the frame; None where no floor was seen."""
    reason: str
    """One sentence."""
    deviation_deg: float | None = None
    """Of up; None where it is known or unknown."""


def gravity_from_planes(
    planes: Planes,
    S_graph_cam: Sim3,
    unit: float = 1.0,
    settings: GravitySettings | None = None,
    *,
    by_planes: bool = True,
) -> Gravity:
    """Return up from planes and cameras; not `by_planes` only as the cameras were held.

    `S_graph_cam` holds the poses of the colour cameras, batched over F frames; `unit` is what a metre is in the
    graph's units (1 for a metric memory). Candidates are the normals of planes seen from above: floors and tables, not
    ceilings, for a wall seen by a camera that looks down and a ceiling seen by one that looks up are the same picture.
    A candidate wins by the area of the planes that are level or upright with respect to it, among those that the
    cameras allow: people hold a camera level, so its x axis is level too, and its up is never far from up. The winner
    is refined on the planes that agree with it by reweighted least squares, to which level planes give one direction
    and walls a plane of directions.
    """
    s = settings or GravitySettings()
    if len(S_graph_cam.rotation) == 0:
        return Gravity("unknown", np.array([0.0, 0.0, 1.0]), None, "no camera was placed")
    held = up_as_held(S_graph_cam, s.held)
    found = _by_planes(planes, S_graph_cam, unit, s) if by_planes else None
    doubt = held.doubt or _upside_down(planes.faces, held.up, s)
    if found is None and doubt is None:
        found = _as_held(held, planes, S_graph_cam, unit, s)
    if found is None or not len(planes.faces) or found.status == "unknown":
        return found or Gravity("unknown", held.up, None, doubt or "no level surface agrees with the cameras")
    apart = float(np.degrees(np.arccos(np.clip(found.up @ held.up, -1, 1))))
    if doubt is None and not held.rolled and apart > max(s.held_deviations * held.deviation_deg, s.near_deg):
        doubt = f"level surfaces lie {apart:.0f} degrees from how the camera was held"
    return found if doubt is None else Gravity("unknown", held.up, None, doubt)


def _by_planes(planes: Planes, S_graph_cam: Sim3, unit: float, s: GravitySettings) -> Gravity | None:
    """Return up where big planes that the cameras allow decide it."""
    mean_up = -S_graph_cam.rotation[:, :, 1].mean(axis=0)
    mean_up /= max(float(np.linalg.norm(mean_up)), 1e-12)
    big = planes.area >= s.plane_area_m2 * unit**2
    normals, areas = planes.normal[big], planes.area[big]
    candidates = normals[_camera_allows(normals, S_graph_cam, mean_up, s)]
    if len(candidates) == 0:
        return None
    votes = _votes(candidates, normals, np.sqrt(areas), s)
    up = _refine(candidates[int(np.argmax(votes))], *_surfaces(planes, unit, s), s)
    along = np.clip(np.abs(normals @ up), 0, 1)
    level, upright = along > np.cos(np.radians(s.level_deg)), along < np.sin(np.radians(s.level_deg))
    off = np.where(level, np.arccos(along), np.arcsin(along))
    agree = level | upright
    weight = np.sqrt(areas[agree])
    spread = float(np.degrees(np.sqrt((weight * off[agree] ** 2).sum() / weight.sum()))) if agree.any() else np.inf
    level_area = float(areas[level].sum())
    enough = level_area >= s.min_level_area_m2 * unit**2 and spread <= s.max_spread_deg
    if not enough or not _camera_allows(up[None], S_graph_cam, mean_up, s)[0]:
        return None
    floor = floor_height(up, planes, S_graph_cam.translation, unit, s)
    reason = f"{int(level.sum())} level and {int(upright.sum())} upright planes agree within {spread:.1f} degrees"
    deviation = max(spread, s.computed_deg) if len(planes.faces) else spread
    return Gravity("estimated", up, floor, reason, deviation)


def _surfaces(planes: Planes, unit: float, s: GravitySettings) -> tuple[Array, Array]:
    """Return normals (K, 3) of big planes and of the sampled surfaces, and their weights (K,): both count alike."""
    big = planes.area >= s.plane_area_m2 * unit**2
    areas = np.sqrt(planes.area[big])
    share = areas / max(float(areas.sum()), 1e-12)
    faces = np.full(len(planes.faces), 1.0 / max(1, len(planes.faces)))
    return np.concatenate([planes.normal[big], planes.faces]), np.concatenate([share, faces])


def _upside_down(faces: Array | NDArray[np.float32], up: Array, s: GravitySettings) -> str | None:
    """Return a doubt where what is level faces down in the main."""
    along, most = faces @ up, np.cos(np.radians(s.level_deg))
    above, below = int((along > most).sum()), int((along < -most).sum())
    if below > s.ceiling * above and below > s.ceiling_share * len(faces):
        return "most level surfaces face down, as where a camera is held upside down"
    return None


def _as_held(held: HeldUp, planes: Planes, S_graph_cam: Sim3, unit: float, s: GravitySettings) -> Gravity:
    """Return up as the camera was held, corrected by the surfaces that agree with it."""
    if held.rolled:
        return Gravity("unknown", held.up, None, "the camera was not held level and no level surface tells more")
    normals, weights = _surfaces(planes, unit, s)
    up, deviation, how = held.up, held.deviation_deg, "the camera was held upright"
    if len(normals):
        within = normals @ up > np.cos(np.radians(min(s.near_deviations * deviation, s.near_deg)))
        near = np.concatenate([up[None], normals[within][:: max(1, int(within.sum()) // 300)]])
        lean = np.degrees(np.arccos(np.clip(near @ up, -1, 1))) / deviation
        votes = _votes(near, normals, weights, s) * np.exp(-0.5 * (lean / s.near_deviations) ** 2)
        best = int(np.argmax(votes))
        others = normals[:: max(1, len(normals) // 600)]
        apart = np.degrees(np.arccos(np.clip(np.abs(others @ near[best]), 0, 1)))
        tilted = others[(apart > s.rival_deg) & (apart < 90.0 - s.rival_deg)]
        against = float(_votes(tilted, normals, weights, s).max()) if len(tilted) else 0.0
        if against > s.against * votes[best]:
            return Gravity("unknown", up, None, "level surfaces lie otherwise than the camera was held")
        rivals = votes[near @ near[best] < np.cos(np.radians(s.rival_deg))]
        found = _refine(near[best], normals, weights, s)
        if not (rivals > s.rival_share * votes[best]).any() and _shown(found, normals, weights, s):
            up, deviation, how = found, s.computed_deg, f"{how} and surfaces agree"
    if deviation > s.most_assumed_deg:
        reason = f"how the camera was held tells up to {deviation:.0f} degrees only; turn to more sides while filming"
        return Gravity("unknown", up, None, reason)
    return Gravity("assumed", up, floor_height(up, planes, S_graph_cam.translation, unit, s), how, deviation)


def _shown(up: Array, normals: Array, weights: Array, s: GravitySettings) -> bool:
    """Return whether enough surface tells both angles of up: what is level does, a wall one of them."""
    along = np.abs(normals @ up)
    level = weights * (along > np.cos(np.radians(s.level_deg)))
    upright = weights * (along < np.sin(np.radians(s.level_deg)))
    sides = np.linalg.svd(up[None])[2][1:]
    walls = sides @ ((normals * upright[:, None]).T @ normals) @ sides.T
    told = (float(level.sum()) * np.eye(2) + walls) / max(float(weights.sum()), 1e-12)
    return bool(np.linalg.eigvalsh(told)[0] >= s.shown)


def _camera_allows(up: Array, S_graph_cam: Sim3, mean_up: Array, s: GravitySettings) -> Array:
    """Return which directions the cameras' tilt and roll allow. Shape (C, 3) -> (C,)."""
    level_axis = S_graph_cam.rotation[:, :, 0]
    across = [np.median(np.abs(some @ level_axis.T), axis=1) for some in _blocks(up, len(level_axis))]
    roll = np.degrees(np.arcsin(np.clip(np.concatenate(across), 0, 1)))
    tilt = np.degrees(np.arccos(np.clip(up @ mean_up, -1, 1)))
    return np.asarray((roll <= s.max_roll_deg) & (tilt <= s.max_camera_tilt_deg))


def _votes(candidates: Array, normals: Array, weights: Array, s: GravitySettings) -> Array:
    """Return the weight of what is level with respect to each candidate, plus half of what is upright. Shape (C,)."""
    votes, width = [], np.radians(s.level_deg) / 2
    for some in _blocks(candidates, len(normals)):
        off = np.arccos(np.clip(np.abs(some @ normals.T), 0, 1))
        level, upright = (np.exp(-0.5 * (angle / width) ** 2) for angle in (off, np.pi / 2 - off))
        votes.append((level + 0.5 * upright) @ weights)
    return np.concatenate(votes)


def _blocks(directions: Array, against: int) -> Iterator[Array]:
    """Yield directions (C, 3) in parts, so that each of a part with all of those `against` are no more numbers than
    memory has room for, however long the recording is.
    """
    step = max(1, _MOST_NUMBERS // max(1, against))
    for start in range(0, max(1, len(directions)), step):
        yield directions[start : start + step]


def _refine(up: Array, normals: Array, weights: Array, s: GravitySettings) -> Array:
    """Return the direction that level planes point along and upright planes are perpendicular to, reweighted
    (Cauchy).
    """
    limit = np.radians(s.level_deg)
    for _ in range(12):
        along = np.clip(np.abs(normals @ up), 0, 1)
        off_level, off_upright = np.arccos(along), np.arcsin(along)
        width = np.radians(2.0)
        level = np.where(off_level < limit, 1.0 / (1.0 + (off_level / width) ** 2), 0.0) * weights
        upright = np.where(off_upright < limit, 1.0 / (1.0 + (off_upright / width) ** 2), 0.0) * weights
        scatter = (normals * (level - upright)[:, None]).T @ normals
        values, vectors = np.linalg.eigh(scatter)
        found = vectors[:, int(np.argmax(values))]
        up = found if found @ up >= 0 else -found
    return np.asarray(up)


def floor_height(
    up: Array, planes: Planes, camera_centers: Array, unit: float = 1.0, settings: GravitySettings | None = None
) -> float | None:
    """Return the height along `up` of the lowest level surface that faces up and has (nearly) everything above it.

    None where no floor was seen. `camera_centers` has shape (F, 3), in the frame of the planes.
    """
    s = settings or GravitySettings()
    facing = planes.normal @ up > np.cos(np.radians(s.level_deg))
    floor = facing & (planes.area >= s.floor_area_m2 * unit**2)
    if not floor.any() or len(planes.points) == 0:
        return None
    heights = planes.center[floor] @ up
    lowest = heights < heights.min() + s.floor_thickness_m * unit
    height = float(np.average(heights[lowest], weights=planes.area[floor][lowest]))
    others = ~np.isin(planes.owner, np.flatnonzero(floor)[lowest])
    below = float((planes.points[others] @ up < height - s.floor_depth_m * unit).mean()) if others.any() else 0.0
    camera = float(np.quantile(camera_centers @ up, s.floor_low_cameras)) - height
    if below > s.floor_below or camera < s.floor_camera_height_m * unit:
        return None
    return height


def estimate_gravity(
    store: Store,
    S_graph_chunk: Mapping[int, Sim3] | None = None,
    components: Mapping[int, int] | None = None,
    settings: GravitySettings | None = None,
    *,
    stated_up: Array | None = None,
    rule: str = "planes",
    component: int | None = None,
) -> Gravity:
    """Return up in the frame in which chunks lie by `S_graph_chunk` (the default: as they are placed), from the chunks
    of the first component (see `ChunkRow.component`) or of another `component`, or 64 of them in a long memory.

    Call it inside a transaction; `world_from_graph` then gives what stands the chunks upright. An estimate that still
    agrees with the one before within `hysteresis_deg` gives way to that one, so that the world does not tremble with
    every chunk. Where up is stated (3,), planes only tell the floor. Else `rule` is planes (as the camera was held
    where they do not decide), camera (as it was held), or unknown.
    """
    s = settings or stored_settings(store, GravitySettings, "library", "gravity")
    chunks = store.chunks.all()
    if S_graph_chunk is None or components is None:
        S_graph_chunk = {c.chunk_id: c.S_world_chunk for c in chunks}
        components = {c.chunk_id: c.component for c in chunks}
    if not chunks:
        return Gravity("unknown", np.array([0.0, 0.0, 1.0]), None, "the memory is empty")
    first = min(components[k] for k in S_graph_chunk)
    component = first if component is None else component
    summaries = chunk_summaries(store)
    rows = sample_of([c for c in chunks if components[c.chunk_id] == component])
    inside = [replace(c, component=component, S_world_chunk=S_graph_chunk[c.chunk_id]) for c in rows]
    planes = place_planes([(summaries.planes(c.chunk_id), c.S_world_chunk) for c in inside])
    unit = world_unit(inside, summaries)
    if summaries.metre is not None:
        unit *= float(inside[0].S_world_chunk.scale) / float(rows[0].S_world_chunk.scale)
    cameras = cameras_of(store, inside)
    if stated_up is not None:
        found = _stated(stated_up, planes, cameras, unit, s)
    elif rule == "unknown":
        return Gravity("unknown", np.array([0.0, 0.0, 1.0]), None, "it was asked to be left unknown")
    else:
        found = gravity_from_planes(planes, cameras, unit, s, by_planes=rule != "camera")
    if component != first:
        return found
    settled = _with_hysteresis(found, store.facts.gravity_estimate, unit, s)
    if settled is found and found.status != "unknown":
        store.facts.gravity_estimate = UpEstimate(found.up, found.floor_height)
    return settled


def _stated(up: Array, planes: Planes, S_graph_cam: Sim3, unit: float, s: GravitySettings) -> Gravity:
    """Return up as a recorder or the user states it, with the floor that planes show."""
    known = len(planes.normal) > 0 and len(S_graph_cam.rotation) > 0
    floor = floor_height(up, planes, S_graph_cam.translation, unit, s) if known else None
    return Gravity("known", up, floor, "the recorder of the source, or the user, said so")


def _with_hysteresis(found: Gravity, before: UpEstimate | None, unit: float, s: GravitySettings) -> Gravity:
    """Return the estimate before where it holds still, else the one found now."""
    if found.status == "unknown" or before is None:
        return found
    now, then, up = found.floor_height, before.floor_height, before.up
    if (then is None) != (now is None):
        return found
    turned = float(np.degrees(np.arccos(np.clip(up @ found.up, -1.0, 1.0))))
    risen = 0.0 if now is None or then is None else abs(now - then)
    if turned > s.hysteresis_deg or risen > s.hysteresis_m * unit:
        return found
    return replace(found, up=up, floor_height=before.floor_height)


def gravity_of(store: Store, component: int) -> str:
    """Return what is known of up in a part of the memory: where it is unknown the part lies anyhow."""
    first = min((c.component for c in store.chunks.all()), default=component)
    if component == first:
        return store.facts.gravity
    return "estimated" if component in store.facts.upright_parts else "unknown"


def sure_of_up(store: Store) -> float:
    """Return how sure what needs up can be at most: the chance that a world whose up is assumed leans by less than what
    tells on from beside; 1 where up is known or surfaces show it."""
    deviation = store.facts.gravity_deviation_deg
    if store.facts.gravity != "assumed" or deviation is None:
        return 1.0
    return 1.0 - float(np.exp(-0.5 * (_LEAN_DEG / deviation) ** 2))


def world_from_graph(gravity: Gravity) -> Sim3:
    """T_world_graph: the smallest rotation that turns up to z, with the floor at z = 0 where it was seen.

    The identity where gravity is unknown, so that a memory without it lives in the frame of its first camera.
    """
    if gravity.status == "unknown":
        return Sim3.identity()
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(gravity.up, z)
    sine, cosine = float(np.linalg.norm(axis)), float(gravity.up @ z)
    if sine < 1e-12:
        axis = np.array([1.0, 0.0, 0.0]) if cosine < 0 else z
    rotation = rotation_exp(axis / np.linalg.norm(axis) * np.arctan2(sine, cosine))
    height = 0.0 if gravity.floor_height is None else gravity.floor_height
    return Sim3(np.ones(()), rotation, np.array([0.0, 0.0, -height]))
