"""pycolmap, kept quiet, and our cameras and poses in its terms.

Loading it assigns the termination signal to its logger, which prints a native stack.
"""

from __future__ import annotations

import signal
import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera

_ended_by = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

__all__ = ["inverse", "make_lens", "matrix_of", "pixel_unit", "pycolmap", "rigid_of"]

if _ended_by is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _ended_by)
pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value


def make_lens(camera: Camera, free_camera: str = "") -> Any:
    """pycolmap's camera, pixels from the corner of the upper left one; `free_camera` as for `build_maps`."""
    c = camera
    if free_camera:
        model, params = "SIMPLE_RADIAL", [0.5 * (c.fx + c.fy), c.cx + 0.5, c.cy + 0.5, 0.0]
    else:
        model, params = "PINHOLE", [c.fx, c.fy, c.cx + 0.5, c.cy + 0.5]
    lens = pycolmap.Camera(model=model, width=c.width, height=c.height, params=params)
    lens.has_prior_focal_length = free_camera != "focal"
    return lens


def pixel_unit(camera: Camera) -> float:
    """Px of this camera that are one px of a picture 640 wide."""
    return max(camera.width, camera.height) / 640.0


def matrix_of(rigid: Any) -> NDArray[np.float64]:
    """Return the pose of a `Rigid3d`. Shape (4, 4)."""
    T = np.eye(4)
    T[:3] = rigid.matrix()
    return T


def rigid_of(T: NDArray[np.float64]) -> Any:
    """Return a pose (4, 4) as a `Rigid3d`."""
    return pycolmap.Rigid3d(T[:3].copy())


def inverse(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a pose (4, 4)."""
    return np.asarray(np.linalg.inv(T), np.float64)
