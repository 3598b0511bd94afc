"""Whether given poses fit the depth of the frames: depth of one frame, seen from another, must meet its depth.

Recorders differ in the axes of a camera and in which way a pose leads; a wrong guess still runs, and makes a world of
nonsense. What fits far better in another convention is told apart here from poses that merely drift. So is depth in
another unit: where the camera moves by known metres, what it sees moves by as many pixels as it is far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame, FrameSource
from list3r.frames.recordings.axes import OPENGL_TO_OPENCV

Pose = NDArray[np.float64]


@dataclass(frozen=True)
class AgreementSettings:
    """When poses are taken for those of another convention."""

    pairs: int = 6
    """Pairs of frames that are looked at, spread over the source."""
    gaps: tuple[int, ...] = (1, 4, 12, 30)
    """Frames between the two of a pair; the first gap over which the camera has moved enough."""
    least_turn_deg: float = 4.0
    """Motion that tells conventions apart, or"""
    least_shift_m: float = 0.08
    stride: int = 6
    """Every so many-th pixel is compared."""
    tolerance: float = 0.05
    """Depth that differs by less than this share agrees."""
    least_points: int = 100
    features: int = 800
    """Corners of a picture that are followed to the other of a pair."""
    epipolar_px: float = 2.0
    """What moved is as far from where its pose lets it be, whatever its depth; matches beyond are false."""
    parallax_px: float = 5.0
    """What moved by less, as against something far away, tells nothing of its depth."""
    least_matches: int = 15
    """Of all pairs together."""
    factor: float = 1.6
    """Depth that is as many times off is told; a wrong focal length alone makes less."""
    spread: float = 0.25
    """Six of ten matches must agree on one factor within this share."""
    relief: float = 0.08
    """Deviation of the logarithms of depth from which on it can be told whether they rise or fall together."""
    good: float = 0.75
    """Another convention is meant where at least this share agrees in it,"""
    gain: float = 0.2
    """and so much more than as the poses are read: neighbours agree by half in any convention."""


CONVENTIONS = {
    "as they are read": lambda T: T,
    "with the camera's y and z turned round (OpenGL against OpenCV)": lambda T: T @ OPENGL_TO_OPENCV,
    "led the other way (world to camera)": np.linalg.inv,
    "led the other way and turned round": lambda T: np.linalg.inv(T) @ OPENGL_TO_OPENCV,
}
"""What a pose may have been meant as; the first is what the reader makes of it."""


def wrong_convention(source: FrameSource, settings: AgreementSettings | None = None) -> str | None:
    """Return in which convention the poses of a source fit its depth, where that is not the one they are read in.

    None where they fit, or where it cannot be told: without depth, without motion, or when nothing fits.
    """
    s, info = settings or AgreementSettings(), source.info
    if not (info.has_depth and info.has_poses and info.camera is not None and info.poses_metric):
        return None
    shares: dict[str, list[float]] = {name: [] for name in CONVENTIONS}
    for start in np.linspace(0, max(0, info.frame_count - 2), s.pairs).astype(int).tolist():
        pair = _pair(source, start, s)
        if pair is None:
            continue
        for name, change in CONVENTIONS.items():
            share = _share(*pair, [change(f.T_source_cam) for f in pair], info.camera, s)
            shares[name].append(share)
    if len(shares["as they are read"]) < min(2, s.pairs):
        return None
    middle = {name: float(np.median(found)) for name, found in shares.items()}
    stated, best = next(iter(middle.values())), max(middle, key=lambda name: middle[name])
    return best if middle[best] >= max(s.good, stated + s.gain) else None


def depth_factor(source: FrameSource, settings: AgreementSettings | None = None) -> float | None:
    """Return what depth must be multiplied by for pixels to move as the given poses say, where that is far from 1.

    Infinite where depth falls with what they say, as disparity does. None where it is near 1, or where it cannot be
    told: without depth, metric poses or motion, or where matches disagree.
    """
    s, info = settings or AgreementSettings(), source.info
    if not (info.has_depth and info.has_poses and info.camera is not None and info.poses_metric):
        return None
    starts = np.linspace(0, max(0, info.frame_count - 2), s.pairs).astype(int).tolist()
    pairs = [pair for start in starts if (pair := _pair(source, start, s)) is not None]
    stated, factors = np.concatenate([np.zeros((2, 0)), *(_factors(*p, info.camera, s) for p in pairs)], axis=1)
    if len(factors) < s.least_matches:
        return None
    if _falls(stated, stated * factors, s):
        return float("inf")
    middle = float(np.median(factors))
    agree = middle > 0 and float((np.abs(factors / middle - 1) < s.spread).mean()) > 0.6
    return middle if agree and max(middle, 1 / middle) >= s.factor else None


def _factors(a: Frame, b: Frame, camera: Camera, s: AgreementSettings) -> NDArray[np.float64]:
    """Return for each match of two frames a's depth, and what it must be multiplied by to fall on b's. Shape (2, M).

    Of a ray r with depth z and the ray q of its match, k z R r + t is parallel to q: q x (R r) k z = -q x t.
    """
    assert a.depth is not None and a.T_source_cam is not None and b.T_source_cam is not None
    xy_a, xy_b = _matches(a, b, s)
    column, row = np.rint(xy_a).astype(int).T
    z = a.depth[row, column].astype(np.float64)
    r, q = (_rays(xy, camera) for xy in (xy_a, xy_b))
    T_b_a = np.linalg.inv(b.T_source_cam) @ a.T_source_cam
    turned, t = r @ T_b_a[:3, :3].T, T_b_a[:3, 3]
    line = np.cross(t, turned)
    off = np.abs((q * line).sum(axis=1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
    moved = q[:, :2] - turned[:, :2] / np.maximum(turned[:, 2:], 1e-6)
    told = (off * camera.fx < s.epipolar_px) & (np.linalg.norm(moved, axis=1) * camera.fx > s.parallax_px) & (z > 0)
    across = np.cross(q[told], turned[told])
    factors: NDArray[np.float64] = -(across * np.cross(q[told], t)).sum(axis=1) / (z[told] * (across**2).sum(axis=1))
    return np.stack([z[told], factors])


def _falls(stated: NDArray[np.float64], meant: NDArray[np.float64], s: AgreementSettings) -> bool:
    """Tell whether depth falls where what it should be rises."""
    known = meant > 0
    logs = np.log(np.stack([stated[known], meant[known]]))
    return logs.shape[1] >= s.least_matches and bool(
        logs.std(axis=1).min() > s.relief and np.corrcoef(logs)[0, 1] < -0.5
    )


def _matches(a: Frame, b: Frame, s: AgreementSettings) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mutual nearest neighbours of two pictures' corners, px. Shapes (M, 2)."""
    import cv2

    corners = cv2.ORB.create(s.features)
    found = [corners.detectAndCompute(cv2.cvtColor(f.color, cv2.COLOR_RGB2GRAY), None) for f in (a, b)]
    (points_a, words_a), (points_b, words_b) = found
    if words_a is None or words_b is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(words_a, words_b)
    xy = [(points_a[m.queryIdx].pt, points_b[m.trainIdx].pt) for m in pairs]
    both = np.array(xy, np.float64).reshape(-1, 2, 2)
    return both[:, 0], both[:, 1]


def _rays(xy: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return rays of z 1 through pixels. Shape (N, 3)."""
    flat = (xy - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.column_stack([flat, np.ones(len(flat))])


def scale_doubts(source: FrameSource, settings: AgreementSettings | None = None) -> tuple[str, ...]:
    """Return what to say of depth in another unit than its poses, nothing where they agree or it cannot be told."""
    factor = depth_factor(source, settings)
    if factor is None:
        return ()
    if np.isinf(factor):
        return (
            "depth grows where the motion of what is seen says that things are nearer: is it disparity (1 / depth)?",
        )
    how = f"{factor:.2g} times as far away" if factor > 1 else f"{1 / factor:.2g} times as near"
    units = source.info.depth_scale
    fix = "" if units is None else f": --depth-scale {float(f'{units / factor:.2g}'):g} would fit, it is {units:g}"
    return (f"between the given poses the motion of what is seen is that of things {how} as depth says{fix}",)


def _pair(source: FrameSource, start: int, s: AgreementSettings) -> tuple[Frame, Frame] | None:
    """Two frames with depth and pose between which the camera moved enough."""
    first = _whole(source, start)
    for gap in s.gaps if first is not None else ():
        if start + gap >= source.info.frame_count:
            break
        other = _whole(source, start + gap)
        if first is None or other is None:
            continue
        assert first.T_source_cam is not None and other.T_source_cam is not None
        step = np.linalg.inv(first.T_source_cam) @ other.T_source_cam
        turn = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
        if turn >= s.least_turn_deg or np.linalg.norm(step[:3, 3]) >= s.least_shift_m:
            return first, other
    return None


def _whole(source: FrameSource, position: int) -> Frame | None:
    frame = next(iter(source.read(position, position + 1)), None)
    if not isinstance(frame, Frame) or frame.depth is None or frame.T_source_cam is None:
        return None
    return frame


def _share(a: Frame, b: Frame, poses: list[Pose], camera: Camera, s: AgreementSettings) -> float:
    """Return the share of a's depth that meets b's, of what falls on b's known depth; 0 where hardly anything does."""
    assert a.depth is not None and b.depth is not None
    row, column = np.nonzero(a.depth[:: s.stride, :: s.stride] > 0)
    row, column = row * s.stride, column * s.stride
    z = a.depth[row, column].astype(np.float64)
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(z))], axis=1)
    T_b_a = np.linalg.inv(poses[1]) @ poses[0]
    points = (z[:, None] * rays) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    front = points[:, 2] > 1e-3
    uv = np.rint(points[front, :2] / points[front, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy))
    inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1)
    u, v = uv[inside].astype(np.int64).T
    seen, expected = b.depth[v, u], points[front, 2][inside]
    known = seen > 0
    if known.sum() < min(s.least_points, 0.2 * len(z)):
        return 0.0
    return float((np.abs(seen[known] - expected[known]) < s.tolerance * expected[known]).mean())
