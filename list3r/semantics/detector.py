"""The border of every box detector: a picture in, boxes with class and score out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Detections:
    """Boxes found in one picture."""

    boxes_xyxy: NDArray[np.float32]
    """Left, top, right, bottom, px of the picture. Shape (N, 4)."""
    scores: NDArray[np.float32]
    """In [0, 1]. Shape (N,)."""
    classes: NDArray[np.int64]
    """Numbers into the detector's `class_names`. Shape (N,)."""


class Detector(Protocol):
    """A network that finds things of named classes."""

    @property
    def name(self) -> str:
        """What stands behind a label as where it comes from."""
        ...

    @property
    def class_names(self) -> tuple[str, ...]:
        """What the classes are called."""
        ...

    def __call__(self, color: NDArray[np.uint8]) -> Detections:
        """Find things in an RGB picture. Shape (H, W, 3)."""
        ...
