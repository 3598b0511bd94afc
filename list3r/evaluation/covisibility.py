"""Which frames see the same surface: covisibility from true poses and depth.

`share[i, j]` is the part of the surface seen in frame i that frame j sees too (SuperGlue's overlap score, Sarlin et al.
2020, before its mean over both directions). It is kept directed: a close look at a table top is wholly inside a wide
view of the room, while the wide view shares little with the close look.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.frames.base import Camera
from list3r.frames.files import check_ordinary
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.core.unpacking import open_archive

Array = NDArray[np.float64]
Shares = NDArray[np.float32]


@dataclass(frozen=True)
class CovisibilitySettings:
    """How surfaces are compared."""

    points: int = 600
    """Surface points of a frame that are projected into the others, on a regular grid: a share is good to 2 %."""
    tolerance: float = 0.05
    """Greatest difference of depths of one surface, as a share of the depth: indoors the noise of sensors and true
    poses is below it, the gap between an object and the surface behind above it."""
    most_deg: float = 75.0
    """Greatest angle between two lines of sight at which a surface counts as seen again: two cameras facing each other
    down a corridor see the same walls but cannot be matched."""


@dataclass(frozen=True)
class Covisibility:
    """Covisibility of some frames of a video."""

    frame: NDArray[np.int64]
    """Frame.index, ascending. Shape (F,)."""
    time_s: Array
    """Seconds. Shape (F,)."""
    share: Shares
    """Part of the surface of frame i that frame j sees too, in [0, 1], NaN where it is not known. Shape (F, F)."""

    def __post_init__(self) -> None:
        count = len(self.frame)
        if self.share.shape != (count, count) or self.time_s.shape != (count,):
            raise OptionError(
                f"covisibility of {count} frames with shares of shape {self.share.shape} and times of shape "
                f"{self.time_s.shape}: expected ({count}, {count}) and ({count},)"
            )
        if count and not (np.diff(self.frame) > 0).all():
            raise OptionError("covisibility: the frame numbers must ascend")


def covisibility(
    depth: ArrayLike, T_world_cam: ArrayLike, camera: Camera, settings: CovisibilitySettings | None = None
) -> Shares:
    """Return shares (F, F) from depth maps (F, h, w) along z, 0 where unknown, poses (F, 4, 4) and camera of the maps.

    A point of frame i is seen in frame j when it is in j's picture, seen from about the same side, and j's depth there
    agrees: within the tolerance of the span of the four pixels around it, so that a steep surface on a coarse map is
    not lost. Where j has no depth the point says nothing and is left out, though at most half of them. Rows and columns
    of frames without a finite pose or without depth are NaN. Raises `OptionError` for shapes that do not fit.
    """
    chosen = settings or CovisibilitySettings()
    maps, poses = np.asarray(depth), np.asarray(T_world_cam, dtype=np.float64)
    if maps.ndim != 3 or maps.shape[1:] != (camera.height, camera.width) or min(maps.shape[1:]) < 2:
        raise OptionError(
            f"depth maps of shape {maps.shape} for a camera of {camera.width}x{camera.height}: expected (F, h, w)"
        )
    if poses.shape != (len(maps), 4, 4):
        raise OptionError(f"{len(maps)} depth maps with poses of shape {poses.shape}: expected ({len(maps)}, 4, 4)")
    posed = np.isfinite(poses).all(axis=(1, 2))
    grids = [_surface_points(d, camera, chosen.points) for d in maps]
    known = posed & np.array([len(g) > 0 for g in grids], dtype=bool)
    spans = _spans(maps)
    T_cam_world = np.full_like(poses, np.nan)
    T_cam_world[posed] = np.linalg.inv(poses[posed])
    share = np.full((len(maps), len(maps)), np.nan, dtype=np.float32)
    rows = np.flatnonzero(known)
    views = _Views(T_cam_world[rows], *(span[rows] for span in spans))
    for i in rows:
        rays = grids[i] @ poses[i, :3, :3].T
        world = rays + poses[i, :3, 3]
        share[i, rows] = _seen_shares(world, rays, views, camera, chosen)
        share[i, i] = 1.0
    return share


def _surface_points(depth: NDArray[Any], camera: Camera, count: int) -> Array:
    """Return points of a regular grid of pixels that have depth, camera coordinates. Shape (P, 3)."""
    step = max(1, int(np.sqrt(depth.size / count)))
    y, x = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step]
    z = depth[y, x].astype(np.float64)
    good = np.isfinite(z) & (z > 0)
    x, y, z = x[good], y[good], z[good]
    return np.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z], axis=1)


def _spans(maps: NDArray[Any]) -> tuple[Shares, Shares]:
    """Return the least and greatest known depth of each block of 2 x 2 pixels; inf and 0 where none is known. (F, h-1,
    w-1)."""
    d = maps.astype(np.float32)
    d[~(np.isfinite(d) & (d > 0))] = 0.0
    corners = (d[:, :-1, :-1], d[:, :-1, 1:], d[:, 1:, :-1], d[:, 1:, 1:])
    high = np.maximum.reduce(corners)
    low = np.minimum.reduce([np.where(c > 0, c, np.float32(np.inf)) for c in corners])
    return low, high


@dataclass(frozen=True)
class _Views:
    """Surfaces seen by G frames."""

    T_cam_world: Array
    """Shape (G, 4, 4)."""
    low: Shares
    """Least depth of each block of 2 x 2 pixels, see `_spans`. Shape (G, h-1, w-1)."""
    high: Shares
    """Greatest depth of each block. Shape (G, h-1, w-1)."""


def _seen_shares(world: Array, rays: Array, views: _Views, camera: Camera, settings: CovisibilitySettings) -> Array:
    """Return the share of world points (P, 3), found along rays (P, 3), that each of G frames sees. Shape (G,)."""
    T_cam_world = views.T_cam_world
    p = np.einsum("gij,pj->gpi", T_cam_world[:, :3, :3], world) + T_cam_world[:, None, :3, 3]
    z = p[..., 2]
    along = np.einsum("gij,pj,gpi->gp", T_cam_world[:, :3, :3], rays, p, optimize=True)
    lengths = np.linalg.norm(rays, axis=1) * np.linalg.norm(p, axis=2)
    facing = along >= np.cos(np.deg2rad(settings.most_deg)) * lengths
    ahead = (z > 1e-9) & facing
    safe = np.where(ahead, z, 1.0)
    x, y = camera.fx * p[..., 0] / safe + camera.cx, camera.fy * p[..., 1] / safe + camera.cy
    inside = ahead & (x > -0.5) & (x < camera.width - 0.5) & (y > -0.5) & (y < camera.height - 0.5)
    column = np.clip(np.where(inside, x, 0.0), 0, camera.width - 2).astype(np.int64)
    line = np.clip(np.where(inside, y, 0.0), 0, camera.height - 2).astype(np.int64)
    frames = np.broadcast_to(np.arange(len(z))[:, None], z.shape)
    near, far = views.low[frames, line, column], views.high[frames, line, column]
    unknown = inside & (far <= 0)
    seen = inside & (z >= near * (1 - settings.tolerance)) & (z <= far * (1 + settings.tolerance))
    count = np.maximum(len(world) - unknown.sum(axis=1), len(world) / 2)
    return np.asarray(seen.sum(axis=1) / count)


def write_covisibility(path: str | Path, found: Covisibility) -> None:
    """Write an `.npz` of `frame` (F,) int64, `time_s` (F,) float64 and `share` (F, F) float32."""
    with Path(path).open("wb") as file:
        np.savez_compressed(file, frame=found.frame, time_s=found.time_s, share=found.share)


def read_covisibility(path: str | Path) -> Covisibility:
    """Read a file of `write_covisibility`. Raises `SourceError` for one that is absent or another kind."""
    try:
        check_ordinary(Path(path).stat(), Path(path))
        with Path(path).open("rb") as file:
            open_archive(file).close()
        with np.load(path, allow_pickle=False) as arrays:
            missing = [name for name in ("frame", "time_s", "share") if name not in arrays]
            if missing:
                raise SourceError(f"{path} has no array {' or '.join(missing)}; expected frame, time_s and share")
            return Covisibility(
                arrays["frame"].astype(np.int64),
                arrays["time_s"].astype(np.float64),
                arrays["share"].astype(np.float32),
            )
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or 'it is not an .npz file'}") from error
    except (ValueError, AttributeError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise SourceError(f"{path} is not a covisibility file; write one with `eval revisits --save`") from error
    except OptionError as error:
        raise SourceError(f"{path}: {error}") from error
