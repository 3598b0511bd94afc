"""What the frames of a session saw at a place: a surface there, free space through it, or nothing at all.

The keyframes' small depth images are asked. A pixel speaks only together with its neighbours, so that neither the edge
of an instance nor a small error of alignment looks like free space.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import ChunkRow, Keyframe
from list3r.memory.library.overlap.point_verdicts import FREE, MET

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class VisibilitySettings:
    """When depth is evidence for a surface, and when for free space."""

    tolerance_m: float = 0.025
    """How far a surface may lie from where it is stored: alignment of two sessions."""
    noise_per_m2: float = 0.0045
    """Three deviations of depth at one metre; grows with the square of depth (structured light, 3 x 1.5 mm)."""
    noise_share: float = 0.0
    """How far it may be off besides as a share of depth, where it is computed."""
    nearest_m: float = 0.3
    """Closer than this nothing is measured."""
    most_depth_m: float = 4.5
    """Beyond this depth is too coarse to tell."""
    least_points: int = 8
    """Points of an instance that a frame must tell about."""
    least_share: float = 0.4
    """Share of an instance's points that a frame must tell about."""
    gone: float = 0.55
    """Share of what is told that must be free space for an instance to be gone from there;"""
    there: float = 0.2
    """and up to which it is still there."""
    least_frames: int = 4
    """Frames that must agree."""


@dataclass(frozen=True)
class DepthView:
    """One keyframe in the world."""

    session_id: int
    frame_index: int
    S_cam_world: Sim3
    """World to the camera, chunk units."""
    unit: float
    """What a metre is in chunk units."""
    depth: NDArray[np.float32]
    """Chunk units, 0 where unknown. Shape (h, w)."""
    camera: tuple[float, float, float, float]
    """fx, fy, cx, cy of `depth`, px."""
    chunk_id: int = 0
    """Chunk of the keyframe, 0 where nobody asks for its picture."""

    def pixels(self, points: Array) -> tuple[Ints, Ints]:
        """Return the columns and rows of `depth` nearest to points before the camera, world coordinates, (N, 3)."""
        p, (fx, fy, cx, cy) = self.S_cam_world.apply(points), self.camera
        u, v = p[:, 0] / p[:, 2] * fx + cx, p[:, 1] / p[:, 2] * fy + cy
        return np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)


@dataclass(frozen=True)
class PlaceVisibility:
    """What frames tell about a place."""

    verdict: str
    """there, gone, unclear, unseen."""
    free: float
    """Share of what was told that is free space."""
    frames: tuple[tuple[int, int], ...]
    """(session id, Frame.index) of the frames that told, the most telling first."""
    by_color: bool = False
    """Gone, because what is measured there has other colours."""
    told: float = 0.0
    """Share of all of the surface that was there of which frames tell, see `Places.told`."""


def chunk_views(chunk: ChunkRow, keyframes: Iterable[Keyframe], unit: float) -> list[DepthView]:
    """Return the keyframes of a chunk that have depth, as it is placed; `unit` is a metre in world units."""
    out, in_chunk = [], unit / float(chunk.S_world_chunk.scale)
    for k in (k for k in keyframes if k.depth_small.size):
        S_cam_world = (chunk.S_world_chunk @ Sim3.from_matrix(k.T_chunk_cam)).inverse()
        view = DepthView(chunk.session_id, k.frame_index, S_cam_world, in_chunk, k.depth_small, k.camera_small)
        out.append(replace(view, chunk_id=chunk.chunk_id))
    return out


OtherSurface = Callable[[DepthView, Array, Ints], NDArray[np.bool_]]
"""Tells of points at which a view measures a surface (M, 3), and of their rows (M,), whether that is another one."""


def place_visibility(
    points: Array,
    views: Iterable[DepthView],
    settings: VisibilitySettings | None = None,
    other: OtherSurface | None = None,
) -> PlaceVisibility:
    """Ask frames about surface points of one instance, world coordinates, shape (N, 3).

    Where `other` tells that the surface at a point is another one, that counts as free space.
    """
    s = settings or VisibilitySettings()
    verdicts = []
    for view in views:
        there, free = _counts(points, view, s, other)
        if there + free >= max(s.least_points, s.least_share * len(points)):
            verdicts.append((there + free, free, (view.session_id, view.frame_index)))
    if not verdicts:
        return PlaceVisibility("unseen", 0.0, ())
    shares = np.array([f / n for n, f, _ in verdicts])
    share = float(np.median(shares))
    gone = shares >= s.gone
    if share >= s.gone and gone.sum() >= s.least_frames:
        verdict, kept = "gone", gone
    elif share <= s.there:
        verdict, kept = "there", shares <= s.there
    else:
        verdict, kept = "unclear", np.ones(len(verdicts), bool)
    best = sorted((t for t, k in zip(verdicts, kept, strict=True) if k), key=lambda t: (-t[0], t[2]))
    return PlaceVisibility(verdict, share, tuple(t[2] for t in best), verdict == "gone" and other is not None)


def point_visibility(points: Array, view: DepthView, s: VisibilitySettings) -> NDArray[np.int8]:
    """Return what one frame tells about each point of a surface, world coordinates: `UNTOLD`, `MET` or `FREE`.

    Shapes (N, 3) -> (N,).
    """
    from list3r.memory.library.overlap.kernels import tell  # questions to a memory do without numba

    slack, reach = (s.tolerance_m, s.noise_per_m2, s.noise_share), (s.nearest_m, s.most_depth_m)
    p = np.ascontiguousarray(view.S_cam_world.apply(points))
    return tell(p, float(view.unit), np.ascontiguousarray(view.depth), view.camera, slack, reach)


def in_sight_of(views: Sequence[DepthView], s: VisibilitySettings) -> Array:
    """Return the boxes round all that views can tell about, world coordinates: beyond, every point is untold.

    Shape (V, 2, 3).
    """
    out = np.empty((len(views), 2, 3))
    for n, view in enumerate(views):
        fx, fy, cx, cy = view.camera
        height, width = view.depth.shape
        rays = np.array([((u - cx) / fx, (v - cy) / fy, 1.0) for u in (0.0, width) for v in (0.0, height)])
        ends = np.concatenate([np.zeros((1, 3)), rays * s.most_depth_m * view.unit])
        seen = view.S_cam_world.inverse().apply(ends)
        out[n] = seen.min(axis=0), seen.max(axis=0)
    return out


def changed_points(points: Array, views: Iterable[DepthView], s: VisibilitySettings) -> NDArray[np.bool_]:
    """Return the points of a surface of which no more frames say that they are still there than that they are not.
    (N,).
    """
    free, met = tally(points, views, s)
    return np.asarray(free >= met)


def tally(points: Array, views: Iterable[DepthView], s: VisibilitySettings) -> tuple[Ints, Ints]:
    """Return how many frames see through each point of a surface, and how many see it. Shapes (N,), (N,)."""
    free, met = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view in views:
        seen = point_visibility(points, view, s)
        free += seen == FREE
        met += seen == MET
    return free, met


def seen_through_shares(
    surfaces: Sequence[Array], views: Iterable[DepthView], s: VisibilitySettings
) -> list[float | None]:
    """Return of each of several surfaces the share that more frames see through than see, of what they tell of; None
    where that is too little.
    """
    free, met = tally(np.concatenate(surfaces), views, s)
    ends = np.cumsum([len(points) for points in surfaces])
    out: list[float | None] = []
    for f, m in zip(np.split(free, ends[:-1]), np.split(met, ends[:-1]), strict=True):
        known = f + m > 0
        out.append(float(np.mean(f[known] > m[known])) if known.sum() >= s.least_points else None)
    return out


def _counts(points: Array, view: DepthView, s: VisibilitySettings, other: OtherSurface | None) -> tuple[int, int]:
    """Return how many points of a surface one frame sees where they should be, and through how many it sees further."""
    seen = point_visibility(points, view, s)
    met, free = seen == MET, int((seen == FREE).sum())
    if other is None or not met.any():
        return int(met.sum()), free
    replaced = int(other(view, points[met], np.flatnonzero(met)).sum())
    return int(met.sum()) - replaced, free + replaced
