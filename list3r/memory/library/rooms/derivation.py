"""The rooms of a memory: its storeys, the space of each, that space cut at doorways, and what is in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt

from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Doorway, Room
from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.rooms.outline import area_of, encloses, outline
from list3r.memory.library.rooms.partition import Labels, cut
from list3r.memory.library.rooms.space import LINTEL_M, Mask, Sight, Space, find_space
from list3r.memory.library.scene import Scene

_STOREY_M = 2.0
"""Floors of two storeys are at least as far apart as a room is high."""
_EYES_M = 1.5
"""Cameras are held so high where no floor was seen."""
_FLOOR_M2 = 1.0
"""A smaller floor is a landing or a mistake."""
_PIXELS = 600
"""Points of sight of each keyframe, about: a ray every 2 degrees."""
_WALL_CELLS = 2
"""Walls are so thick at most on the side of a room: so much of them is in its outline."""
_OPEN = 0.25
"""Share of a room's edge beyond which nothing was seen, from which it is partial."""
_SAME = 0.3
"""Rooms of two derivations are one where they share this of the smaller one's area."""
_AT_M = 0.6
"""What is so near a room and in none, such as what hangs in a niche of its wall, is in it."""


@dataclass(frozen=True)
class Rooms:
    """The rooms of a memory and the ways between them."""

    rooms: Sequence[Room] = ()
    doorways: Sequence[Doorway] = ()
    last_id: int = 0
    """The largest id that a room ever had."""


def find_rooms(scene: Scene, instances: Mapping[int, InstanceGeometry], known: Rooms) -> Rooms:
    """Return the rooms of the first component, with the ids of `known` rooms where they overlap most.

    `instances` by id, of which those with structure bound the rooms and the others are in them. There are none where
    nobody knows which way is up, or no keyframe has depth.
    """
    sights = _sights(scene) if scene.world.upright else []
    if not sights:
        return Rooms(last_id=known.last_id)
    unit = scene.world.unit
    here = {n: g for n, g in instances.items() if g.component == scene.world.first}
    floors = _floors(here, sights, unit)
    storey = [int(np.searchsorted(floors, s.camera[2], side="right")) - 1 for s in sights]
    rooms: list[Room] = []
    doorways: list[Doorway] = []
    for n, floor in enumerate(floors):
        some = [s for s, k in zip(sights, storey, strict=True) if max(k, 0) == n]
        if some:
            found = _of_storey(n, floor, some, here, unit)
            first = len(rooms)
            rooms += [replace(r, id=first + r.id) for r in found[0]]
            doorways += [replace(d, a=first + d.a, b=first + d.b) for d in found[1]]
    return _named_as_before(rooms, doorways, known)


def _sights(scene: Scene) -> list[Sight]:
    """Return what the keyframes of the first component saw."""
    out = []
    for k, row in scene.rows.items():
        if row.component != scene.world.first:
            continue
        for frame in scene.store.keyframes.of(k):
            depth = frame.depth_small
            if not depth.size or not (depth > 0).any():
                continue
            step = max(1, round(float(np.sqrt(depth.size / _PIXELS))))
            v, u = np.nonzero(depth[step // 2 :: step, step // 2 :: step] > 0)
            v, u = v * step + step // 2, u * step + step // 2
            fx, fy, cx, cy = frame.camera_small
            z = depth[v, u].astype(np.float64)
            rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(z))], axis=1)
            in_chunk = (rays * z[:, None]) @ frame.T_chunk_cam[:3, :3].T + frame.T_chunk_cam[:3, 3]
            camera = scene.pose(k).apply(frame.T_chunk_cam[None, :3, 3])[0]
            out.append(Sight(camera, scene.pose(k).apply(in_chunk)))
    return out


def _floors(instances: Mapping[int, InstanceGeometry], sights: Sequence[Sight], unit: float) -> list[float]:
    """Return the heights of the floors of storeys, from the lowest; at least one."""
    heights: list[tuple[float, float]] = []
    for g in instances.values():
        area = float(np.prod(np.sort(g.box.size)[1:])) / unit**2
        if g.structure == "floor" and area >= _FLOOR_M2:
            heights.append((float(np.median(g.points[:, 2])), area))
    storeys: list[list[tuple[float, float]]] = []
    for height in sorted(heights):
        if storeys and height[0] - storeys[-1][-1][0] < _STOREY_M * unit:
            storeys[-1].append(height)
        else:
            storeys.append([height])
    if not storeys:
        return [float(np.median([s.camera[2] for s in sights])) - _EYES_M * unit]
    return [float(np.average([z for z, _ in some], weights=[a for _, a in some])) for some in storeys]


def _of_storey(
    number: int, floor: float, sights: Sequence[Sight], instances: Mapping[int, InstanceGeometry], unit: float
) -> tuple[list[Room], list[Doorway]]:
    """Return the rooms of one storey, ids from 1 by size, and the doorways between them."""
    inside = {
        n: g
        for n, g in instances.items()
        if g.structure is None and floor - 0.5 * unit < g.box.center[2] < floor + (LINTEL_M + 1.0) * unit
    }
    cloud = [g.points for g in inside.values()]
    space = find_space(sights, floor, unit, np.concatenate(cloud) if cloud else np.zeros((0, 3)))
    labels, passages = cut(space, unit)
    if not labels.any():
        return [], []
    whole = _with_walls(labels, space)
    ids, grid = list(inside), space.grid
    home = dict(zip(ids, _rooms_at(labels, space, [inside[n] for n in ids], unit), strict=True))
    rooms = []
    for n in range(1, int(labels.max()) + 1):
        corners = outline(whole == n, grid)
        stood = any(labels[tuple(c)] == n for c in grid.cells(np.array([s.camera for s in sights])))
        rooms.append(
            Room(
                id=n,
                floor=number,
                floor_z=floor,
                outline=corners,
                area=area_of(corners),
                partial=_partial(labels == n, whole > 0, space, stood=stood),
                instances=tuple(sorted(k for k, room in home.items() if room == n)),
            )
        )
    at = [np.append(grid.xy(np.array([p.row + 0.5, p.column + 0.5])), floor) for p in passages]
    return rooms, [Doorway(p.a, p.b, xyz, p.width) for p, xyz in zip(passages, at, strict=True)]


def _with_walls(labels: Labels, space: Space) -> Labels:
    """Return the rooms with their side of the walls around them."""
    near, at = distance_transform_edt(labels == 0, return_indices=True)
    grown = labels[tuple(at)]
    keep = (labels > 0) | ((near <= _WALL_CELLS) & ~space.free)
    return np.where(keep, grown, 0).astype(np.int32)


def _rooms_at(labels: Labels, space: Space, instances: Sequence[InstanceGeometry], unit: float) -> list[int]:
    """Return the room in which most of each instance is seen from above, 0 where none is near."""
    near, at = distance_transform_edt(labels == 0, return_indices=True)
    out = []
    for g in instances:
        rows, columns = space.grid.cells(g.points).T
        close = near[rows, columns] * space.grid.cell <= _AT_M * unit
        row, column = at[:, rows[close], columns[close]]
        counts = np.bincount(labels[row, column], minlength=2)
        out.append(int(np.argmax(counts)) if close.any() else 0)
    return out


def _partial(room: Mask, rooms: Mask, space: Space, *, stood: bool) -> str:
    """Return why a room may end elsewhere than it seems to."""
    if not stood:
        return "seen from other rooms only"
    edge = binary_dilation(room) & ~room
    known = binary_dilation(space.seen | space.wall, iterations=_WALL_CELLS) | (
        rooms & ~binary_dilation(room, iterations=_WALL_CELLS)
    )
    open_share = float((edge & ~known).sum()) / max(int(edge.sum()), 1)
    return f"{open_share:.0%} of its edge was not seen" if open_share >= _OPEN else ""


def _named_as_before(rooms: Sequence[Room], doorways: Sequence[Doorway], known: Rooms) -> Rooms:
    """Give rooms the ids of the known ones that they overlap most, one to one, and new ids to the others."""
    shared = sorted((-s, old.id, room.id) for room in rooms for old in known.rooms if (s := _overlap(room, old)) > 0)
    ids: dict[int, int] = {}
    for _, old, new in shared:
        if new not in ids and old not in ids.values():
            ids[new] = old
    last = known.last_id
    for room in rooms:
        if room.id not in ids:
            last += 1
            ids[room.id] = last
    named = sorted((replace(r, id=ids[r.id]) for r in rooms), key=lambda r: r.id)
    moved = [replace(d, a=min(ids[d.a], ids[d.b]), b=max(ids[d.a], ids[d.b])) for d in doorways]
    return Rooms(named, sorted(moved, key=lambda d: (d.a, d.b, d.position.tobytes())), last)


def _overlap(a: Room, b: Room) -> float:
    """Return the area that two rooms of one height share; 0 where that is little of the smaller one."""
    if abs(a.floor_z - b.floor_z) > _STOREY_M / 2:
        return 0.0
    low, high = np.maximum(a.outline.min(0), b.outline.min(0)), np.minimum(a.outline.max(0), b.outline.max(0))
    if (high <= low).any():
        return 0.0
    steps = [np.linspace(lo, hi, 41)[:-1] + (hi - lo) / 80 for lo, hi in zip(low, high, strict=True)]
    places: Array = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    both = float((encloses(a.outline, places) & encloses(b.outline, places)).mean()) * float(np.prod(high - low))
    return both if both >= _SAME * min(a.area, b.area) else 0.0
