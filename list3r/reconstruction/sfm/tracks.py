"""Track corners through a chunk: pyramidal Lucas-Kanade from frame to frame.

In keyframes, and every few frames, each position is then refined against the corner's first frame, so that a track does
not drift.

Frames after enough motion become keyframes, which is where new corners are detected. Where nearly all corners are lost
at once the next few frames are tried (blur, a flash, a black frame); when they are lost in those too (a jerk) all
tracks end and a new run of tracks begins. Pictures are first brought to one brightness where the camera
changed it (research/colour-video 0070).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.sift import shrinkage, shrunk
from list3r.reconstruction.sfm.settings import CornerSettings

Gray = NDArray[np.uint8]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class CornerTracks:
    """Observations of corners in F frames."""

    ids: tuple[Ints, ...]
    """Track numbers in each frame, ascending. F arrays of shape (N,)."""
    xy: tuple[Floats, ...]
    """Their pixels in the full picture. F arrays of shape (N, 2)."""
    keyframes: tuple[int, ...]
    """Positions of the keyframes, ascending."""
    run: NDArray[np.int64]
    """Number of the run of tracks of each frame, -1 for a frame without corners. Shape (F,)."""
    flow: Floats
    """Median motion of the corners since the frame before, by the longer side; NaN where unknown. Shape (F,)."""


def follow_corners(grays: Sequence[Gray], settings: CornerSettings | None = None) -> CornerTracks:
    """Track corners through grey pictures of one size."""
    chosen = settings or CornerSettings()
    follower = _Follower(chosen, grays[0].shape)
    while (at := len(follower.ids)) < len(grays):
        ahead = grays[at : at + 1 + chosen.most_lost]
        skipped = next((n for n, gray in enumerate(ahead) if follower.follow(gray)), None)
        if skipped is None:
            follower.start(grays[at])
        else:
            follower.note(skipped, ahead[skipped])
    return follower.tracks()


def as_bright(
    old: Gray, new: Gray, least: float = 3.0, values: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
) -> Gray:
    """`old` with the brightness and contrast of `new`, as a camera changes them between two frames; `old` itself where
    they differ by less than `least` grey values.

    `values` are grey values of both at common points, (N,) each; without, all pixels are compared by rank, as of
    frames that follow each other. Pixels that are black or saturated in either are ignored.
    """
    if values is None:
        ranks = np.linspace(0.02, 0.98, 49)
        values = np.quantile(old[::8, ::8], ranks), np.quantile(new[::8, ::8], ranks)
    a, b = values
    usable = (a > _BLACK) & (a < _WHITE) & (b > _BLACK) & (b < _WHITE)
    if usable.sum() < _LEAST_USABLE:
        return old
    a, b = a[usable], b[usable]
    kept, gain, offset = np.ones(len(a), bool), 1.0, 0.0
    for _ in range(3):
        middle_a, middle_b = a[kept].mean(), b[kept].mean()
        spread = float(((a[kept] - middle_a) ** 2).sum())
        gain = float(((a[kept] - middle_a) * (b[kept] - middle_b)).sum()) / spread if spread > len(a) else 1.0
        gain = float(np.clip(gain, *_GAINS))
        offset = middle_b - gain * middle_a
        off = np.abs(gain * a + offset - b)
        kept = off <= max(2.0, 3.0 * np.median(off))
    was, left = np.median(np.abs(a - b)), np.median(np.abs(gain * a + offset - b))
    if was < least or left > _MOST_UNEXPLAINED * was:
        return old
    return np.asarray(
        cv2.LUT(old, np.clip(np.rint(gain * np.arange(256.0) + offset), 0, 255).astype(np.uint8)), np.uint8
    )


_MOST_UNEXPLAINED = 0.5
"""Most of the difference that brightness and contrast may leave unexplained."""
_BLACK, _WHITE = 8.0, 247.0
"""Grey values beyond which a camera is saturated."""
_LEAST_USABLE = 12
"""Fewest values that determine a change of brightness."""
_GAINS = (0.25, 4.0)
"""Accepted changes of contrast."""


def smoothed(gray: Gray) -> Gray:
    """Mean grey values of the 7 x 7 px round each pixel."""
    return np.asarray(cv2.blur(gray, (7, 7)), np.uint8)


def values_at(image: Gray, xy: Floats) -> NDArray[np.float64]:
    """Values of the pixels nearest to positions (N, 2); the border beyond the picture. Shape (N,)."""
    x, y = np.clip(np.rint(xy), 0, np.array(image.shape[::-1]) - 1).astype(int).T
    return np.asarray(image[y, x], np.float64)


_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
"""When Lucas-Kanade ends."""


def _inside(xy: Floats, gray: Gray) -> NDArray[np.bool_]:
    """Which positions (N, 2) are in a picture, off its border. Shape (N,)."""
    height, width = gray.shape
    return np.asarray((xy >= 1).all(axis=1) & (xy[:, 0] < width - 2) & (xy[:, 1] < height - 2), np.bool_)


@dataclass
class _Alive:
    """Corners being tracked."""

    ids: Ints
    xy: Floats
    origin: Ints
    """Position of the first frame of each."""
    origin_xy: Floats

    @staticmethod
    def none() -> _Alive:
        empty = np.zeros((0, 2), np.float32)
        return _Alive(np.zeros(0, np.int64), empty, np.zeros(0, np.int64), empty)

    def where(self, keep: NDArray[np.bool_]) -> _Alive:
        return _Alive(self.ids[keep], self.xy[keep], self.origin[keep], self.origin_xy[keep])


@dataclass
class _Follower:
    settings: CornerSettings
    shape: tuple[int, ...]
    alive: _Alive = field(default_factory=_Alive.none)
    pictures: dict[int, Gray] = field(default_factory=dict)
    """First pictures of the corners alive, and the last tracked one."""
    smooth: dict[int, Gray] = field(default_factory=dict)
    """Some of them `smoothed`."""
    last: int = -1
    """Position of the last tracked frame."""
    ids: list[Ints] = field(default_factory=list)
    xy: list[Floats] = field(default_factory=list)
    keyframes: list[int] = field(default_factory=list)
    runs: list[int] = field(default_factory=list)
    flows: list[float] = field(default_factory=list)
    at_keyframe: _Alive = field(default_factory=_Alive.none)
    """Corners in the last keyframe."""
    next_id: int = 0
    run: int = -1
    unrefined: int = 0
    """Frames since the last one in which positions were refined."""
    _moved: float = float("nan")
    """Median motion of the corners to the last frame, by the longer side; NaN where unknown,"""
    motion: Floats = field(default_factory=lambda: np.zeros(2, np.float32))
    """and along both axes, px."""

    def __post_init__(self) -> None:
        self.shrink = shrinkage(self.shape, self.settings.width)
        self.longer = max(self.shape) * self.shrink

    def follow(self, gray: Gray) -> bool:
        """Track the corners into a frame; False, and nothing changed, when nearly all of them are lost."""
        before, small = len(self.alive.ids), shrunk(gray, self.shrink)
        if not before:
            return False
        found = self._flowed(small)
        due = self.unrefined + 1 >= self.settings.refined_every or self._moved_enough(found)
        if due:
            found = self._refined(found, small)
        if len(found.ids) < max(self.settings.least_survival * before, self.settings.least_corners / 2):
            return False
        moved = found.xy - self.alive.xy[np.searchsorted(self.alive.ids, found.ids)]
        self._moved = float(np.median(np.linalg.norm(moved, axis=1))) / self.longer
        self.motion = np.median(moved, axis=0)
        self.alive, self.unrefined = found, 0 if due else self.unrefined + 1
        return True

    def note(self, skipped: int, gray: Gray) -> None:
        """Record the frame in which the corners were found, and those skipped before it."""
        for _ in range(skipped):
            self._append(_Alive.none(), float("nan"))
        position = len(self.ids)
        self._keep(shrunk(gray, self.shrink), position)
        if self._moved_enough(self.alive):
            self._take_up(self.pictures[position], position)
        self._append(self.alive, self._moved)

    def start(self, gray: Gray) -> None:
        """Begin a new run of tracks in a frame; it stays without corners where there are too few."""
        position = len(self.ids)
        if len(self.alive.ids) and self.last not in self.keyframes:
            self.keyframes.append(self.last)
        self.alive, self.at_keyframe, self._moved = _Alive.none(), _Alive.none(), float("nan")
        self._keep(shrunk(gray, self.shrink), position)
        self._take_up(self.pictures[position], position)
        self._append(self.alive, float("nan"))

    def _keep(self, gray: Gray, position: int) -> None:
        wanted = set(np.unique(self.alive.origin).tolist())
        self.pictures = {k: picture for k, picture in self.pictures.items() if k in wanted}
        self.smooth = {k: picture for k, picture in self.smooth.items() if k in wanted}
        self.pictures[position], self.last = gray, position

    def _append(self, seen: _Alive, flow: float) -> None:
        self.ids.append(seen.ids)
        self.xy.append(((seen.xy + 0.5) / self.shrink - 0.5).astype(np.float32))
        self.runs.append(self.run if len(seen.ids) else -1)
        self.flows.append(flow)

    def tracks(self) -> CornerTracks:
        """All tracks. The last frame of each run is a keyframe."""
        run = np.array(self.runs, np.int64)
        ends = {int(np.flatnonzero(run == r)[-1]) for r in np.unique(run[run >= 0])}
        keyframes = tuple(sorted(ends | set(self.keyframes)))
        return CornerTracks(tuple(self.ids), tuple(self.xy), keyframes, run, np.array(self.flows, np.float32))

    def _flowed(self, gray: Gray) -> _Alive:
        """Return the corners of the last frame where they are found in this one, and back."""
        s, alive = self.settings, self.alive
        before = as_bright(self.pictures[self.last], gray, s.least_brightening)
        if self._moved <= s.near_flow:
            near = self._sought(before, gray, alive.xy + self.motion, s.near_levels)
            if len(near.ids) >= s.least_near * len(alive.ids):
                return near
        return self._sought(before, gray, alive.xy, s.levels)

    def _sought(self, before: Gray, gray: Gray, start: Floats, levels: int) -> _Alive:
        """Return the corners where they are found from a `start` (N, 2), and back."""
        s, alive, size = self.settings, self.alive, (self.settings.window_px, self.settings.window_px)
        xy, found, _ = cv2.calcOpticalFlowPyrLK(
            before, gray, alive.xy, start.copy(), winSize=size, maxLevel=levels, criteria=_CRITERIA,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            gray, before, xy, alive.xy.copy(), winSize=size, maxLevel=0, criteria=_CRITERIA,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        good = (found.ravel() > 0) & (returned.ravel() > 0)
        good &= np.linalg.norm(back - alive.xy, axis=1) < s.most_back_px
        place = np.asarray(xy, np.float32)
        return _Alive(alive.ids, place, alive.origin, alive.origin_xy).where(good & _inside(place, gray))

    def _refined(self, found: _Alive, gray: Gray) -> _Alive:
        """Return the corners at the best match with their first observation, without bad matches."""
        s, xy, smooth = self.settings, found.xy.copy(), smoothed(gray)
        good, size = np.ones(len(xy), bool), (s.window_px, s.window_px)
        for origin in np.unique(found.origin).tolist():
            if origin == self.last:
                continue
            if origin not in self.smooth:
                self.smooth[origin] = smoothed(self.pictures[origin])
            mine = np.flatnonzero(found.origin == origin)
            some = mine[:: max(1, len(mine) // s.brightness_samples)]
            values = values_at(self.smooth[origin], found.origin_xy[some]), values_at(smooth, found.xy[some])
            first = as_bright(self.pictures[origin], gray, s.least_brightening, values)
            place, seen, difference = cv2.calcOpticalFlowPyrLK(
                first, gray, found.origin_xy[mine], found.xy[mine], winSize=size, maxLevel=0, criteria=_CRITERIA,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            )  # fmt: skip
            near = np.linalg.norm(place - found.xy[mine], axis=1) < s.most_creep_px
            xy[mine], good[mine] = place, (seen.ravel() > 0) & near & (difference.ravel() < s.most_difference)
        return _Alive(found.ids, xy, found.origin, found.origin_xy).where(good & _inside(xy, gray))

    def _moved_enough(self, now: _Alive) -> bool:
        """Return whether the corners are so far from the last keyframe, or so few, that one is due."""
        old = self.at_keyframe
        _, here, there = np.intersect1d(now.ids, old.ids, assume_unique=True, return_indices=True)
        if len(here) < self.settings.keyframe_survival * len(old.ids):
            return True
        moved = np.linalg.norm(now.xy[here] - old.xy[there], axis=1)
        return bool(np.median(moved) > self.settings.keyframe_flow * self.longer)

    def _take_up(self, gray: Gray, position: int) -> None:
        """Make the frame a keyframe: add corners where none are tracked."""
        s, alive = self.settings, self.alive
        gap = max(3.0, s.spacing * self.longer)
        strength = cv2.cornerMinEigenVal(gray, 3, ksize=3)
        free = np.full(gray.shape, 255, np.uint8)
        rim = s.window_px // 2
        free[:rim], free[-rim:], free[:, :rim], free[:, -rim:] = 0, 0, 0, 0
        for x, y in alive.xy:
            cv2.circle(free, (round(float(x)), round(float(y))), round(gap), 0, -1)
        free[strength < s.least_strength] = 0
        wanted = s.corners - len(alive.ids)
        found = cv2.goodFeaturesToTrack(gray, wanted, s.quality, gap, mask=free) if wanted > 0 else None
        if found is not None:
            fresh = found.reshape(-1, 2).astype(np.float32)
            fresh = np.asarray(cv2.cornerSubPix(gray, fresh, (3, 3), (-1, -1), (3, 10, 0.03)), np.float32)
            ids = np.arange(self.next_id, self.next_id + len(fresh))
            self.next_id += len(fresh)
            origin = np.full(len(fresh), position, np.int64)
            self.alive = _Alive(
                np.concatenate([alive.ids, ids]),
                np.concatenate([alive.xy, fresh]),
                np.concatenate([alive.origin, origin]),
                np.concatenate([alive.origin_xy, fresh]),
            )
        if len(self.alive.ids) < s.least_corners:
            self.alive, self.at_keyframe = _Alive.none(), _Alive.none()
            return
        if not len(alive.ids):
            self.run += 1
        self.keyframes.append(position)
        self.at_keyframe = self.alive
