"""How fast the picture of a video moves, and so from every how many of its frames depth is worth computing.

Frames of a camera that moves slowly show the same from the same place: depth from two of them is poor, and a chunk of
them sees things from too few sides (research/colour-video 0067).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame, FrameSource

Gray = NDArray[np.uint8]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PaceSettings:
    """From how many frames depth is computed."""

    flow: float = 0.03
    """About how far the picture moves, by its longer side, between frames that get depth: less than the 0.04 of the
    simulated walks on which depth and discovery were made."""
    quantile: float = 0.75
    """Of the places that are looked at, this share moves no faster."""
    spots: int = 16
    """Places of a video that are looked at."""
    least_spots: int = 4
    """Fewest of them that must show something."""
    most: int = 4
    """Largest step."""
    most_mb: float = 400.0
    """Pictures of a chunk take no more than this."""
    width_px: int = 320
    """Size of the pictures that are compared."""


def depth_step(
    source: FrameSource, length: int, settings: PaceSettings | None = None, *, progress: Progress | None = None
) -> int:
    """From every how many frames depth is computed in chunks that hold `length` frames with depth; 1 is from all.

    `progress` hears of the places looked at, done and in all.
    """
    s = settings or PaceSettings()
    height, width = source.info.image_size or (480, 640)
    room = s.most_mb * 2**20 / (3.0 * height * width * length)
    most = int(min(s.most, source.info.frame_count // length, room))
    if most < 2:
        return 1
    flows = picture_flows(source, s, progress)
    if len(flows) < s.least_spots:
        return 1
    return int(np.clip(np.rint(s.flow / max(float(np.quantile(flows, s.quantile)), 1e-6)), 1, most))


def picture_flows(source: FrameSource, settings: PaceSettings, progress: Progress | None = None) -> NDArray[np.float64]:
    """How far corners move from a frame to the next, median by the picture's longer side, at places spread over a video
    at which corners are found again. Shape (N,)."""
    flows = []
    starts = np.linspace(0, source.info.frame_count - 2, settings.spots).astype(int).tolist()
    for done, start in enumerate(starts, start=1):
        pair = [f for f in source.read(start, start + 2) if isinstance(f, Frame)]
        if len(pair) == 2:
            a, b = (f.gray(settings.width_px) for f in pair)
            flow = _flow(a, b)
            flows += [] if flow is None else [flow / max(a.shape)]
        if progress is not None:
            progress(done, len(starts))
    return np.array(flows)


def _flow(a: Gray, b: Gray, corners: int = 200, least: int = 12) -> float | None:
    """Median way of corners from one picture to the other, px; None where too few are found there and back."""
    found = cv2.goodFeaturesToTrack(a, corners, 0.01, 6)
    if found is None:
        return None
    there, seen, _ = cv2.calcOpticalFlowPyrLK(a, b, found, np.zeros_like(found), winSize=(15, 15), maxLevel=4)
    back, again, _ = cv2.calcOpticalFlowPyrLK(b, a, there, np.zeros_like(found), winSize=(15, 15), maxLevel=4)
    good = (seen.ravel() > 0) & (again.ravel() > 0)
    good &= np.linalg.norm((np.asarray(back) - found).reshape(-1, 2), axis=1) < 1.0
    if good.sum() < least:
        return None
    return float(np.median(np.linalg.norm((np.asarray(there) - found).reshape(-1, 2)[good], axis=1)))
