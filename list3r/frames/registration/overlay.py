"""Pictures that show whether depth and colour belong together: depth edges drawn over the colour image."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame, FrameSource
from list3r.frames.registration.edges import depth_edges
from list3r.memory.core.errors import ExportError, SourceError

_RED = (230, 20, 20)


def draw_overlay(frame: Frame) -> NDArray[np.uint8]:
    """Return the colour image with the near sides of depth steps in red, beside the depth in colours.

    Shape (H, 2W, 3).
    """
    if frame.depth is None:
        raise SourceError("the source has no depth to draw over its colour images")
    edges = depth_edges(frame.depth)
    marked = frame.color.copy()
    marked[edges.y, edges.x] = _RED
    known = frame.depth[frame.depth > 0]
    far = float(np.quantile(known, 0.98)) if known.size else 1.0
    shades = np.clip(frame.depth * (255.0 / far), 0, 255).astype(np.uint8)
    tinted = cv2.cvtColor(cv2.applyColorMap(shades, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    tinted[frame.depth == 0] = 0
    return np.concatenate([marked, np.asarray(tinted, dtype=np.uint8)], axis=1)


def draw_registration(source: FrameSource, path: str | Path, count: int = 4) -> list[int]:
    """Write overlays of `count` frames spread over the source into one PNG; the frames' numbers come back.

    Raises `SourceError` when there is no depth, `ExportError` when the file cannot be written.
    """
    total = source.info.frame_count
    if not source.info.has_depth:
        raise SourceError(f"{source.info.path} has no depth to draw over its colour images")
    positions = sorted({int(p) for p in np.linspace(0, total - 1, count + 2)[1:-1]}) or [0]
    frames = [f for p in positions for f in source.read(p, p + 1) if isinstance(f, Frame)]
    if not frames:
        raise SourceError(f"{source.info.path}: none of frames {positions} can be decoded")
    sheet = np.concatenate([draw_overlay(f) for f in frames], axis=0)
    good, data = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    try:
        assert good
        Path(path).write_bytes(data.tobytes())
    except OSError as error:
        raise ExportError(f"{path} cannot be written ({error.strerror}); name a file in a folder that exists") from None
    return [f.index for f in frames]
