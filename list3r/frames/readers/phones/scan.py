"""Folders of apps with ARKit: stored pictures, each with a camera, depth in millimetres, confidence 0 to 2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from list3r.frames.base import Camera
from list3r.frames.layout import VARIES, FolderLayout, Optics, varies_note
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions, check_intrinsics
from list3r.memory.core.errors import OptionError, SourceError

LEAST_CONFIDENCE = 1
"""Depth of confidence 0 is unknown (stored 0, 1, 2 or 0, 127, 255)."""


def there(path: Path) -> Path | None:
    """Return the path of a file that is there, else None."""
    return path if path.is_file() else None


def scan_layout(
    kind: str,
    files: Sequence[FrameFile],
    cameras: Sequence[Sequence[float] | None],
    where: Path,
    options: SourceOptions,
    note: str,
) -> FolderLayout:
    """Return the layout of frames with their cameras, fx, fy, cx, cy, and width and height where they are stated.

    Where their focal lengths differ, each frame has its own. Raises `SourceError`, naming where cameras are, for none.
    """
    known = np.array([row for row in cameras if row is not None])
    if not len(known) and options.intrinsics is None:
        raise SourceError(f"{where} states the camera of no picture; is the copy complete? Or give --intrinsics")
    intrinsics, size = options.intrinsics, None
    varies: tuple[str, ...] = ()
    if intrinsics is None:
        usual = np.median(known, axis=0).tolist()
        spread, sized = float(np.ptp(known[:, 0]) / max(usual[0], 1e-9)), len(usual) == 6
        try:
            intrinsics = check_intrinsics(usual[:4])
            if spread > VARIES and sized:
                files = [replace(f, lens=_camera(row)) for f, row in zip(files, cameras, strict=True)]
        except (OptionError, ValueError) as error:
            raise SourceError(f"{where}: {error}") from None
        size = (round(usual[5]), round(usual[4])) if sized else None
        varies = (varies_note(spread, carried=sized),) if spread > VARIES else ()
    return FolderLayout(
        kind,
        FrameFiles(files),
        Optics(intrinsics, depth_scale=1000.0, intrinsics_size=size, shares_view=True),
        registered_intrinsics=intrinsics,
        notes=(note, *varies),
        least_confidence=LEAST_CONFIDENCE,
        z_up=True,
        upright_tags=False,
    )


def _camera(stated: Sequence[float] | None) -> Camera | None:
    if stated is None:
        return None
    return Camera(round(stated[4]), round(stated[5]), *check_intrinsics(stated[:4]))
