"""What of the unseen space of an instance is solid, by what was seen alone.

The seen surface is a thin shell. Behind it lies a board where frames saw through a good part of the space behind, as
under a table: it is as thick as they leave it. What is seen from above with nothing seen through below it is a block
down to what it stands on. Nothing fills space that was seen through, or that another thing's surface is in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import Delaunay, QhullError

from list3r.exporters.solids.evidence import Evidence, Mask

Cells = NDArray[np.int64]
Image = Callable[[Cells, Cells, int], Cells]
"""Mirrors voxels (N, 3) of a grid of a shape (3,), at a mirror so many half voxels off its middle."""
_SHIFTS = 6


@dataclass(frozen=True)
class CompletionSettings:
    """When unseen space is solid."""

    board_share: float = 0.15
    """Of the space behind a surface, by area, that was seen through: from so much on the surface is a board."""
    board_quantile: float = 0.2
    """The thickness of a board is that of the unseen space where least was unseen: elsewhere sight was hidden."""
    board_m: float = 0.08
    """Boards are no thicker."""
    slack_m: float = 0.03
    """Sight tells free space from a surface at this distance from it."""
    slender: float = 3.0
    """A block is at most so many times as high as it is wide: a narrow top may be that of a back or a leg."""
    least_cells: int = 3
    """Of a surface that is completed."""
    feet_share: float = 0.3
    """Of the height: what was seen so far down goes on to what it stands on."""
    mirrored_free: float = 0.08
    """Share of a mirrored surface that may lie in free space, for the instance to be symmetric,"""
    mirrored_met: float = 0.3
    """and that must lie on its surface."""


_WHOLE = 0.5
"""Share of its outline that a surface fills, to be taken as whole: a rim is open."""


def completed(e: Evidence, settings: CompletionSettings | None = None) -> Mask:
    """Return the voxels that are solid: the shell, and what must be behind it."""
    s = settings or CompletionSettings()
    may = ~(e.free | e.other)
    for axis in range(3):
        rim = np.moveaxis(may, axis, 0)
        rim[: e.rim], rim[-e.rim :] = False, False
    shell = e.shell & may
    for image in (_left_right, _front_back, _diagonal):
        shell |= _mirrored(shell, e.free, image, s) & may
    shell |= _feet(shell, may, e, s)
    solid = shell.copy()
    for axis in range(3):
        for forward in (True, False):
            if axis == 2 and forward:
                continue  # what is seen from below alone says nothing of what is above
            turn = slice(None, None, 1 if forward else -1)
            at = [slice(None)] * 3
            at[axis] = turn
            view = tuple(at)
            moved = [np.moveaxis(m[view], axis, 2) for m in (shell, may, e.free, solid)]
            _behind(*moved, e=e, s=s, down=axis == 2)
    return _large_parts(solid | (ndimage.binary_closing(solid, iterations=2) & may))


def _mirrored(shell: Mask, free: Mask, image: Image, s: CompletionSettings) -> Mask:
    """Return the mirrored shell where the instance is symmetric, as far as is known, else nothing.

    What was seen need not end where the instance does, so that mirrors some voxels off its middle are tried too.
    """
    out = np.zeros_like(shell)
    near, inside_free = ndimage.binary_dilation(shell, iterations=2), ndimage.binary_erosion(free)
    cells, best = np.argwhere(shell), -1.0
    for shift in range(-_SHIFTS, _SHIFTS + 1):
        at = image(cells, np.array(shell.shape), shift)
        at = at[((at >= 0) & (at < shell.shape)).all(axis=1)]
        contradicted, met = (float(m[tuple(at.T)].sum()) / max(len(at), 1) for m in (inside_free, near))
        if contradicted <= s.mirrored_free and met >= s.mirrored_met and met - contradicted > best:
            best = met - contradicted
            out[:] = False
            out[tuple(at.T)] = True
    return out


def _left_right(cells: Cells, shape: Cells, shift: int) -> Cells:
    return np.asarray(np.stack([shape[0] - 1 + shift - cells[:, 0], cells[:, 1], cells[:, 2]], axis=1))


def _front_back(cells: Cells, shape: Cells, shift: int) -> Cells:
    return np.asarray(np.stack([cells[:, 0], shape[1] - 1 + shift - cells[:, 1], cells[:, 2]], axis=1))


def _diagonal(cells: Cells, shape: Cells, shift: int) -> Cells:
    aside = (shape[0] - shape[1]) // 2 + shift
    return np.asarray(np.stack([cells[:, 1] + aside, cells[:, 0] - aside, cells[:, 2]], axis=1))


def _feet(shell: Mask, may: Mask, e: Evidence, s: CompletionSettings) -> Mask:
    """Return what is between the lowest of a shell and what the instance stands on, where that is near and unseen."""
    height = int(np.flatnonzero(shell.any(axis=(0, 1))).max(initial=e.rim)) - e.rim
    lowest = np.where(shell.any(axis=2), shell.argmax(axis=2), 0)
    near = np.asarray((lowest > e.rim) & (lowest - e.rim <= s.feet_share * height))
    layer = np.arange(shell.shape[2])
    below = (layer >= e.rim) & (layer < lowest[:, :, None]) & near[:, :, None]
    return np.asarray(below & ~(below & ~may).any(axis=2, keepdims=True))


def _behind(shell: Mask, may: Mask, free: Mask, solid: Mask, *, e: Evidence, s: CompletionSettings, down: bool) -> None:
    """Complete what is behind the surfaces seen along the last axis, in `solid`."""
    depth = shell.shape[2]
    slack = int(np.ceil(s.slack_m * e.metre / e.edge)) + 1
    before, blocked = np.zeros_like(shell), np.zeros_like(shell)
    for k in range(1, slack + 2):
        shifted = [np.zeros_like(shell) for _ in range(2)]
        shifted[0][:, :, k:], shifted[1][:, :, k:] = free[:, :, :-k], shell[:, :, :-k]
        before |= shifted[0] & ~blocked
        blocked |= shifted[1]
    parts = ndimage.label(shell & before, np.ones((3, 3, 3)))[0]
    stop = _next_stop(may & ~shell)
    for n, box in enumerate(ndimage.find_objects(parts), 1):
        if box is None:
            continue
        x, y, z = np.nonzero(parts[box] == n)
        x, y, z = x + box[0].start, y + box[1].start, z + box[2].start
        cells = np.zeros(shell.shape[:2], bool)
        cells[x, y] = True
        if cells.sum() < s.least_cells:
            continue
        start = np.zeros(cells.shape, np.int64)
        start[x, y] = z
        if down:
            cells, start = _whole(cells, start, may)
        else:
            cells, start = _without_holes(cells, start, may)
        cx, cy = np.nonzero(cells)
        first = start[cx, cy]
        end = stop[cx, cy, np.minimum(first + 1, depth - 1)]
        length = end - first - 1
        ends_free = (end < depth) & free[cx, cy, np.minimum(end, depth - 1)]
        if ends_free.mean() >= s.board_share:
            seen = float(np.quantile(length[ends_free], s.board_quantile))
            most = int(np.clip(seen - slack + 1, 0, s.board_m * e.metre / e.edge))
        elif down:
            most = round(s.slender * 2 * float(ndimage.distance_transform_edt(np.pad(cells, 1)).max()))
        else:
            most = 1  # how thick it is nobody saw
        length = np.minimum(length, most)
        layer = np.arange(depth)
        filled = (layer >= first[:, None]) & (layer <= first[:, None] + length[:, None])
        solid[cx, cy] |= filled & may[cx, cy]


def _next_stop(open_: Mask) -> NDArray[np.int64]:
    """Return for each voxel the first one from it on, along the last axis, that is not open; the end where all are."""
    depth = open_.shape[2]
    out = np.full(open_.shape, depth, np.int64)
    following = np.full(open_.shape[:2], depth, np.int64)
    for k in range(depth - 1, -1, -1):
        following = np.where(open_[:, :, k], following, k)
        out[:, :, k] = following
    return out


def _without_holes(cells: Mask, start: NDArray[np.int64], may: Mask) -> tuple[Mask, NDArray[np.int64]]:
    """Close small gaps of a surface where nothing was seen through."""
    closed = ndimage.binary_closing(np.pad(cells, 3), iterations=2)[3:-3, 3:-3] | cells
    whole = ndimage.binary_fill_holes(closed)
    return _grown(cells, start, whole if cells.sum() >= _WHOLE * whole.sum() else closed, may)


def _whole(cells: Mask, start: NDArray[np.int64], may: Mask) -> tuple[Mask, NDArray[np.int64]]:
    """Take a surface on which things stand as whole up to its convex outline, where nothing was seen through."""
    level, at = start[cells], np.argwhere(cells)
    try:
        inside = Delaunay(at).find_simplex(np.argwhere(np.ones_like(cells))) >= 0
    except QhullError:
        return cells, start
    if np.quantile(np.abs(level - np.median(level)), 0.9) > 1 or len(at) < _WHOLE * inside.sum():
        return cells, start
    return _grown(cells, start, inside.reshape(cells.shape) | cells, may)


def _grown(cells: Mask, start: NDArray[np.int64], wanted: Mask, may: Mask) -> tuple[Mask, NDArray[np.int64]]:
    nearest = ndimage.distance_transform_edt(~cells, return_distances=False, return_indices=True)
    start = start[tuple(nearest)]
    x, y = np.indices(cells.shape)
    return np.asarray(cells | (wanted & may[x, y, start])), start


def _large_parts(solid: Mask, least: float = 0.02) -> Mask:
    """Leave out loose specks: parts of less than a share of the whole."""
    parts, count = ndimage.label(solid, np.ones((3, 3, 3)))
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray((sizes >= least * sizes.sum())[parts] & solid)
