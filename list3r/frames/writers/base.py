"""What every writer of a sequence does: frames come one by one, what is said of all of them comes last."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame

JPEG_QUALITY = 95


class SequenceWriter(ABC):
    """Writes one sequence of a camera without distortion into an empty folder that exists."""

    depth: ClassVar[bool] = True
    """Whether the layout holds depth."""
    unposed: ClassVar[bool] = True
    """Whether it holds frames without a pose."""
    most_depth_m: ClassVar[float] = float("inf")
    """Depth beyond this does not fit into its numbers, metres."""

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        """Raises `OptionError` for a missing package."""
        self._folder, self._camera, self._fps = folder, camera, fps

    @abstractmethod
    def add(self, frame: Frame) -> None:
        """Write a frame."""

    @abstractmethod
    def close(self) -> None:
        """Write what is said of all frames: lists, cameras and poses."""

    def put(self, name: str, data: bytes | str) -> None:
        """Write a file, its folder made if absent."""
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.encode() if isinstance(data, str) else data)


def numbers(values: NDArray[Any]) -> str:
    """Return numbers with spaces between."""
    return " ".join(f"{v:.9g}" for v in np.ravel(values))


def jpeg(color: NDArray[np.uint8]) -> bytes:
    """Return an RGB picture (H, W, 3) as JPEG."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done
    return data.tobytes()


def png16(depth: NDArray[np.float32], units_per_m: float) -> bytes:
    """Return depth (H, W), metres, as PNG of 16 bits; what does not fit is unknown."""
    stored = np.rint(depth * units_per_m)
    stored[(stored < 0) | (stored > np.iinfo(np.uint16).max)] = 0
    done, data = cv2.imencode(".png", stored.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert done
    return data.tobytes()
