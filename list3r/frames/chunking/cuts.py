"""Shot cuts: where a video jumps to another place, so that no chunk spans a jump.

A false cut tears a video apart that one camera walk holds together; a missed one only costs the frames behind it in one
chunk. So a frame is suspected cheaply, by a thumbnail that is far less like the one before than frames
around are to each other, and believed only when local features on either side know nothing of each other.
One spoilt frame (black, flash, blur) is looked past.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import FrameSource
from list3r.frames.sift import nearest_pairs, root_sift, sift

Floats = NDArray[np.float32]
Gray = NDArray[np.uint8]


@dataclass(frozen=True)
class ShotCutSettings:
    """When a jump is believed."""

    window: int = 12
    """Frames to either side whose likeness is what is usual there."""
    look_past: int = 3
    """Spoilt frames in a row (black, flash, blur) that make no cut."""
    least_shot: int = 5
    """Frames between two cuts; what is shorter is a flash and stays in one of its neighbours' shots."""
    factor: float = 3.0
    """A suspect is this many times less like the frame before than is usual around it."""
    thumbnail_likeness: float = 0.9
    """Correlation, best over small shifts, from which thumbnails are alike whatever is usual: of consecutive frames of
    hand-held video at 3 to 30 a second 99 in 100 are above, of frames of different places 1 in 100."""
    features: int = 500
    """Local features on a frame where a suspect is looked at."""
    least_features: int = 60
    """A frame with fewer (a plain wall, darkness, blur) says nothing."""
    least_agreeing: int = 14
    """Matches that agree on one epipolar geometry or homography: from this many on two frames see the same. Unrelated
    frames give up to 12 by chance."""
    agreeing_share: float = 0.12
    """The same as a share of the matches that agree between neighbours on either side, if that is more."""


Progress = Callable[[int, int], None]
"""Called with (frames looked at, frames in all)."""


def find_cuts(
    source: FrameSource, settings: ShotCutSettings | None = None, progress: Progress | None = None
) -> tuple[int, ...]:
    """Positions of `source` before which the video jumps, ascending.

    Reads every frame once, small where the source can (0.6 ms a JPEG of 640 x 480), and the few
    around a suspect again; what it keeps does not grow with the video but by some bytes a frame. The same source gives
    the same cuts. A bad frame is passed over: the next is compared with the last good one.
    """
    chosen = settings or ShotCutSettings()
    count = source.info.frame_count
    likeness = np.ones(count)  # of every frame to the one before it
    around: dict[int, Gray] = {}
    looks = _Looks(source, chosen)
    cuts: list[int] = []

    def alike(a: int, b: int) -> bool:
        one, two = around.get(a), around.get(b)
        if one is None or two is None:
            return False
        return _thumbnail_likeness(one, two) >= chosen.thumbnail_likeness or looks.same_place(a, b)

    def judge(k: int) -> None:
        if k >= 0 and suspected(likeness, k, chosen.thumbnail_likeness, chosen) and jumps(k, count, alike, chosen):
            cuts.append(k)

    reach = max(chosen.look_past, chosen.least_shot) + 1
    delay = max(chosen.window, reach)
    last: Gray | None = None
    for k, thumbnail in enumerate(map(_small, source.thumbnails())):
        if thumbnail is not None:
            likeness[k] = 1.0 if last is None else _thumbnail_likeness(last, thumbnail)
            around[k] = last = thumbnail
        judge(k - delay)
        old = k - delay - reach - 1
        if not cuts or old - cuts[-1] > reach:
            around.pop(old, None)
        if progress is not None:
            progress(k + 1, count)
    for k in range(count - delay, count):
        judge(k)
    return spaced(cuts, alike, chosen)


Alike = Callable[[int, int], bool]


def suspected(likeness: NDArray[np.float64], k: int, enough: float, settings: ShotCutSettings) -> bool:
    """Return whether a frame is far less like the one before than is usual around it.

    1 is alike, of F frames the first is.
    """
    if likeness[k] >= enough:
        return False
    around = 1.0 - likeness[max(1, k - settings.window) : k + settings.window + 1]
    return bool(1.0 - likeness[k] > settings.factor * float(np.median(around)))


def jumps(cut: int, count: int, alike: Alike, settings: ShotCutSettings) -> bool:
    """True when nothing just before the cut is like anything just after it, looking past spoilt frames on one side."""
    after = ((cut - 1, cut + k) for k in range(settings.look_past + 1) if cut + k < count)
    before = ((cut - k, cut) for k in range(2, settings.look_past + 2) if cut - k >= 0)
    return not any(alike(a, b) for a, b in (*after, *before))


def spaced(cuts: Sequence[int], alike: Alike, settings: ShotCutSettings) -> tuple[int, ...]:
    """Cuts with no shot between them that is too short to be one: the frames of a flash belong to neither side."""
    out: list[int] = []
    for cut in cuts:
        if out and cut - out[-1] < settings.least_shot:
            first = out.pop()
            if not alike(first - 1, cut):
                out.append(cut)
        else:
            out.append(cut)
    return tuple(out)


# ---------------------------------------------------------------------------------------------- pictures


def _small(gray: Gray | None) -> Gray | None:
    if gray is None:
        return None
    height, width = gray.shape
    size = (48, 36) if width >= height else (36, 48)
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def _thumbnail_likeness(a: Gray | None, b: Gray | None) -> float:
    """Correlation of the middle of each with the best place in the other: blind to exposure, patient with turning.

    A picture without contrast is like anything: it says nothing.
    """
    assert a is not None and b is not None
    if a.shape != b.shape:
        return 0.0
    best = 0.0
    for one, two in ((a, b), (b, a)):
        height, width = one.shape
        middle = one[height // 4 : -(height // 4), width // 4 : -(width // 4)]
        if middle.std() < 2.0:
            return 1.0
        scores = cv2.matchTemplate(two, np.ascontiguousarray(middle), cv2.TM_CCOEFF_NORMED)
        best = max(best, float(scores[np.isfinite(scores)].max(initial=0.0)))
    return best


_AHEAD = 5
"""Frames to either side that are decoded with one that is looked at."""
_KEPT = 64
"""Frames whose local features are kept: suspects are looked at in order, so older ones are not asked for again."""


class _Looks:
    """Local features of the few frames round suspects."""

    def __init__(self, source: FrameSource, settings: ShotCutSettings) -> None:
        self._source, self._settings = source, settings
        self._count = source.info.frame_count
        self._known: dict[int, tuple[Floats, Floats]] = {}
        self._grays: dict[int, Gray | None] = {}
        self._agreeing: dict[tuple[int, int], int] = {}

    def same_place(self, a: int, b: int) -> bool:
        """Return True unless both frames have something to say and agree on nothing."""
        if min(len(self._features(k)[0]) for k in (a, b)) < self._settings.least_features:
            return True
        usual = min(self.agreeing(a - 1, a) if a > 0 else 0, self.agreeing(b, b + 1) if b + 1 < self._count else 0)
        return self.agreeing(a, b) >= max(self._settings.least_agreeing, self._settings.agreeing_share * usual)

    def agreeing(self, a: int, b: int) -> int:
        """Matches that agree on one epipolar geometry, or on one homography where all is flat or far."""
        if (a, b) not in self._agreeing:
            self._agreeing[a, b] = self._match(a, b)
        return self._agreeing[a, b]

    def _match(self, a: int, b: int) -> int:
        (xy_a, d_a), (xy_b, d_b) = self._features(a), self._features(b)
        rows = nearest_pairs(d_a, d_b)
        if len(rows) < 8:
            return 0
        p, q = xy_a[rows[:, 0]], xy_b[rows[:, 1]]
        found = (
            cv2.findFundamentalMat(p, q, cv2.FM_RANSAC, 1.5, 0.999, 2000)[1],
            cv2.findHomography(p, q, cv2.RANSAC, 3.0, maxIters=2000)[1],
        )
        return max(0 if inside is None else int(inside.sum()) for inside in found)

    def _features(self, position: int) -> tuple[Floats, Floats]:
        """Positions (N, 2), px, and RootSIFT descriptors (N, 128)."""
        if position not in self._known:
            while len(self._known) >= _KEPT:
                del self._known[next(iter(self._known))]
            gray = self._gray(position)
            xy, found = sift(np.zeros((1, 1), np.uint8) if gray is None else gray, self._settings.features)
            self._known[position] = xy, root_sift(found)
        return self._known[position]

    def _gray(self, position: int) -> Gray | None:
        if position not in self._grays:
            # A video decodes from a key frame on, so the neighbours that will be asked for next come with it.
            first, last = max(0, position - _AHEAD), min(self._count, position + _AHEAD)
            grays = self._source.read_grays(first, max(last, position + 1))
            self._grays = dict(enumerate(grays, first))
        return self._grays.get(position)
