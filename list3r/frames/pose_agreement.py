"""Whether given poses fit what the frames show: depth of one frame, seen from another, must meet its depth.

Recorders differ in the axes of a camera and in which way a pose leads; a wrong guess still runs, and makes a world of
nonsense. What fits far better in another convention is distinguished here from poses that merely drift. So is depth in
another unit: where the camera moves by known metres, what it sees moves by as many pixels as it is far. Without depth,
corners that are found again must lie on the lines that the poses leave them. `disagreements` is all of it in words.
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
    gaps: tuple[int, ...] = (1, 2, 4, 8, 16, 30)
    """Frames between the two of a pair; the first gap over which the camera has moved well, else the last that will do.
    """
    good_turn_deg: float = 10.0
    """Motion that tells a wrong camera, too, or"""
    good_shift_m: float = 0.2
    least_turn_deg: float = 4.0
    """Motion that tells conventions apart, or"""
    least_shift_m: float = 0.08
    stride: int = 6
    """Spacing of the pixels that are compared."""
    tolerance: float = 0.05
    """Depth that differs by less than this share agrees."""
    least_points: int = 100
    features: int = 800
    """Corners of a picture that are followed to the other of a pair."""
    epipolar_px: float = 2.0
    """What moved is as far from where its pose lets it be, whatever its depth; matches beyond are false."""
    parallax_px: float = 5.0
    """What moved by less, as against something far away, says nothing of its depth."""
    least_matches: int = 15
    """Of all pairs together."""
    factor: float = 1.6
    """Depth that is this many times off is reported; a wrong focal length alone makes less."""
    spread: float = 0.25
    """Six of ten matches must agree on one factor within this share."""
    relief: float = 0.08
    """Least deviation of the logarithms of depth at which a correlation means something."""
    good: float = 0.75
    """Another convention is meant where at least this share agrees in it,"""
    gain: float = 0.2
    """and so much more than as the poses are read: neighbours agree by half in any convention."""
    fits: float = 0.75
    """Poses, depth and camera contradict each other where a smaller share agrees: 0.93 and more does of recordings that
    are right or drift, under 0.3 with the camera of another size, 0.63 with one 1.3 times too long (0154)."""
    least_fits: int = 3
    """Least pairs of frames for that verdict."""
    rigid: float = 0.4
    """Of the matches of two pictures without depth this share must fit one camera motion, or there is no verdict."""
    good_lines: float = 0.5
    """As `good`, of corners near the lines that poses leave them; some matches are always false."""
    fits_lines: float = 0.15
    """As `fits`: of COLMAP's own poses 0.6 to 0.9 lie there, of others under 0.05."""


CONVENTIONS = {
    "as they are read": lambda T: T,
    "with the camera's y and z flipped (OpenGL instead of OpenCV axes)": lambda T: T @ OPENGL_TO_OPENCV,
    "inverted (world to camera)": np.linalg.inv,
    "inverted and flipped (world to camera, OpenGL axes)": lambda T: np.linalg.inv(T) @ OPENGL_TO_OPENCV,
}
"""Conventions in which a pose may have been written; the first is the one that the reader assumes."""


Pair = tuple[Frame, Frame]


def disagreements(source: FrameSource, settings: AgreementSettings | None = None) -> tuple[str, ...]:
    """Return how given poses, depth and camera contradict each other, a sentence each; nothing if they agree.

    Nothing, too, if it cannot be decided: without poses or motion, or if the frames show too little.
    """
    s, info = settings or AgreementSettings(), source.info
    if not info.has_poses or info.camera is None:
        return ()
    pairs = _pairs(source, s)
    shares = _shares(pairs, info.camera, s)
    found = _best(shares, s)
    if found is not None:
        what = "depth" if info.has_depth else "pictures"
        return (
            f"the given poses do not fit the {what}, but would fit {found}: the recording uses another convention than "
            "its format",
        )
    factor = _factor(source, pairs, s)
    if factor is not None:
        return (_factor_text(factor, info.depth_scale),)
    stated = shares["as they are read"]  # without common view there is nothing to meet
    return _misfit([v for v in stated if v > 0] if info.has_depth else stated, info.has_depth, s)


def _misfit(shares: list[float], has_depth: bool, s: AgreementSettings) -> tuple[str, ...]:
    """Return the message about poses that fit in no convention."""
    least = s.fits if has_depth else s.fits_lines * s.good / s.good_lines
    if len(shares) < s.least_fits or float(np.median(shares)) >= least:
        return ()
    if not has_depth:
        return (
            "hardly any matched corners of two pictures agree with the given poses: the poses or the camera's "
            "intrinsics do not belong to these pictures",
        )
    return (
        f"only {100 * np.median(shares):.0f} % of the depth of one frame, projected into another by the given poses, "
        "agrees with the depth there (over 90 % in a sound recording): poses, depth or the camera's intrinsics do not "
        "belong to this recording",
    )


def _shares(pairs: list[Pair], camera: Camera, s: AgreementSettings) -> dict[str, list[float]]:
    """Return for each convention the share of each pair that agrees."""
    out: dict[str, list[float]] = {name: [] for name in CONVENTIONS}
    for pair in pairs:
        matched = None if pair[0].depth is not None else _matches(*pair, s)
        if matched is not None and not _moves_as_one(matched, camera, s):
            continue
        for name, change in CONVENTIONS.items():
            poses = [change(f.T_source_cam) for f in pair]
            near = _share(*pair, poses, camera, s) if matched is None else _on_lines(matched, poses, camera, s)
            out[name].append(near)
    return out


def _moves_as_one(
    matched: tuple[NDArray[np.float64], NDArray[np.float64]], camera: Camera, s: AgreementSettings
) -> bool:
    """Return whether most matches fit one motion of the camera, whichever."""
    import cv2

    if len(matched[0]) < s.least_matches:
        return False
    _, mask = cv2.findEssentialMat(*matched, camera.matrix(), cv2.RANSAC, 0.999, s.epipolar_px)
    return mask is not None and float((mask > 0).mean()) >= s.rigid


def _best(shares: dict[str, list[float]], s: AgreementSettings) -> str | None:
    """Return the convention that fits far better than the one that poses are read in."""
    if len(shares["as they are read"]) < min(2, s.pairs):
        return None
    middle = {name: float(np.median(found)) for name, found in shares.items()}
    stated, best = middle["as they are read"], max(middle, key=lambda name: middle[name])
    return best if middle[best] >= max(s.good, stated + s.gain) else None


def _on_lines(
    matched: tuple[NDArray[np.float64], NDArray[np.float64]], poses: list[Pose], camera: Camera, s: AgreementSettings
) -> float:
    """Return the share of matches that lie on the lines that poses leave them, as if all were `good_lines` at best."""
    r, q = (_rays(xy, camera) for xy in matched)
    T_b_a = np.linalg.inv(poses[1]) @ poses[0]
    line = np.cross(T_b_a[:3, 3], r @ T_b_a[:3, :3].T)
    off = np.abs((q * line).sum(axis=1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
    return float((off * camera.fx < s.epipolar_px).mean()) * s.good / s.good_lines


def _factor(source: FrameSource, pairs: list[Pair], s: AgreementSettings) -> float | None:
    info = source.info
    if not (info.has_depth and info.has_poses and info.camera is not None and info.poses_metric):
        return None
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
    sure = (off * camera.fx < s.epipolar_px) & (np.linalg.norm(moved, axis=1) * camera.fx > s.parallax_px) & (z > 0)
    across = np.cross(q[sure], turned[sure])
    factors: NDArray[np.float64] = -(across * np.cross(q[sure], t)).sum(axis=1) / (z[sure] * (across**2).sum(axis=1))
    return np.stack([z[sure], factors])


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
    found = [corners.detectAndCompute(f.gray(), None) for f in (a, b)]
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


def _factor_text(factor: float, units: float | None) -> str:
    """Return the message about depth in another unit than its poses."""
    if np.isinf(factor):
        return "depth is larger where the motion in the pictures shows nearer things: is it disparity (1 / depth)?"
    fix = "" if units is None else f"; try --depth-scale {float(f'{units / factor:.2g}'):g} instead of {units:g}"
    return (
        f"by the given poses, the motion in the pictures fits {factor:.2g} times the given depth{fix} (if the poses "
        "are in metres)"
    )


def _pairs(source: FrameSource, s: AgreementSettings) -> list[Pair]:
    """Return pairs of frames spread over the source, between which the camera moved."""
    starts = np.linspace(0, max(0, source.info.frame_count - 2), s.pairs).astype(int)
    found = (_pair(source, start, s) for start in np.unique(starts).tolist())
    return [pair for pair in found if pair is not None]


def _pair(source: FrameSource, start: int, s: AgreementSettings) -> Pair | None:
    """Return two frames with pose, and depth where there is any, between which the camera moved well, or enough."""
    first, will_do = _whole(source, start), None
    for gap in s.gaps if first is not None else ():
        if start + gap >= source.info.frame_count:
            break
        other = _whole(source, start + gap)
        if first is None or other is None:
            continue
        assert first.T_source_cam is not None and other.T_source_cam is not None
        step = np.linalg.inv(first.T_source_cam) @ other.T_source_cam
        turn = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
        shift = np.linalg.norm(step[:3, 3]) if source.info.poses_metric else 0.0
        if turn >= s.good_turn_deg or shift >= s.good_shift_m:
            return first, other
        if turn >= s.least_turn_deg or shift >= s.least_shift_m:
            will_do = first, other
    return will_do


def _whole(source: FrameSource, position: int) -> Frame | None:
    frame = next(iter(source.read(position, position + 1)), None)
    if not isinstance(frame, Frame) or frame.T_source_cam is None:
        return None
    blank = frame.depth is None or not frame.depth.any()
    return None if source.info.has_depth and blank else frame


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
