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
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from list3r.frames.edges import depth_edges
from list3r.frames.folder import FolderSource
from list3r.frames.options import Intrinsics, SourceOptions
from list3r.frames.source import open_source
from list3r.memory.errors import FrameError, SourceError

Array = NDArray[np.float64]

_NAMES = ("f", "k1", "tx", "ty", "tz", "cx", "cy", "rx", "ry", "rz")
_MOST_EDGES = 30_000
_STEP = np.array([15.0, 0.05, 0.015, 0.015, 0.015, 8.0, 8.0, 0.01, 0.01, 0.01])
"""About how far each number can be off at the coarsest level; px, 1, metres, px, radians."""


@dataclass(frozen=True)
class CalibrateSettings:
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
    """Estimate cx, cy too; on one depth they cannot be told from the offset."""
    rotation: bool = False
    """Estimate the rotation too; small ones cannot be told from cx, cy."""
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
class Calibration:
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
    moved_px: float
    """Median shift of depth edges between taking depth as registered and the best fit."""
    frames: tuple[int, ...]
    """Positions used."""
    edges: int
    """Edge pixels used."""

    def options(self, base: SourceOptions) -> SourceOptions:
        """The source's options with what was found."""
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
        """The options that say the same to `list3r build`; empty when nothing was determined."""
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
    source_path: str | Path, options: SourceOptions | None = None, settings: CalibrateSettings | None = None
) -> Calibration:
    """Estimate the colour camera relative to the depth camera of a folder with both.

    Raises `SourceError` when the source has no depth or no first guess of a camera.
    """
    options, settings = options or SourceOptions(), settings or CalibrateSettings()
    source = open_source(source_path, options)
    if not isinstance(source, FolderSource) or not source.info.has_depth:
        raise SourceError(f"{source_path} has no depth images: there is nothing to calibrate")
    if source.info.camera is None:
        raise SourceError(f"{source_path}: a first guess of the camera is needed; give --intrinsics fx,fy,cx,cy")
    positions, pairs = _still_pairs(source, settings)
    problem = _Problem(source, pairs)
    start = problem.start()
    if problem.count < settings.least_edges or len(pairs) < settings.groups:
        reason = f"only {problem.count} edge pixels in {len(pairs)} frames: too few steps in depth to see an offset"
        return problem.result("undetermined", reason, start, {}, positions)
    free = [0, 1, 2, 3] + ([5, 6] if settings.center else []) + ([7, 8, 9] if settings.rotation else [])
    best = problem.search(start, free, settings)
    std = problem.jackknife(best, free, settings)
    if std["k1"] > 0.05 or abs(best[1]) < std["k1"]:
        free.remove(1)
        best[1] = 0.0
        best = problem.refine(best, free, settings.levels_px[-2:])
        std = problem.jackknife(best, free, settings)
    status, reason = _judge(problem, start, best, std, settings)
    return problem.result(status, reason, best, std, positions)


def _judge(
    problem: _Problem, start: Array, best: Array, std: dict[str, float], settings: CalibrateSettings
) -> tuple[str, str]:
    score = problem.score(best, problem.edge_maps(settings.levels_px[-1]))
    if score < settings.least_score:
        return "undetermined", f"depth edges meet colour edges only {score:.1f} times as well as chance"
    moved = problem.moved_from_registered(best)
    if moved is not None and moved < settings.registered_px * problem.scale:
        return "registered", f"the best fit moves depth edges by {moved:.1f} px: depth lies on the colour pixels"
    if std["f"] > 0.02 * best[0] or max(std["tx"], std["ty"]) > 0.01:
        found = f"f by {std['f']:.1f} px, offset by {1000 * max(std['tx'], std['ty']):.0f} mm"
        return "undetermined", f"groups of frames disagree ({found}); more frames with near and far edges are needed"
    if abs(best[0] / start[0] - 1.0) > settings.focal_range or np.abs(best[2:4]).max() > 1.5 * settings.offset_range_m:
        return "undetermined", "the best fit lies at the border of the search; give a better first --intrinsics"
    return "estimated", f"depth edges meet colour edges {score:.1f} times as well as chance"


class _Problem:
    """Depth edges in 3D and the colour images they must fall on. A vector of `_NAMES` is a camera."""

    def __init__(self, source: FolderSource, pairs: list[tuple[NDArray[np.uint8], NDArray[np.float32]]]) -> None:
        info, optics = source.info, source.optics
        assert info.camera is not None
        self._grays = [cv2.cvtColor(color, cv2.COLOR_RGB2GRAY) for color, _ in pairs]
        self._size = self._grays[0].shape if pairs else (info.camera.height, info.camera.width)
        self.scale = self._size[1] / 640.0
        """Width of the colour images against the 640 px that the settings speak of."""
        self._assumed = np.eye(4) if optics.T_color_depth is None else optics.T_color_depth
        self._aspect = info.camera.fy / info.camera.fx
        self._camera = info.camera
        self._distortion = optics.distortion
        self.depth_intrinsics: Intrinsics = optics.depth_intrinsics or _four(info.camera)
        self._same_size = all(depth.shape == self._size for _, depth in pairs)
        self._points, self._pixels, self._sideways = [], [], []
        fx, fy, cx, cy = self.depth_intrinsics
        for _, depth in pairs:
            e = depth_edges(depth)
            self._points.append(
                np.stack([(e.x - cx) / fx * e.z, (e.y - cy) / fy * e.z, e.z], axis=1).astype(np.float64)
            )
            self._pixels.append(np.stack([e.x, e.y], axis=1))
            self._sideways.append(e.horizontal)
        self.count = sum(map(len, self._points))
        thin = max(1, self.count // _MOST_EDGES)
        self._points = [part[::thin] for part in self._points]
        self._pixels = [part[::thin] for part in self._pixels]
        self._sideways = [part[::thin] for part in self._sideways]

    def start(self) -> Array:
        """The camera as the source is assumed to be, without its offset and distortion."""
        v = np.zeros(len(_NAMES))
        v[[0, 5, 6]] = self._camera.fx, self._camera.cx, self._camera.cy
        return v

    def assumed(self) -> Array:
        """The camera as the source is assumed to be."""
        v = self.start()
        v[1] = self._distortion[0] if self._distortion else 0.0
        v[2:5] = self._assumed[:3, 3]
        v[7:] = Rotation.from_matrix(self._assumed[:3, :3]).as_rotvec()
        return v

    def edge_maps(self, blur_px: float) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Strength of vertical and of horizontal colour edges, blurred, 1 on average. One pair for each frame."""
        return [_edge_maps(gray, blur_px * self.scale, self.scale) for gray in self._grays]

    def project(self, v: Array, points: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Pixels of points of the depth camera. Shape (N, 3) -> (N,), (N,)."""
        p = points @ Rotation.from_rotvec(v[7:]).as_matrix().T if np.any(v[7:]) else points
        z = p[:, 2] + v[4]
        x, y = (p[:, 0] + v[2]) / z, (p[:, 1] + v[3]) / z
        bend = 1.0 + v[1] * (x * x + y * y)
        return (v[0] * x * bend + v[5]).astype(np.float32), (v[0] * self._aspect * y * bend + v[6]).astype(np.float32)

    def score(self, v: Array, maps: list, members: list[int] | None = None, thin: int = 1) -> float:  # type: ignore[type-arg]
        """Mean colour edge under the projected depth edges, 1 is chance; frames count by the root of their edges."""
        total = weight = 0.0
        for k in range(len(maps)) if members is None else members:
            points, sideways = self._points[k][::thin], self._sideways[k][::thin]
            if len(points) == 0:
                continue
            u, w = self.project(v, points)
            met = np.where(sideways, _sample(maps[k][0], u, w), _sample(maps[k][1], u, w))
            share = len(points) ** 0.5
            total += share * float(met.mean())
            weight += share
        return total / weight if weight else 0.0

    def search(self, start: Array, free: list[int], settings: CalibrateSettings) -> Array:
        """Grid over focal length and offset on blurred edges, then refinement."""
        maps = self.edge_maps(8.0)
        thin = max(1, min(self.count, _MOST_EDGES) // 6000)
        reach = settings.offset_range_m
        best, best_score = start, -1.0
        for f in start[0] * np.linspace(1 - settings.focal_range, 1 + settings.focal_range, 17):
            for tx in np.linspace(-reach, reach, 9):
                for ty in np.linspace(-reach / 2, reach / 2, 5):
                    v = start.copy()
                    v[[0, 2, 3]] = f, tx, ty
                    score = self.score(v, maps, thin=thin)
                    if score > best_score:
                        best, best_score = v, score
        best = self.refine(best, [i for i in free if i in (0, 2, 3)], settings.levels_px[:1])
        return self.refine(best, free, settings.levels_px[1:])

    def refine(
        self, v: Array, free: list[int], levels_px: tuple[float, ...], members: list[int] | None = None
    ) -> Array:
        """Climb from `v` over the free numbers, level by level (Nelder and Mead's simplex)."""
        for blur in levels_px:
            maps, base, step = self.edge_maps(blur), v.copy(), _STEP[free]

            def miss(x: Array, maps: list = maps, base: Array = base, step: Array = step) -> float:  # type: ignore[type-arg]
                w = base.copy()
                w[free] += x * step
                return -self.score(w, maps, members)

            simplex = np.vstack([np.zeros(len(free)), np.eye(len(free))]) * (blur / 6.0)
            limits: Any = {"initial_simplex": simplex, "xatol": 2e-3, "fatol": 1e-5, "maxfev": 150 * len(free)}
            v = base
            v[free] += minimize(miss, np.zeros(len(free)), method="Nelder-Mead", options=limits).x * step
        return v

    def jackknife(self, best: Array, free: list[int], settings: CalibrateSettings) -> dict[str, float]:
        """Standard deviations from leaving out groups of frames in turn (Efron and Stein, 1981)."""
        groups = settings.groups
        fits = []
        for g in range(groups):
            members = [k for k in range(len(self._points)) if k % groups != g]
            fits.append(self.refine(best.copy(), free, settings.levels_px[-1:], members))
        spread = np.sqrt((groups - 1) / groups * np.sum((np.array(fits) - np.mean(fits, axis=0)) ** 2, axis=0))
        return {name: float(spread[i]) for i, name in enumerate(_NAMES) if i in free or name == "k1"}

    def moved_from_registered(self, v: Array) -> float | None:
        """Median distance between an edge's own pixel and where it is projected; None for images of two sizes."""
        if not self._same_size or self.count == 0:
            return None
        shifts = []
        for points, pixels in zip(self._points, self._pixels, strict=True):
            u, w = self.project(v, points)
            shifts.append(np.hypot(u - pixels[:, 0], w - pixels[:, 1]))
        return float(np.median(np.concatenate(shifts)))

    def result(self, status: str, reason: str, v: Array, std: dict[str, float], positions: list[int]) -> Calibration:
        maps = self.edge_maps(1.0) if self.count else []
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(v[7:]).as_matrix()
        matrix[:3, 3] = v[2:5]
        moved = self.moved_from_registered(v)
        return Calibration(
            status=status,
            reason=reason,
            intrinsics=(float(v[0]), float(v[0] * self._aspect), float(v[5]), float(v[6])),
            distortion=(float(v[1]), 0.0, 0.0, 0.0, 0.0) if v[1] else (),
            depth_intrinsics=self.depth_intrinsics,
            T_color_depth=matrix,
            std=std,
            score=self.score(v, maps),
            score_assumed=self.score(self.assumed(), maps),
            moved_px=float("nan") if moved is None else moved,
            frames=tuple(positions),
            edges=self.count,
        )


def _still_pairs(
    source: FolderSource, settings: CalibrateSettings
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


def _edge_maps(gray: NDArray[Any], blur_px: float, scale: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Edges against their surroundings, so that weak outlines count as well as strong print."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), max(scale, 0.5))
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    power = gx * gx + gy * gy
    around = cv2.GaussianBlur(power, (0, 0), 20.0 * scale) + 4.0
    strength = power / (power + 2.0 * around) / (np.sqrt(power) + 1e-6)
    out = [cv2.GaussianBlur(strength * np.abs(g), (0, 0), blur_px) for g in (gx, gy)]
    return out[0] / max(float(out[0].mean()), 1e-6), out[1] / max(float(out[1].mean()), 1e-6)


def _sample(image: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bilinear values of an image at pixels, its border repeated outside. Shape (N,)."""
    height, width = image.shape
    u, v = np.clip(np.nan_to_num(u), 0.0, width - 1.001), np.clip(np.nan_to_num(v), 0.0, height - 1.001)
    x, y = u.astype(np.int32), v.astype(np.int32)
    a, b, at, flat = u - x, v - y, y * width + x, image.ravel()
    top = (1 - a) * flat[at] + a * flat[at + 1]
    bottom = (1 - a) * flat[at + width] + a * flat[at + width + 1]
    return np.asarray((1 - b) * top + b * bottom)


def _four(camera: Any) -> Intrinsics:
    return (camera.fx, camera.fy, camera.cx, camera.cy)


def _commas(values: tuple[float, ...]) -> str:
    return ",".join(f"{v:.6g}" for v in values)
