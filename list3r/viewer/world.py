"""The viewer's content of a memory: instances with their surface points, the camera's path, changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.api import SceneMemory
from list3r.exporters.components import point_spacing
from list3r.exporters.palette import instance_color, structure_color
from list3r.memory.core.records import BestView, Instance
from list3r.queries.changes import Changed
from list3r.queries.relations import unit_of
from list3r.queries.views.fused import Surface

CHANGE_COLORS = {"added": (40, 160, 80), "moved": (235, 140, 30), "removed": (210, 50, 60)}
COLOR_MODES = ("own colour", "instance", "changes")
UNCHANGED = (190, 190, 195)
_SELECTED = (255, 200, 0)
_POINTS_A_FACE = 4
"""Of triangles, which clicks meet."""
_RAY_RADIUS = 0.008
"""Radius of a ray as a share of the points' depth: about the size at which they are drawn."""


@dataclass(frozen=True)
class ShownCloud:
    """Points on the surfaces of many instances, concatenated; each in random order, so that any prefix is a coarser
    cloud. 18 bytes a point, so that tens of millions fit. Id 0 stands for what belongs to no instance.
    """

    points: NDArray[np.float32]
    """World. Shape (N, 3)."""
    rgb: NDArray[np.uint8]
    """Shape (N, 3)."""
    normals: NDArray[np.int8]
    """Where triangles look, which are not seen from behind, at a length of 127; 0 of points. Shape (N, 3)."""
    ids: NDArray[np.int64]
    """Ids of the instances. Shape (K,)."""
    counts: NDArray[np.int64]
    """How many of the points are each instance's. Shape (K,)."""
    spacing: NDArray[np.float64]
    """Distance of the points of each from each other, world units. Shape (K,)."""

    @property
    def owner(self) -> NDArray[np.int64]:
        """Id of the instance of each point. Shape (N,)."""
        return np.repeat(self.ids, self.counts)

    def part(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> ShownCloud:
        """Return the points `low` to `high` of each instance. Both shape (K,)."""
        counts = np.maximum(high - low, 0)
        first = np.cumsum(self.counts) - self.counts + low
        place = np.arange(counts.sum()) + np.repeat(first - (np.cumsum(counts) - counts), counts)
        wider = np.sqrt(self.counts / np.maximum(counts, 1))
        chosen = self.points[place], self.rgb[place], self.normals[place]
        return ShownCloud(*chosen, self.ids, counts, self.spacing * wider)

    def of(self, instance_id: int, most: int) -> ShownCloud:
        """Return the first points of one instance."""
        high = np.where(self.ids == instance_id, np.minimum(self.counts, most), 0)
        return self.part(np.zeros_like(high), high)


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

    def of(self, view: BestView | None) -> NDArray[np.float64] | None:
        """Return where the camera was in a frame, world, shape (3,); None where it is not known."""
        if view is None:
            return None
        here = np.flatnonzero((self.session == view.session_id) & (self.frame == view.frame_index))
        return self.position[here[0]] if len(here) else None


@dataclass(frozen=True)
class ShownWorld:
    """One state of the world: as it is, or as it was after a session."""

    instances: dict[int, Instance]
    cloud: ShownCloud
    sheets: dict[int, Surface]
    """Those surfaces that have triangles, which are drawn instead of their points."""
    changes: dict[int, Changed]
    """The newest change of each instance."""
    unit: float
    """About a metre in world units."""

    def solid(self, instance_id: int) -> bool:
        """Tell whether an id is a thing's: no structure, and not 0."""
        i = self.instances.get(instance_id)
        return i is not None and i.structure is None

    def name(self, instance_id: int) -> str:
        """Return the name of an instance."""
        i = self.instances[instance_id]
        return i.label or i.structure or i.description.split(",")[0] or "object"


def read_world(memory: SceneMemory, changes: list[Changed]) -> ShownWorld:
    """Return the present world of a memory; `changes` are those to colour."""
    shown = [i for i in memory.instances(structure=None) if i.state != "removed" and np.isfinite(i.aabb).all()]
    newest: dict[int, Changed] = {}
    for change in changes:
        newest.setdefault(change.instance.id, change)
    there, surfaces = {i.id: i for i in shown}, memory.surfaces()
    sheets = {n: s for n, s in surfaces.items() if len(s.faces)}
    return ShownWorld(there, _cloud(surfaces), sheets, newest, unit_of(memory.store))


def _cloud(surfaces: dict[int, Surface]) -> ShownCloud:
    parts = [(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.float32))]
    for n, surface in surfaces.items():
        order = np.random.default_rng(n).permutation(len(surface.vertices))
        bare = surface.vertices[order], surface.rgb[order], np.zeros((len(order), 3), np.float32)
        parts.append(surface.sampled(_POINTS_A_FACE * len(surface.faces)) if len(surface.faces) else bare)
    points, rgb, normals = (np.concatenate(each) for each in zip(*parts, strict=True))
    counts = np.array([len(p) for p, _, _ in parts[1:]], np.int64)
    spacing = np.array([point_spacing(p) if len(p) else 0.0 for p, _, _ in parts[1:]])
    return ShownCloud(
        points, rgb, np.round(127 * normals).astype(np.int8), np.array(list(surfaces), np.int64), counts, spacing
    )


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


def overview(counts: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return how many points of each instance to show from afar, at most about `most` in all: in proportion to the
    square root of their number, so that small instances keep theirs. Shape (K,).
    """
    if counts.sum() <= most:
        return counts
    low, high = 0.0, float(most)
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if np.minimum(counts, middle * np.sqrt(counts)).sum() <= most else (low, middle)
    return np.asarray(np.ceil(np.minimum(counts, low * np.sqrt(counts))).astype(np.int64))


def close_by(world: ShownWorld, hidden: NDArray[np.int64], place: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Return how many hidden points of each instance to add: nearest instances to a place first, at most `most` in all;
    `hidden` is how many each has. Shape (K,).
    """
    nowhere = np.full((2, 3), np.inf)
    there = [world.instances[n].aabb if n in world.instances else nowhere for n in world.cloud.ids.tolist()]
    boxes = np.array(there).reshape(-1, 2, 3)
    gap = np.linalg.norm(np.maximum(0.0, np.maximum(boxes[:, 0] - place, place - boxes[:, 1])), axis=1)
    order = np.argsort(gap, kind="stable")
    before = np.cumsum(hidden[order]) - hidden[order]
    chosen = np.zeros_like(hidden)
    chosen[order] = np.clip(most - before, 0, hidden[order])
    return chosen


def point_size(spacing: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    """Return how large to draw points so that they close a surface, in steps of a fifth. Any shape."""
    return np.asarray(1.2 ** np.round(np.log(np.clip(1.5 * spacing, 0.005 * unit, 0.05 * unit)) / np.log(1.2)))


# ---------------------------------------------------------------------------------------------- colours


def colors(world: ShownWorld, cloud: ShownCloud, mode: str, selected: int | None) -> NDArray[np.uint8]:
    """Return the colour of each point. Shape (N, 3)."""
    if mode == "own colour":
        out = cloud.rgb.copy()
    else:
        each = np.array([color_of(world, n, mode) for n in cloud.ids.tolist()], np.uint8).reshape(-1, 3)
        out = np.repeat(each, cloud.counts, axis=0)
        if mode == "changes":  # what is as it was keeps its light and shade, else no shape could be seen in it
            same = (out == UNCHANGED).all(axis=1)
            out[same] = (0.5 * cloud.rgb[same].mean(axis=1, keepdims=True) + 70).astype(np.uint8)
    if selected is not None:
        mine = cloud.owner == selected
        out[mine] = np.round(0.5 * out[mine] + 0.5 * np.array(_SELECTED)).astype(np.uint8)
    return out


def sheet_colors(world: ShownWorld, instance_id: int, mode: str) -> NDArray[np.uint8]:
    """Return the colours of the triangles' corners of an instance. Shape (V, 3)."""
    s = world.sheets[instance_id]
    alone = np.array([instance_id]), np.array([len(s.rgb)]), np.zeros(1)
    return colors(world, ShownCloud(s.vertices, s.rgb, np.zeros(s.rgb.shape, np.int8), *alone), mode, None)


def color_of(world: ShownWorld, instance_id: int, mode: str) -> tuple[int, int, int]:
    """Return the colour of an instance's box and, unless points have their own, of its points."""
    if mode == "changes":
        change = world.changes.get(instance_id)
        return UNCHANGED if change is None else CHANGE_COLORS.get(change.event.kind, UNCHANGED)
    return (instance_color if world.solid(instance_id) else structure_color)(instance_id)


# ---------------------------------------------------------------------------------------------- picking


def pick(
    world: ShownWorld, shown: ShownCloud, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[int, NDArray[np.float64]] | None:
    """Return the instance and the point that a ray meets first: a surface point near the ray, else a box.

    Surfaces of instances have gaps, so structure is met only where no instance's box is before it. `direction` is a
    unit vector; None where the ray meets nothing.
    """
    step = shown.points - origin
    depth = step @ direction
    aside = np.sqrt(np.maximum((step**2).sum(axis=1) - depth**2, 0.0))
    near = np.flatnonzero((depth > 0) & (aside < _RAY_RADIUS * depth))
    near = near[shown.normals[near] @ direction <= 0]
    first = int(near[np.argmin(depth[near])]) if len(near) else -1
    owner = int(shown.ids[np.searchsorted(np.cumsum(shown.counts), first, side="right")]) if first >= 0 else -1
    if first >= 0 and world.solid(owner):
        return owner, shown.points[first].astype(np.float64)
    reach = float(depth[first]) if first >= 0 else np.inf
    objects = [i for i in world.instances.values() if i.structure is None or first < 0]
    hits = [(t, i.id) for i in objects if (t := _box_hit(i, origin, direction)) is not None and t < reach]
    if hits:
        t, n = min(hits)
        return n, origin + t * direction
    return None if first < 0 else (owner, shown.points[first].astype(np.float64))


def _box_hit(instance: Instance, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> float | None:
    """Where a ray enters the box of an instance, along it; None where it misses or starts inside."""
    box = instance.box
    local, along = (origin - box.center) @ box.rotation, direction @ box.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-box.size / 2 - local) / along, (box.size / 2 - local) / along
    enter, leave = float(np.nanmax(np.minimum(a, b))), float(np.nanmin(np.maximum(a, b)))
    return enter if 0.0 < enter <= leave else None
