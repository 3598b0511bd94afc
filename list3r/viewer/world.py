"""What the viewer shows of a memory: instances with their surface points, the camera's path, what changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.api import SceneMemory
from list3r.exporters.palette import instance_color, structure_color
from list3r.memory.records import Instance
from list3r.queries.changes import Changed

CHANGE_COLORS = {"added": (40, 160, 80), "moved": (235, 140, 30), "removed": (210, 50, 60)}
COLOR_MODES = ("own colour", "instance", "changes")
_UNCHANGED = (190, 190, 195)
_SELECTED = (255, 200, 0)
_BESIDE = 0.008
"""A ray meets points no further beside it than this share of their depth: about the size at which they are drawn."""


@dataclass(frozen=True)
class ShownCloud:
    """Surface points of many instances, of each in random order, so that any first part of them is a coarser cloud."""

    points: NDArray[np.float32]
    """World. Shape (N, 3)."""
    rgb: NDArray[np.uint8]
    """Shape (N, 3)."""
    owner: NDArray[np.int64]
    """Id of the instance of each point. Shape (N,)."""
    rank: NDArray[np.int64]
    """Number of each point among those of its instance. Shape (N,)."""

    def part(self, keep: NDArray[np.bool_]) -> ShownCloud:
        """Return some of the points."""
        return ShownCloud(self.points[keep], self.rgb[keep], self.owner[keep], self.rank[keep])


@dataclass(frozen=True)
class CameraPath:
    """The posed frames in order."""

    session: NDArray[np.int64]
    """Shape (F,)."""
    frame: NDArray[np.int64]
    """Frame.index. Shape (F,)."""
    time_s: NDArray[np.float64]
    """Shape (F,)."""
    position: NDArray[np.float64]
    """World. Shape (F, 3)."""
    rotation: NDArray[np.float64]
    """R_world_cam. Shape (F, 3, 3)."""


@dataclass(frozen=True)
class ShownWorld:
    """One state of the world: as it is, or as it was after a session."""

    instances: dict[int, Instance]
    cloud: ShownCloud
    changes: dict[int, Changed]
    """The newest change of each instance."""

    def name(self, instance_id: int) -> str:
        """Return what an instance is called."""
        i = self.instances[instance_id]
        return i.label or i.structure or i.description.split(",")[0] or "thing"


def read_world(memory: SceneMemory, changes: list[Changed]) -> ShownWorld:
    """Return the present world of a memory; `changes` are those to colour."""
    shown = [i for i in memory.instances(structure=None) if i.state != "removed" and np.isfinite(i.aabb).all()]
    parts = [_points(memory, i) for i in shown]
    cloud = ShownCloud(
        np.concatenate([np.zeros((0, 3), np.float32), *(p.points for p in parts)]),
        np.concatenate([np.zeros((0, 3), np.uint8), *(p.rgb for p in parts)]),
        np.concatenate([np.zeros(0, np.int64), *(p.owner for p in parts)]),
        np.concatenate([np.zeros(0, np.int64), *(p.rank for p in parts)]),
    )
    newest: dict[int, Changed] = {}
    for change in changes:
        newest.setdefault(change.instance.id, change)
    return ShownWorld({i.id: i for i in shown}, cloud, newest)


def _points(memory: SceneMemory, instance: Instance) -> ShownCloud:
    support = memory.support(instance.id)
    finite = np.flatnonzero(np.isfinite(support.points).all(axis=1))
    order = np.random.default_rng(instance.id).permutation(finite)
    owner = np.full(len(order), instance.id, np.int64)
    return ShownCloud(support.points[order].astype(np.float32), support.rgb[order], owner, np.arange(len(order)))


def read_path(memory: SceneMemory) -> CameraPath:
    """Return the camera's path through all sessions."""
    poses = memory.camera_poses()
    return CameraPath(
        np.array([f.session_id for f, _ in poses], np.int64),
        np.array([f.frame_index for f, _ in poses], np.int64),
        np.array([f.time_s for f, _ in poses], np.float64),
        np.array([S.translation for _, S in poses], np.float64).reshape(-1, 3),
        np.array([S.rotation for _, S in poses], np.float64).reshape(-1, 3, 3),
    )


# ---------------------------------------------------------------------------------------------- level of detail


def overview(cloud: ShownCloud, most: int) -> NDArray[np.bool_]:
    """Return which points to show from afar, at most about `most`: of each instance as many as the square root of
    what it has allows, so that small things keep theirs. Shape (N,).
    """
    if len(cloud.points) <= most:
        return np.ones(len(cloud.points), bool)
    _, place, counts = np.unique(cloud.owner, return_inverse=True, return_counts=True)
    low, high = 0.0, float(most)
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if np.minimum(counts, middle * np.sqrt(counts)).sum() <= most else (low, middle)
    return np.asarray(cloud.rank < np.minimum(counts, low * np.sqrt(counts))[place])


def close_by(world: ShownWorld, hidden: NDArray[np.bool_], place: NDArray[np.float64], most: int) -> NDArray[np.bool_]:
    """Return which hidden points to show besides: those of the instances nearest to a place, at most `most`."""
    boxes = {n: i.aabb for n, i in world.instances.items()}
    gap = {n: float(np.linalg.norm(np.maximum(0.0, np.maximum(b[0] - place, place - b[1])))) for n, b in boxes.items()}
    wanted, count = [], 0
    sizes = dict(zip(*(x.tolist() for x in np.unique(world.cloud.owner[hidden], return_counts=True)), strict=True))
    for n in sorted(sizes, key=lambda n: gap.get(n, np.inf)):
        if count + sizes[n] > most:
            break
        wanted.append(n)
        count += sizes[n]
    return np.asarray(hidden & np.isin(world.cloud.owner, wanted))


# ---------------------------------------------------------------------------------------------- colours


def colors(world: ShownWorld, cloud: ShownCloud, mode: str, selected: int | None) -> NDArray[np.uint8]:
    """Return the colour of each point. Shape (N, 3)."""
    out = cloud.rgb.copy() if mode == "own colour" else _by_owner(cloud.owner, lambda n: color_of(world, n, mode))
    if selected is not None:
        mine = cloud.owner == selected
        out[mine] = np.round(0.5 * out[mine] + 0.5 * np.array(_SELECTED)).astype(np.uint8)
    return out


def color_of(world: ShownWorld, instance_id: int, mode: str) -> tuple[int, int, int]:
    """Return the colour of an instance's box and, unless points have their own, of its points."""
    if mode == "changes":
        change = world.changes.get(instance_id)
        return _UNCHANGED if change is None else CHANGE_COLORS.get(change.event.kind, _UNCHANGED)
    structure = world.instances[instance_id].structure is not None
    return structure_color(instance_id) if structure else instance_color(instance_id)


def _by_owner(owner: NDArray[np.int64], color: Callable[[int], tuple[int, int, int]]) -> NDArray[np.uint8]:
    ids, place = np.unique(owner, return_inverse=True)
    return np.array([color(int(n)) for n in ids], np.uint8).reshape(-1, 3)[place]


# ---------------------------------------------------------------------------------------------- picking


def pick(
    world: ShownWorld, shown: ShownCloud, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[int, NDArray[np.float64]] | None:
    """Return the instance and the point that a ray meets first: a surface point near the ray, else a box.

    Surfaces of things have gaps, so structure is met only where no thing's box lies before it. `direction` is a unit
    vector; None where the ray meets nothing.
    """
    step = shown.points - origin
    depth = step @ direction
    aside = np.sqrt(np.maximum((step**2).sum(axis=1) - depth**2, 0.0))
    near = np.flatnonzero((depth > 0) & (aside < _BESIDE * depth))
    first = int(near[np.argmin(depth[near])]) if len(near) else -1
    if first >= 0 and world.instances[int(shown.owner[first])].structure is None:
        return int(shown.owner[first]), shown.points[first].astype(np.float64)
    reach = float(depth[first]) if first >= 0 else np.inf
    things = [i for i in world.instances.values() if i.structure is None or first < 0]
    hits = [(t, i.id) for i in things if (t := _box_hit(i, origin, direction)) is not None and t < reach]
    if hits:
        t, n = min(hits)
        return n, origin + t * direction
    return None if first < 0 else (int(shown.owner[first]), shown.points[first].astype(np.float64))


def _box_hit(instance: Instance, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> float | None:
    """Where a ray enters the box of an instance, along it; None where it misses or starts inside."""
    box = instance.box
    local, along = (origin - box.center) @ box.rotation, direction @ box.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-box.size / 2 - local) / along, (box.size / 2 - local) / along
    enter, leave = float(np.nanmax(np.minimum(a, b))), float(np.nanmin(np.maximum(a, b)))
    return enter if 0.0 < enter <= leave else None
