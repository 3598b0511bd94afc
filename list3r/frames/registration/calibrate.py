"""Where the colour camera stands relative to the depth camera, from the data alone.

A step in depth is nearly always an edge in colour. The near sides of depth steps are lifted to 3D, projected into
the colour image, and the camera is moved until they fall on colour edges that run the same way; from coarse, blurred
edges to fine ones. Depths that differ part the focal length from the offset.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.folder import FolderSource
from list3r.frames.options import Intrinsics, SourceOptions
from list3r.frames.registration.edge_fit import Array, EdgeFit
from list3r.frames.source import open_source
from list3r.memory.core.errors import FrameError, SourceError


@dataclass(frozen=True)
class DepthCalibrationSettings:
    """How the search is done."""

    frames: int = 24
    """Frames used, spread over the source, the stillest of several each."""
    candidates: int = 4
    """Frames looked at for each one used."""
    focal_range: float = 0.18
    """Search this share either side of the first guess of the focal length."""
    offset_range_m: float = 0.06
    """Search sideways offsets up to this."""
    levels_px: tuple[float, ...] = (6.0, 3.0, 1.5, 1.0)
    """Blur of the colour edges from coarse to fine, px of a 640 px wide image."""
    center: bool = False
    """Estimate cx, cy too; on one depth they cannot be distinguished from the offset."""
    rotation: bool = False
    """Estimate the rotation too; small ones cannot be distinguished from cx, cy."""
    groups: int = 4
    """Groups of frames left out in turn to find the uncertainty."""
    registered_px: float = 3.5
    """Depth counts as registered when the best fit moves its edges by less than this (median), px of a 640 px wide
    image. Factory registration is off by one or two; the closest unregistered sensors by six and more."""
    least_edges: int = 400
    """Edge pixels needed in all."""
    least_score: float = 1.5
    """Edges must meet this many times as well as chance."""


@dataclass(frozen=True)
class DepthCalibration:
    """What was found, and how sure it is."""

    status: str
    """estimated, registered (depth lies on the colour pixels already), undetermined."""
    reason: str
    """One sentence."""
    intrinsics: Intrinsics
    """Colour camera, px."""
    distortion: tuple[float, ...]
    """Colour camera, OpenCV; empty where none was determined."""
    depth_intrinsics: Intrinsics
    """Depth camera as assumed, px; only its ratio to the colour camera's shows in edges."""
    T_color_depth: Array
    """Metres. Shape (4, 4)."""
    std: dict[str, float]
    """Jackknife standard deviations: f px, k1, tx ty m, and of what else was estimated."""
    score: float
    """Colour edges met at the best fit, 1 is chance."""
    score_assumed: float
    """The same as the source was assumed to be at the start."""
    moved_px: float | None
    """Median shift of depth edges between taking depth as registered and the best fit; None for images of two sizes."""
    frames: tuple[int, ...]
    """Positions used."""
    edges: int
    """Edge pixels used."""

    def options(self, base: SourceOptions) -> SourceOptions:
        """Return the source's options with what was found."""
        if self.status == "undetermined":
            return base
        if self.status == "registered":
            return replace(base, registered=True, depth_intrinsics=None, T_color_depth=None)
        return replace(
            base,
            intrinsics=self.intrinsics,
            distortion=self.distortion,
            depth_intrinsics=self.depth_intrinsics,
            T_color_depth=tuple(tuple(row) for row in self.T_color_depth.tolist()),
        )

    def command_line(self) -> str:
        """Return the options that say the same to `list3r build`; empty when nothing was determined."""
        if self.status != "estimated":
            return ""
        matrix = ",".join(f"{v:.6g}" for v in self.T_color_depth.ravel())
        words = [
            f"--intrinsics {_commas(self.intrinsics)}",
            f"--depth-intrinsics {_commas(self.depth_intrinsics)}",
            f"--depth-to-color {matrix}",
        ]
        return " ".join(words + ([f"--distortion {_commas(self.distortion)}"] if self.distortion else []))

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {
            "status": self.status,
            "reason": self.reason,
            "intrinsics": list(self.intrinsics),
            "distortion": list(self.distortion),
            "depth_intrinsics": list(self.depth_intrinsics),
            "depth_to_color": self.T_color_depth.tolist(),
            "std": self.std,
            "score": self.score,
            "score_assumed": self.score_assumed,
            "moved_px": self.moved_px,
            "frames": list(self.frames),
            "edges": self.edges,
            "command_line": self.command_line(),
        }


def calibrate(
    source_path: str | Path, options: SourceOptions | None = None, settings: DepthCalibrationSettings | None = None
) -> DepthCalibration:
    """Estimate the colour camera relative to the depth camera of a folder with both.

    Raises `SourceError` when the source has no depth or no first guess of a camera.
    """
    options, settings = options or SourceOptions(), settings or DepthCalibrationSettings()
    source = open_source(source_path, replace(options or SourceOptions(), max_side=0))
    if not isinstance(source, FolderSource) or not source.info.has_depth:
        raise SourceError(f"{source_path} has no depth images: there is nothing to calibrate")
    if source.info.camera is None:
        raise SourceError(f"{source_path}: a first guess of the camera is needed; give --intrinsics fx,fy,cx,cy")
    positions, pairs = _still_pairs(source, settings)
    depth_intrinsics = source.optics.depth_intrinsics or _four(source.info.camera)
    fit = EdgeFit(pairs, source.info.camera, depth_intrinsics)
    assumed = _assumed(fit, source)
    if fit.count < settings.least_edges or fit.frames < settings.groups:
        reason = f"only {fit.count} edge pixels in {fit.frames} frames: too few steps in depth to see an offset"
        return _result(fit, ("undetermined", reason), assumed, (assumed, {}), depth_intrinsics, positions)
    best, std = _search(fit, settings)
    verdict = _judge(fit, best, std, settings)
    return _result(fit, verdict, assumed, (best, std), depth_intrinsics, positions)


def _search(fit: EdgeFit, settings: DepthCalibrationSettings) -> tuple[Array, dict[str, float]]:
    """The best camera from coarse to fine, without a distortion that the data do not show, and its uncertainty."""
    finest, free = settings.levels_px[-1], [0, 1, 2, 3]
    free += ([5, 6] if settings.center else []) + ([7, 8, 9] if settings.rotation else [])
    best = fit.grid(fit.start(), settings.focal_range, settings.offset_range_m)
    for level, blur in enumerate(settings.levels_px):
        best = fit.climb(best, free if level else [0, 2, 3], blur)
    std = fit.jackknife(best, free, finest, settings.groups)
    if std["k1"] > 0.05 or abs(best[1]) < std["k1"]:
        free.remove(1)
        best[1] = 0.0
        best = fit.climb(best, free, finest)
        std = fit.jackknife(best, free, finest, settings.groups)
    return best, std


def _judge(fit: EdgeFit, best: Array, std: dict[str, float], settings: DepthCalibrationSettings) -> tuple[str, str]:
    """Status and reason."""
    score, start = fit.score(best, settings.levels_px[-1]), fit.start()
    if score < settings.least_score:
        return "undetermined", f"depth edges meet colour edges only {score:.1f} times as well as chance"
    moved = fit.moved_px(best)
    if moved is not None and moved < settings.registered_px * fit.scale:
        return "registered", f"the best fit moves depth edges by {moved:.1f} px: depth lies on the colour pixels"
    offset = max(std["tx"], std["ty"])
    if std["f"] > 0.02 * best[0] or offset > 0.01:
        found = f"f by {std['f']:.1f} px, offset by {1000 * offset:.0f} mm"
        return "undetermined", f"groups of frames disagree ({found}); more frames with near and far edges are needed"
    if abs(best[0] / start[0] - 1.0) > settings.focal_range or np.abs(best[2:4]).max() > 1.5 * settings.offset_range_m:
        return "undetermined", "the best fit lies at the border of the search; give a better first --intrinsics"
    return "estimated", f"depth edges meet colour edges {score:.1f} times as well as chance"


def _assumed(fit: EdgeFit, source: FolderSource) -> Array:
    """Return the camera as the source is opened with."""
    optics, v = source.optics, fit.start()
    v[1] = optics.distortion[0] if optics.distortion else 0.0
    if optics.T_color_depth is not None:
        v[2:5] = optics.T_color_depth[:3, 3]
        v[7:] = Rotation.from_matrix(optics.T_color_depth[:3, :3]).as_rotvec()
    return v


def _result(
    fit: EdgeFit,
    verdict: tuple[str, str],
    assumed: Array,
    found: tuple[Array, dict[str, float]],
    depth_intrinsics: Intrinsics,
    positions: list[int],
) -> DepthCalibration:
    """Return the result; `found` is the best camera and its deviations."""
    v, std = found
    T_color_depth = np.eye(4)
    T_color_depth[:3, :3] = Rotation.from_rotvec(v[7:]).as_matrix()
    T_color_depth[:3, 3] = v[2:5]
    aspect, moved = fit.aspect, fit.moved_px(v)
    return DepthCalibration(
        status=verdict[0],
        reason=verdict[1],
        intrinsics=(float(v[0]), float(v[0] * aspect), float(v[5]), float(v[6])),
        distortion=(float(v[1]), 0.0, 0.0, 0.0, 0.0) if v[1] else (),
        depth_intrinsics=depth_intrinsics,
        T_color_depth=T_color_depth,
        std=std,
        score=fit.score(v, 1.0),
        score_assumed=fit.score(assumed, 1.0),
        moved_px=moved,
        frames=tuple(positions),
        edges=fit.count,
    )


def _still_pairs(
    source: FolderSource, settings: DepthCalibrationSettings
) -> tuple[list[int], list[tuple[NDArray[np.uint8], NDArray[np.float32]]]]:
    """Positions and raw images of the stillest frame of each part of the source."""
    total = source.info.frame_count
    bounds = np.linspace(0, total, min(settings.frames, total) + 1).astype(int)
    positions, pairs = [], []
    for first, last in itertools.pairwise(bounds.tolist()):
        inner = np.linspace(first, last - 1, min(settings.candidates, last - first)).astype(int).tolist()
        moves = [(_movement(source, k), k) for k in dict.fromkeys(inner)]
        for _, position in sorted(moves):
            try:
                pairs.append(source.read_raw(position))
            except FrameError:
                continue
            positions.append(position)
            break
    return positions, pairs


def _movement(source: FolderSource, position: int) -> float:
    """Shift of the image against the next frame, px of a small image: fast pictures are blurred and out of step."""
    try:
        pair = [source.read_raw(k)[0] for k in (position, min(position + 1, source.info.frame_count - 1))]
    except FrameError:
        return float("inf")
    small = [cv2.resize(cv2.cvtColor(c, cv2.COLOR_RGB2GRAY), (160, 120), interpolation=cv2.INTER_AREA) for c in pair]
    window = cv2.createHanningWindow((160, 120), cv2.CV_32F)
    (dx, dy), _ = cv2.phaseCorrelate(small[0].astype(np.float32), small[1].astype(np.float32), window)
    return round(float(np.hypot(dx, dy)), 3)


def _four(camera: Any) -> Intrinsics:
    return (camera.fx, camera.fy, camera.cx, camera.cy)


def _commas(values: tuple[float, ...]) -> str:
    return ",".join(f"{v:.6g}" for v in values)
