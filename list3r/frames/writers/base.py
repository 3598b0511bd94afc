"""What every writer of a sequence does: frames come one by one, what is said of all of them comes last."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame

Pose = NDArray[np.float64]


class SequenceWriter(Protocol):
    """Writes one sequence; `close` writes what is said of all frames."""

    def add(self, frame: Frame) -> None:
        """Write a frame."""
        ...

    def close(self) -> None:
        """Write the lists, the cameras and the poses."""
        ...


class MakeWriter(Protocol):
    """Begins a sequence in an empty folder that exists."""

    def __call__(self, folder: Path, camera: Camera, fps: float) -> SequenceWriter:
        """Return the writer of pictures of a camera without distortion. Raises `OptionError` for a missing package."""
        ...


def put(path: Path, data: bytes | str) -> None:
    """Write a file, its folder made if absent."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def numbers(values: NDArray[Any], digits: int = 9) -> str:
    """Return numbers with spaces between."""
    return " ".join(f"{v:.{digits}g}" for v in np.ravel(values))
