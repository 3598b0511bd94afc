"""A quick look at how much of a source can be used: some frames, spread over all of it, are read as a build does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from list3r.frames.base import BadFrame, Frame, FrameSource

_SPOTS = 24
"""Places of a source that are looked at."""


def unusable(source: FrameSource) -> tuple[str, ...]:
    """Return what is said of frames that cannot be used, as far as a quick look tells; nothing where none was found.

    A video is decoded for some frames from each of its places, another source is read at each of them.
    """
    own = getattr(source, "look", None)
    looked = sorted(_read(source) if own is None else own(_SPOTS))
    bad = [(number, reason) for number, reason in looked if reason]
    if not bad:
        return ()
    number, reason = bad[0]
    some = "frames" if len(looked) == source.info.frame_count else "frames looked at"
    where = f"the first is frame {number} ({reason})"
    sound = max((k for k, (_, reason) in enumerate(looked) if not reason), default=-1)
    if bad[1:] and looked[sound + 1 :] == bad:
        where = f"all of these from frame {number} on ({reason})"
    elif len(looked) - sound > 2:
        where += f", and all of these from frame {looked[sound + 1][0]} on"
    return (f"{len(bad)} of {len(looked)} {some} cannot be used: {where}",)


def outcomes(frames: Iterable[Frame | BadFrame]) -> Iterator[tuple[int, str]]:
    """Yield the number of each frame and why it cannot be used, empty where it can."""
    for frame in frames:
        yield frame.index, frame.reason if isinstance(frame, BadFrame) else ""


def _read(source: FrameSource) -> Iterator[tuple[int, str]]:
    """Look at frames at steps that are not even, which miss no pattern."""
    places = np.linspace(0, 1, min(_SPOTS, source.info.frame_count))
    bent = places if len(places) < _SPOTS else places**1.1
    for position in np.unique((bent * (source.info.frame_count - 1)).round().astype(int)).tolist():
        yield from outcomes(source.read(position, position + 1))
