"""Find the instances that move inside one chunk, from its own poses and mask tracks (paper A.3, within a subsequence).

Points of a static instance in frame a, projected into frame b, meet the instance there, are occluded, or are outside.
An instance that moved leaves its place: frame b sees through its points to a surface behind. Only seeing through is
counted, because neither another viewpoint, nor occlusion, nor a mask that leaks, breaks or changes its object can cause
it; and since all pairs of frames are compared in both directions, motion along the ray is found as well (the later
points float before the surface that the earlier frame saw). The least step that counts as "behind" follows from the
depth consistency of the chunk's static part.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from list3r.frames.base import Camera
from list3r.memory.core.records import FrameSamples, LocalInstance, LocalLibrary, MotionTrack

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


_DEVIATIONS_AT_QUANTILE = 0.524
"""The 0.4 quantile of the magnitude of Gaussian errors, in standard deviations."""


@dataclass(frozen=True)
class MotionSettings:
    """When an instance counts as moving."""

    frames: int = 24
    """Frames, spread over the chunk, that are compared with each other."""
    grid: tuple[int, int] = (64, 48)
    """Columns and rows of the depth grid of a frame."""
    deviations: float = 5.0
    """Robust standard deviations of the static part's depth beyond which a point is seen through."""
    static_quantile: float = 0.4
    """Quantile of the disagreement of two frames that gives the deviation of static surfaces: movers over half of the
    picture do not reach it."""
    least_step: float = 0.03
    """Least distance of the surface behind, as a share of the depth."""
    footprint: float = 1.5
    """A point within this many sample spacings of its instance's own points in the other frame is found again."""
    least_points: int = 5
    """Fewest points of an instance on which a pair of frames is judged."""
    least_pairs: int = 6
    """Fewest pairs of frames on which an instance is judged."""
    pair_quantile: float = 0.75
    """An instance is judged by this quantile over its pairs of frames: it may be static for most of the chunk."""
    least_share: float = 0.4
    """Least share of the visible points that are seen through for an instance to move."""
    smoothing_frames: int = 3
    """Frames on either side that smooth a position, larger views weighing more."""


@dataclass(frozen=True)
class _Samples:
    """The samples of the chosen frames."""

    points: Floats
    """Chunk coordinates. Shape (S, 3)."""
    place: Ints
    """Number of the frame among the chosen. Shape (S,)."""
    instance: Ints
    """Row of the instance in the library, -1 for none. Shape (S,)."""
    xy: Floats
    """Pixel. Shape (S, 2)."""
    T_cam_chunk: Floats
    """Shape (K, 4, 4)."""
    frames: Ints
    """Frame.index. Shape (K,)."""


@dataclass(frozen=True)
class _DepthGrid:
    """Depth of one frame on a coarse grid."""

    nearest: Floats
    """Least depth in the neighbourhood of a cell, infinite where nothing is known. Shape (h, w)."""
    farthest: Floats
    """Greatest depth there, 0 where nothing is known. Shape (h, w)."""
    middle: Floats
    """Depth in the cell itself, NaN where unknown. Shape (h, w)."""
    spacing_px: float
    """Distance of neighbouring samples."""


def flag_dynamic(
    samples: FrameSamples, library: LocalLibrary, camera: Camera, settings: MotionSettings | None = None
) -> LocalLibrary:
    """Return the library with `dynamic` and `motion` set for instances that move against the rest of the chunk.

    `camera` is that of the colour images, whose pixels `samples` number. Flags that are set already stay.
    """
    chosen = settings or MotionSettings()
    shares = seen_through(samples, library, camera, chosen)
    out = tuple(
        replace(i, dynamic=True, motion=i.motion or motion_track(samples, i, chosen))
        if i.dynamic or shares[k] >= chosen.least_share
        else i
        for k, i in enumerate(library.instances)
    )
    return replace(library, instances=out)


def seen_through(
    samples: FrameSamples, library: LocalLibrary, camera: Camera, settings: MotionSettings | None = None
) -> Floats:
    """Return the share of each instance's points that other frames in which it is visible see through. Shape (I,).

    A high quantile over pairs of frames; 0 where there are too few to judge.
    """
    chosen = settings or MotionSettings()
    count = len(library.instances)
    used = _choose(samples, library, camera, chosen)
    if not count or len(used.frames) < 2:
        return np.zeros(count)
    size = len(used.frames)
    grids = [_depth_grid(used, k, camera, chosen) for k in range(size)]
    depth, cell = zip(*(_project(used, k, camera, chosen) for k in range(size)), strict=True)
    step = _depth_steps(used, grids, depth, cell, chosen)
    again, through = np.zeros((count, size, size)), np.zeros((count, size, size))
    for k, grid in enumerate(grids):
        seen = (cell[k][:, 0] >= 0) & (used.place != k) & (used.instance >= 0)
        row, column = np.where(seen[:, None], cell[k], 0).T
        z = depth[k]
        behind = (
            seen & np.isfinite(grid.nearest[row, column]) & (grid.nearest[row, column] > z * (1 + step[used.place, k]))
        )
        hidden = grid.farthest[row, column] < z * (1 - step[used.place, k])
        reach = chosen.footprint * grid.spacing_px * z / camera.fx
        behind &= ~_found_again(used, k, behind, reach)
        for mask, target in ((behind, through), (seen & ~hidden & ~behind, again)):
            np.add.at(target, (used.instance[mask], used.place[mask], k), 1.0)
    visible = np.zeros((count, size))
    held = used.instance >= 0
    np.add.at(visible, (used.instance[held], used.place[held]), 1.0)
    return _judge(again, through, visible, chosen)


def motion_track(
    samples: FrameSamples, instance: LocalInstance, settings: MotionSettings | None = None
) -> MotionTrack | None:
    """Return the median point of an instance, frame by frame; None where it has no points.

    Component-wise medians, smoothed over neighbouring frames by the visible area of the instance.
    """
    chosen = settings or MotionSettings()
    mine = np.flatnonzero((samples.instance == instance.local_id) & np.isfinite(samples.points).all(axis=1))
    if not len(mine):
        return None
    frames, _start, count = np.unique(samples.frame[mine], return_index=True, return_counts=True)
    order = np.argsort(samples.frame[mine], kind="stable")
    bounds = np.append(0, np.cumsum(count))
    points = samples.points[mine[order]].astype(np.float64)
    middle = np.array([np.median(points[a:b], axis=0) for a, b in itertools.pairwise(bounds)])
    area = dict(zip(instance.track.frames.tolist(), instance.track.areas_px.tolist(), strict=True))
    shown = np.array([float(area.get(int(f), n)) for f, n in zip(frames, count, strict=True)])
    return MotionTrack(frames.astype(np.int64), _steadied(frames, middle, shown, chosen).astype(np.float32))


def _steadied(frames: Ints, middle: Floats, shown: Floats, settings: MotionSettings) -> Floats:
    """Return the local straight lines through the positions, weighted by the square of the visible area."""
    out = middle.copy()
    for k, frame in enumerate(frames):
        near = np.abs(frames - frame) <= settings.smoothing_frames
        if near.sum() < 3:
            continue
        t = (frames[near] - frame).astype(np.float64)
        weight = (shown[near] / shown[near].max()) ** 2
        design = np.column_stack([np.ones_like(t), t]) * np.sqrt(weight)[:, None]
        out[k] = np.linalg.lstsq(design, middle[near] * np.sqrt(weight)[:, None], rcond=None)[0][0]
    return out


# ------------------------------------------------------------------------------------------------ parts


def _choose(samples: FrameSamples, library: LocalLibrary, camera: Camera, settings: MotionSettings) -> _Samples:
    """Return the samples of at most `frames` frames, spread evenly."""
    good = np.isfinite(samples.T_chunk_cam).all(axis=(1, 2))
    frames = np.intersect1d(samples.camera_frames[good], samples.frame)
    if len(frames) > settings.frames:
        frames = frames[np.linspace(0, len(frames) - 1, settings.frames).round().astype(np.int64)]
    usable = np.isin(samples.frame, frames) & np.isfinite(samples.points).all(axis=1) & (samples.confidence > 0)
    row = {i.local_id: k for k, i in enumerate(library.instances)}
    pixel = samples.pixel[usable].astype(np.int64)
    cameras = {int(f): k for k, f in enumerate(samples.camera_frames)}
    poses = samples.T_chunk_cam[[cameras[int(f)] for f in frames]]
    ids, which = np.unique(samples.instance[usable], return_inverse=True)
    rows = np.array([row.get(int(n), -1) for n in ids], np.int64)
    return _Samples(
        points=samples.points[usable].astype(np.float64),
        place=np.searchsorted(frames, samples.frame[usable]).astype(np.int64),
        instance=rows[which.ravel()],
        xy=np.column_stack([pixel % camera.width, pixel // camera.width]).astype(np.float64),
        T_cam_chunk=np.asarray(np.linalg.inv(poses), np.float64),
        frames=frames.astype(np.int64),
    )


def _cells(xy: Floats, camera: Camera, settings: MotionSettings) -> Ints:
    """Return the row and column of each pixel in the depth grid. Shape (S, 2)."""
    columns, rows = settings.grid
    return np.column_stack(
        [
            np.clip((xy[:, 1] + 0.5) * rows / camera.height, 0, rows - 1),
            np.clip((xy[:, 0] + 0.5) * columns / camera.width, 0, columns - 1),
        ]
    ).astype(np.int64)


def _depth_grid(used: _Samples, k: int, camera: Camera, settings: MotionSettings) -> _DepthGrid:
    mine = used.place == k
    T = used.T_cam_chunk[k]
    z = used.points[mine] @ T[2, :3] + T[2, 3]
    row, column = _cells(used.xy[mine], camera, settings).T
    columns, rows = settings.grid
    nearest, farthest = np.full((rows, columns), np.inf), np.zeros((rows, columns))
    np.minimum.at(nearest, (row, column), z)
    np.maximum.at(farthest, (row, column), z)
    middle = np.where(np.isfinite(nearest), nearest, np.nan)
    spacing = np.sqrt(rows * columns / max(1, int(np.isfinite(nearest).sum())))
    reach = 2 * int(np.ceil(spacing)) + 1
    return _DepthGrid(
        minimum_filter(nearest, reach, mode="constant", cval=np.inf),
        maximum_filter(farthest, reach, mode="constant", cval=0.0),
        middle,
        float(spacing * camera.width / columns),
    )


def _project(used: _Samples, k: int, camera: Camera, settings: MotionSettings) -> tuple[Floats, Ints]:
    """Return the depth of all samples in frame k, and their cells there, -1 outside."""
    T = used.T_cam_chunk[k]
    cam = used.points @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(cam[:, 2], 1e-9)
    xy = cam[:, :2] / z[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    inside = (cam[:, 2] > 1e-6) & (xy > -0.5).all(axis=1) & (xy < [camera.width - 0.5, camera.height - 0.5]).all(axis=1)
    cell = _cells(np.where(inside[:, None], xy, 0.0), camera, settings)
    return z, np.where(inside[:, None], cell, -1)


def _depth_steps(
    used: _Samples,
    grids: list[_DepthGrid],
    depth: tuple[Floats, ...],
    cell: tuple[Ints, ...],
    settings: MotionSettings,
) -> Floats:
    """Return the share of the depth by which frame k must see farther than points of frame a to see through. (K, K).

    From the 0.4 quantile of the static part's own disagreement, which movers over half of the picture do not reach.
    """
    size = len(grids)
    out = np.full((size, size), settings.least_step)
    for k, grid in enumerate(grids):
        row, column = cell[k].T
        with np.errstate(invalid="ignore", divide="ignore"):
            off = np.abs(np.log(np.where(row >= 0, grid.middle[row, column], np.nan) / depth[k]))
        for a in range(size):
            mine = off[(used.place == a) & np.isfinite(off)]
            if a != k and len(mine) >= 20:
                deviation = float(np.quantile(mine, settings.static_quantile)) / _DEVIATIONS_AT_QUANTILE
                out[a, k] = max(settings.least_step, settings.deviations * deviation)
    return out


def _found_again(used: _Samples, k: int, behind: Mask, reach: Floats) -> Mask:
    """Return which points are within `reach` (S,) of their own instance's points in frame k: thin instances slip
    through the depth grid. Shape (S,)."""
    out = np.zeros(len(behind), bool)
    asked = np.flatnonzero(behind)
    own = np.flatnonzero((used.place == k) & (used.instance >= 0))
    if not len(asked) or not len(own):
        return out
    far = 1e3 * float(np.abs(used.points).max() + 1.0)
    tree = cKDTree(np.column_stack([used.points[own], far * used.instance[own]]))
    distance, _ = tree.query(np.column_stack([used.points[asked], far * used.instance[asked]]))
    out[asked] = distance < reach[asked]
    return out


def _judge(again: Floats, through: Floats, visible: Floats, settings: MotionSettings) -> Floats:
    """Return the quantile of the share seen through, over the more distant half of an instance's pairs of frames. (I,).

    Both frames of a pair show the instance; a slow mover still hides behind itself from one frame to the next.
    """
    total = again + through
    both = (visible[:, :, None] >= 3) & (visible[:, None, :] >= 3) & (total >= settings.least_points)
    share = through / np.maximum(total, 1.0)
    number = np.arange(both.shape[1])
    lag = np.abs(number[:, None] - number[None, :])
    out = np.zeros(len(share))
    for k in range(len(share)):
        if both[k].sum() >= settings.least_pairs:
            far = both[k] & (lag >= np.median(lag[both[k]]))
            out[k] = np.quantile(share[k][far], settings.pair_quantile)
    return out
