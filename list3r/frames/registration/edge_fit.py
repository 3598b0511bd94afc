"""A camera moved until depth edges in 3D fall on colour edges: the search behind `calibrate`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera
from list3r.frames.options import Intrinsics
from list3r.frames.registration.edges import depth_edges

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

NAMES = ("f", "k1", "tx", "ty", "tz", "cx", "cy", "rx", "ry", "rz")
"""The numbers of a colour camera: px, 1, metres of T_color_depth, px, rotation vector in radians."""
_STEP = np.array([15.0, 0.05, 0.015, 0.015, 0.015, 8.0, 8.0, 0.01, 0.01, 0.01])
"""About how far each of them can be off at the coarsest level."""
_MOST_EDGES = 30_000
_GRID_EDGES = 6_000
_GRID_BLUR_PX = 8.0


class EdgeFit:
    """Depth edges in 3D and the colour images they must fall on. A vector of `NAMES` is a camera."""

    def __init__(
        self, pairs: Sequence[tuple[NDArray[np.uint8], Floats]], camera: Camera, depth_intrinsics: Intrinsics
    ) -> None:
        """`pairs` are raw colour (H, W, 3) and depth (h, w) in metres; `camera` is the first guess for colour."""
        self._camera, self.aspect = camera, camera.fy / camera.fx
        self._powers = [_edge_strength(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)) for color, _ in pairs]
        self.scale = camera.width / 640.0
        """Width of the colour images against the 640 px that settings refer to."""
        self._same_size = all(depth.shape == color.shape[:2] for color, depth in pairs)
        fx, fy, cx, cy = depth_intrinsics
        points: list[Array] = []
        pixels: list[Array] = []
        slots: list[NDArray[np.int64]] = []
        for k, (_, depth) in enumerate(pairs):
            e = depth_edges(depth)
            points.append(np.stack([(e.x - cx) / fx * e.z, (e.y - cy) / fy * e.z, e.z], axis=1))
            pixels.append(np.stack([e.x, e.y], axis=1))
            slots.append(2 * k + np.where(e.horizontal, 0, 1).astype(np.int64))
        self.count = sum(map(len, points))
        """Edge pixels found; an even choice of them is used."""
        thin = max(1, self.count // _MOST_EDGES)
        self._points = np.concatenate([p[::thin] for p in points] or [np.zeros((0, 3))]).astype(np.float64)
        self._pixels = np.concatenate([p[::thin] for p in pixels] or [np.zeros((0, 2))])
        self._slots = np.concatenate([s[::thin] for s in slots] or [np.zeros(0, np.int64)])
        self.frames = len(pairs)
        self._maps: tuple[float, Floats] = (-1.0, np.zeros(0, np.float32))

    def start(self) -> Array:
        """Return the first guess: no offset, no distortion."""
        v = np.zeros(len(NAMES))
        v[[0, 5, 6]] = self._camera.fx, self._camera.cx, self._camera.cy
        return v

    def project(self, v: Array, points: Array) -> tuple[Array, Array]:
        """Colour pixels of points of the depth camera. Shape (N, 3) -> (N,), (N,)."""
        p = points @ Rotation.from_rotvec(v[7:]).as_matrix().T if np.any(v[7:]) else points
        inverse = 1.0 / np.maximum(p[:, 2] + v[4], 1e-3)
        x, y = (p[:, 0] + v[2]) * inverse, (p[:, 1] + v[3]) * inverse
        bend = v[0] * (1.0 + v[1] * (x * x + y * y))
        return x * bend + v[5], self.aspect * y * bend + v[6]

    def score(self, v: Array, blur_px: float, left_out: tuple[int, int] | None = None, thin: int = 1) -> float:
        """Mean strength of the colour edges under the projected depth edges, 1 is chance.

        Frames count by the root of their edges. `left_out` (g, n) leaves out every frame k with k % n == g.
        """
        slots, points = self._slots[::thin], self._points[::thin]
        if left_out is not None:
            kept = (slots // 2) % left_out[1] != left_out[0]
            slots, points = slots[kept], points[kept]
        if not len(slots):
            return 0.0
        counts = np.bincount(slots // 2, minlength=self.frames)
        weights = 1.0 / np.sqrt(counts[slots // 2])
        u, w = self.project(v, points)
        met = self._sample(self._stack(blur_px), slots, u, w)
        return float(weights @ met / weights.sum())

    def grid(self, start: Array, focal_range: float, offset_range_m: float) -> Array:
        """Return the best of a grid of focal lengths and offsets, on strongly blurred edges."""
        thin = max(1, len(self._slots) // _GRID_EDGES)
        found = []
        for f in start[0] * np.linspace(1 - focal_range, 1 + focal_range, 17):
            for tx in np.linspace(-offset_range_m, offset_range_m, 9):
                for ty in np.linspace(-offset_range_m / 2, offset_range_m / 2, 5):
                    v = start.copy()
                    v[[0, 2, 3]] = f, tx, ty
                    found.append((self.score(v, _GRID_BLUR_PX, thin=thin), v))
        return max(found, key=lambda pair: pair[0])[1]

    def climb(self, v: Array, free: list[int], blur_px: float, left_out: tuple[int, int] | None = None) -> Array:
        """Return the best camera near `v` over the free numbers (Nelder and Mead's simplex)."""
        step, base = _STEP[free], v

        def miss(x: Array) -> float:
            w = base.copy()
            w[free] += x * step
            return -self.score(w, blur_px, left_out)

        simplex = np.vstack([np.zeros(len(free)), np.eye(len(free))]) * (blur_px / 6.0)
        limits: Any = {"initial_simplex": simplex, "xatol": 5e-3, "fatol": 1e-4, "maxfev": 150 * len(free)}
        out = v.copy()
        out[free] += minimize(miss, np.zeros(len(free)), method="Nelder-Mead", options=limits).x * step
        return out

    def jackknife(self, best: Array, free: list[int], blur_px: float, groups: int) -> dict[str, float]:
        """Standard deviations from leaving out groups of frames in turn (Efron and Stein, 1981)."""
        fits = np.array([self.climb(best, free, blur_px, (g, groups)) for g in range(groups)])
        spread = np.sqrt((groups - 1) / groups * np.sum((fits - fits.mean(axis=0)) ** 2, axis=0))
        return {name: float(spread[i]) for i, name in enumerate(NAMES) if i in free or name == "k1"}

    def moved_px(self, v: Array) -> float | None:
        """Median distance between an edge's own pixel and where it is projected; None for images of two sizes."""
        if not self._same_size or not len(self._slots):
            return None
        u, w = self.project(v, self._points)
        return float(np.median(np.hypot(u - self._pixels[:, 0], w - self._pixels[:, 1])))

    def _stack(self, blur_px: float) -> Floats:
        """Strength of vertical and horizontal edges of every frame, blurred, 1 on average. Shape (2F, H, W)."""
        if self._maps[0] != blur_px:
            blurred = [cv2.GaussianBlur(m, (0, 0), blur_px * self.scale) for pair in self._powers for m in pair]
            means = [max(float(m.mean()), 1e-6) for m in blurred]
            self._maps = (blur_px, np.stack([m / mean for m, mean in zip(blurred, means, strict=True)]))
        return self._maps[1]

    @staticmethod
    def _sample(stack: Floats, slots: NDArray[np.int64], u: Array, v: Array) -> Array:
        """Bilinear values at pixels of images of a stack, borders repeated outside. Shape (N,)."""
        _, height, width = stack.shape
        u, v = np.clip(u, 0.0, width - 1.001), np.clip(v, 0.0, height - 1.001)
        x, y = u.astype(np.int64), v.astype(np.int64)
        a, b, flat = u - x, v - y, stack.ravel()
        at = (slots * height + y) * width + x
        top = (1 - a) * flat[at] + a * flat[at + 1]
        bottom = (1 - a) * flat[at + width] + a * flat[at + width + 1]
        return np.asarray((1 - b) * top + b * bottom)


def _edge_strength(gray: NDArray[Any]) -> tuple[Floats, Floats]:
    """Vertical and horizontal edges against their surroundings, so that weak outlines count beside strong print."""
    scale = gray.shape[1] / 640.0
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), max(scale, 0.5))
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    power = gx * gx + gy * gy
    around = cv2.GaussianBlur(power, (0, 0), 20.0 * scale) + 4.0
    strength = power / (power + 2.0 * around) / (np.sqrt(power) + 1e-6)
    return (strength * np.abs(gx)).astype(np.float32), (strength * np.abs(gy)).astype(np.float32)
