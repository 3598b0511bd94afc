"""Frames whose pictures are read when they are first looked at: of a slow video most never are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource


class LazyFrame(Frame):
    """A frame whose colour and depth are read when one of them is first asked for.

    One that then cannot be decoded is black and has no depth.
    """

    def __init__(
        self,
        index: int,
        time_s: float,
        T_source_cam: NDArray[np.float64] | None,
        read: Callable[[], Frame | BadFrame],
    ) -> None:
        self.__dict__.update(index=index, time_s=time_s, T_source_cam=T_source_cam, _read=read)

    def __getattr__(self, name: str) -> Any:
        if name not in ("color", "depth"):
            raise AttributeError(name)
        frame = self.__dict__["_read"]()
        if isinstance(frame, BadFrame):
            frame = Frame(self.index, self.time_s, np.zeros((1, 1, 3), np.uint8), None, None)
        self.__dict__.update(color=frame.color, depth=frame.depth)
        return self.__dict__[name]

    def let_go(self) -> None:
        """Forget the picture, which is read again where it is asked for again."""
        for name in ("color", "depth"):
            self.__dict__.pop(name, None)


def read_some(source: FrameSource, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
    """Frames at positions [start, stop) in order, those at multiples of `step` read now and the others later.

    A source without a way of its own decodes all once, of which those others are let go.
    """
    own = getattr(source, "read_some", None)
    if own is not None:
        yield from own(start, stop, step)
        return
    for position, frame in enumerate(source.read(start, stop), start):
        if position % step and isinstance(frame, Frame):
            frame = LazyFrame(frame.index, frame.time_s, frame.T_source_cam, partial(_read_one, source, position))
        yield frame


def _read_one(source: FrameSource, position: int) -> Frame | BadFrame:
    return next(iter(source.read(position, position + 1)))
