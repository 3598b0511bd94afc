"""Clutter on boards, tops, seats and beds: each thing comes to rest on what lies below it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from training.worlds.catalogue import ODD, Kind, kinds_at
from training.worlds.draft import Draft, Zone, pose_of
from training.worlds.materials import Palette
from training.worlds.mesh import turn
from training.worlds.room import Room

CELL_M = 0.01
STANDING = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""Turns a lying book so that it stands with its spine to the front."""
STACKS = ("book", "paper", "box", "cloth", "cushion", "plate", "tray")
"""Families that may lie on other things."""


@dataclass
class Bed:
    """The heights of what lies in a zone so far."""

    zone: Zone
    height: NDArray[np.float64]
    """Above the zone's surface, metres (rows along y)."""


Profile = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def profile(draft: Draft, rotation: NDArray[np.float64]) -> Profile:
    """Return lower and upper heights of a turned thing over a grid, NaN where it is not, and the grid's low corner."""
    points = draft.mesh()
    vertices = points.vertices @ rotation.T
    low = vertices.min(axis=0)
    tri = vertices[points.triangles] - low
    shape = tuple(int(np.ceil(s / CELL_M)) + 1 for s in tri.max(axis=(0, 1))[[1, 0]])
    bottom, top = np.full(shape, np.inf), np.full(shape, -np.inf)
    edge = np.linalg.norm(tri - np.roll(tri, 1, axis=1), axis=2).max(axis=1)
    for steps in (1, 2, 4, 8, 16, 32, 64):
        mine = tri[(edge <= steps * CELL_M) & (edge > (steps / 2 if steps > 1 else 0) * CELL_M)]
        i, j = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1))
        u, v = (a[i + j <= steps] / steps for a in (i, j))
        p = mine[:, None, 0] * (1 - u - v)[:, None] + mine[:, None, 1] * u[:, None] + mine[:, None, 2] * v[:, None]
        p = p.reshape(-1, 3)
        row, column = (p[:, 1] / CELL_M).astype(int), (p[:, 0] / CELL_M).astype(int)
        np.minimum.at(bottom, (row, column), p[:, 2])
        np.maximum.at(top, (row, column), p[:, 2])
    return np.where(np.isfinite(bottom), bottom, np.nan), np.where(np.isfinite(top), top, np.nan), low


def drop(
    bed: Bed, shape: Profile, rotation: NDArray[np.float64], at: tuple[float, float], *, stacks: bool
) -> NDArray[np.float64] | None:
    """Return the pose in the thing of the zone at which a thing comes to rest with its low corner `at`, or None.

    `shape` is its profile, turned by `rotation`.

    It may rest on others only where `stacks`, with its middle over what carries it.
    """
    bottom, top, low = shape
    rows, columns = bottom.shape
    r0, c0 = int((at[1] - bed.zone.low[1]) / CELL_M), int((at[0] - bed.zone.low[0]) / CELL_M)
    if r0 < 0 or c0 < 0 or r0 + rows > bed.height.shape[0] or c0 + columns > bed.height.shape[1]:
        return None
    under = bed.height[r0 : r0 + rows, c0 : c0 + columns]
    gap = under - bottom
    z = float(np.nanmax(gap))
    contact = np.argwhere(gap > z - 0.006)
    middle = np.array([rows, columns]) / 2
    if z > 0.003 and not (
        stacks
        and (contact.min(axis=0) <= middle).all()
        and (contact.max(axis=0) >= middle - 1).all()
        and len(contact) > 8
    ):
        return None
    if z + float(np.nanmax(top)) > bed.zone.clearance:
        return None
    bed.height[r0 : r0 + rows, c0 : c0 + columns] = np.fmax(under, top + z)
    offset = np.array([bed.zone.low[0] + c0 * CELL_M, bed.zone.low[1] + r0 * CELL_M, bed.zone.z + z]) - low
    return pose_of((float(offset[0]), float(offset[1]), float(offset[2]) + 0.001), rotation)


def new_bed(zone: Zone) -> Bed:
    """Return an empty zone."""
    shape = tuple(max(1, int((zone.high[k] - zone.low[k]) / CELL_M)) for k in (1, 0))
    return Bed(zone, np.zeros(shape))


def fill_zone(
    room: Room,
    palette: Palette,
    zone: Zone,
    pose: NDArray[np.float64],
    *,
    density: float,
    held_out: bool,
    odd: float = 0.0,
) -> None:
    """Put things into a zone of the thing at `pose` (4, 4).

    `density` is things a square metre; for `odd` see `make_world`.
    """
    bed, rng = new_bed(zone), room.rng
    area = (zone.high[0] - zone.low[0]) * (zone.high[1] - zone.low[1])
    if min(zone.high[0] - zone.low[0], zone.high[1] - zone.low[1]) < 0.08:
        return
    if zone.use == "shelf" and rng.random() < 0.4:
        _book_row(room, palette, bed, pose)
    places = {"shelf": "small", "top": "small", "bed": "seat", "shoes": "shoes", "desk": "desk", "media": "media"}
    place = places.get(zone.use, zone.use)
    kinds = kinds_at(place, held_out=held_out)
    if place in ("desk", "media"):
        kinds = kinds + kinds_at("small", held_out=held_out)[:: 2 if place == "desk" else 3]
    weight = np.array([k.weight for k in kinds])
    if odd and place in ODD and rng.random() < 0.7 * odd:
        _twins(room, palette, bed, pose, ODD[place] if rng.random() < odd else kinds[int(rng.integers(len(kinds)))])
    previous: tuple[Kind, dict[str, object]] | None = None
    for _ in range(int(rng.poisson(density * area))):
        twin = previous is not None and (rng.random() < 0.2 or place == "shoes")
        kind = previous[0] if twin and previous else kinds[int(rng.choice(len(kinds), p=weight / weight.sum()))]
        if odd and place in ODD and not twin and rng.random() < odd:
            kind = ODD[place]
        before = rng.bit_generator.state
        if twin and previous:
            rng.bit_generator.state = previous[1]
        draft = Draft(rng, palette)
        kind.build(draft)
        if twin:
            rng.bit_generator.state = before
        previous = (kind, before)
        _put(room, bed, kind, draft, pose)


def _put(room: Room, bed: Bed, kind: Kind, draft: Draft, pose: NDArray[np.float64]) -> None:
    rng, zone = room.rng, bed.zone
    facing = rng.normal(0, 0.25) if rng.random() < 0.6 else rng.uniform(0, 2 * np.pi)
    rotation = turn(facing)
    lying = kind.family in ("bottle", "toy", "can") and rng.random() < 0.12
    if lying:
        rotation = turn(facing) @ turn(roll=np.pi / 2)
    elif kind.family == "cushion" and zone.use == "seat":
        rotation = turn(facing) @ turn(roll=rng.uniform(-0.2, 0.4))
    low = (draft.mesh().vertices @ rotation.T).min(axis=0)
    high = (draft.mesh().vertices @ rotation.T).max(axis=0)
    room_x, room_y = zone.high[0] - zone.low[0] - (high - low)[0], zone.high[1] - zone.low[1] - (high - low)[1]
    if room_x < 0.02 or room_y < 0.02:
        return
    stacks, shape = kind.family in STACKS and rng.random() < 0.6, profile(draft, rotation)
    for _ in range(7):
        at = (zone.low[0] + rng.uniform(0, room_x - 0.015), zone.low[1] + rng.uniform(0, room_y - 0.015))
        local = drop(bed, shape, rotation, at, stacks=stacks)
        if local is not None:
            room.place(kind.name, kind.label, kind.family, draft, pose @ local, mark=False)
            return


def _twins(room: Room, palette: Palette, bed: Bed, pose: NDArray[np.float64], kind: Kind) -> None:
    """Set out several of one thing in rows, near each other."""
    rng, zone = room.rng, bed.zone
    draft = Draft(rng, palette)
    kind.build(draft)
    rotation = turn(float(rng.integers(4)) * np.pi / 2 + rng.normal(0, 0.05))
    vertices, shape = draft.mesh().vertices @ rotation.T, profile(draft, rotation)
    step = (vertices.max(axis=0) - vertices.min(axis=0))[:2] + rng.uniform(0.005, 0.06)
    start = np.array(zone.low) + rng.uniform(0, 0.5, 2) * (np.array(zone.high) - np.array(zone.low))
    for i in range(int(rng.integers(2, 6))):
        for j in range(int(rng.integers(1, 4))):
            x, y = start + step * (i, j) + rng.normal(0, 0.004, 2)
            local = drop(bed, shape, rotation, (float(x), float(y)), stacks=False)
            if local is not None:
                room.place(kind.name, kind.label, kind.family, draft, pose @ local, mark=False)


def _book_row(room: Room, palette: Palette, bed: Bed, pose: NDArray[np.float64]) -> None:
    """Stand some books side by side, touching; the last may lean."""
    from training.worlds.tabletop import book

    rng, zone = room.rng, bed.zone
    x = zone.low[0] + rng.uniform(0, 0.2) * (zone.high[0] - zone.low[0])
    count = int(rng.integers(3, 9))
    for k in range(count):
        draft = Draft(rng, palette)
        book(draft)
        rotation = STANDING
        if k == count - 1 and rng.random() < 0.5:
            rotation = turn(pitch=-rng.uniform(0.1, 0.35)) @ STANDING
        vertices = draft.mesh().vertices @ rotation.T
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        y = min(zone.high[1] - rng.uniform(0.0, 0.05), zone.high[1]) - (high - low)[1] - 0.012
        local = drop(bed, profile(draft, rotation), rotation, (x, y), stacks=False)
        if local is None:
            return
        room.place("book", "book", "book", draft, pose @ local, mark=False)
        x += (int((high - low)[0] / CELL_M) + 1) * CELL_M + 0.0005
