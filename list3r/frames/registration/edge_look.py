"""Whether depth belongs to its pictures: a cheap look at whether its steps fall on edges of colour.

As `calibrate` measures it, on a few small frames and without a search. Of depth that meets no edge it is tried whether
it is mirrored, or late.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame, FrameSource
from list3r.frames.registration.edge_fit import EdgeFit

_Pair = tuple[NDArray[np.uint8], NDArray[np.float32]]


@dataclass(frozen=True)
class EdgeLookSettings:
    """When depth is doubted. Of sound recordings edges meet 2 to 6 times as well as chance, unregistered 1.5 times, of
    mirrored depth and of depth half a second late 1.0 to 1.2 times."""

    frames: int = 8
    width: int = 320
    """Pictures are thinned to about this width, px."""
    blur_px: float = 2.0
    """Of colour edges, px of a 640 px wide image."""
    least_edges: int = 400
    least_frames: int = 3
    looked_into: float = 1.5
    """What could be the cause is tried where edges are met less than so many times as well as chance."""
    doubted: float = 1.25
    """Depth that is met so little is doubted, also where no cause is found."""
    better: float = 1.6
    """What is tried is named as the cause from this score on, and if it is so many times the other."""
    gain: float = 1.3
    step: int = 3
    steps: int = 10
    """Depth is looked for in frames up to so many steps of so many frames away."""


_TURNED: dict[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = {
    "it would fit if it were mirrored": lambda depth: depth[:, ::-1],
    "it would fit upside down": lambda depth: depth[::-1],
    "it would fit turned by 180 degrees": lambda depth: depth[::-1, ::-1],
}


def depth_doubts(source: FrameSource, settings: EdgeLookSettings | None = None) -> tuple[str, ...]:
    """Return a sentence on depth that does not belong to its pictures; nothing where it does, or shows no steps."""
    s, info = settings or EdgeLookSettings(), source.info
    if not info.has_depth:
        return ()
    places = np.unique(np.linspace(0, info.frame_count - 1, s.frames).astype(int)).tolist()
    frames = {k: f for k in places if (f := _frame(source, k)) is not None}
    found = _score([_pair(f, f, s) for f in frames.values()], s)
    if found is None or found >= s.looked_into:
        return ()
    tried = {how: [_pair(f, f, s, turn) for f in frames.values()] for how, turn in _TURNED.items()}
    for lag in (k * s.step for n in range(1, s.steps + 1) for k in (n, -n)):
        later = ((f, _frame(source, k + lag)) for k, f in [*frames.items()][::2] if 0 <= k + lag < info.frame_count)
        tried[_late(lag, info.fps)] = [_pair(f, other, s) for f, other in later if other is not None]
    scores = {how: score for how, pairs in tried.items() if (score := _score(pairs, s)) is not None}
    best = max(scores, key=lambda how: scores[how], default="")
    known = bool(best) and scores[best] >= max(s.better, s.gain * found)
    if not known and found >= s.doubted:
        return ()
    return (
        f"depth does not seem to belong to its pictures: its edges meet those of colour {found:.1f} times as well as "
        f"chance (2 and more in a sound recording)" + (f"; {best}" if known else "; see `list3r inspect --calibrate`"),
    )


def _late(lag: int, fps: float) -> str:
    return f"it would fit pictures about {abs(lag) / fps:.2g} s {'earlier' if lag > 0 else 'later'}"


def _frame(source: FrameSource, position: int) -> Frame | None:
    frame = next(iter(source.read(position, position + 1)), None)
    return frame if isinstance(frame, Frame) and frame.depth is not None else None


def _pair(
    color: Frame,
    depth: Frame,
    s: EdgeLookSettings,
    turn: Callable[[NDArray[np.float32]], NDArray[np.float32]] = lambda depth: depth,
) -> _Pair:
    """Colour of one frame and depth of one, thinned."""
    assert depth.depth is not None
    n = max(1, round(color.color.shape[1] / s.width))
    return color.color[::n, ::n].copy(), turn(depth.depth)[::n, ::n].copy()


def _score(pairs: list[_Pair], s: EdgeLookSettings) -> float | None:
    """How much better than chance edges are met, None where there are too few."""
    if len(pairs) < s.least_frames:
        return None
    height, width = pairs[0][0].shape[:2]
    camera = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
    fit = EdgeFit(pairs, camera, (camera.fx, camera.fy, camera.cx, camera.cy))
    return fit.score(fit.start(), s.blur_px) if fit.count >= s.least_edges else None
