"""Axes of cameras and worlds as recorders state them, brought to ours: cameras as OpenCV's, worlds with z up."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a camera with x right, y up, z back (OpenGL, ARKit) to x right, y down, z forward, and back. Shape (4, 4)."""
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From a world with y up to one with z up, by a quarter turn about x. Shape (4, 4)."""


def pose_of_arkit(T_world_arkit: Array) -> Array:
    """Return the pose of an OpenCV camera in a world with z up, of one with ARKit's axes in a world with y up.

    Shape (4, 4).
    """
    return np.asarray(Z_UP_FROM_Y_UP @ T_world_arkit @ OPENGL_TO_OPENCV)


def arkit_of_pose(T_world_cam: Array) -> Array:
    """Return the pose as ARKit has it, the inverse of `pose_of_arkit`. Shape (4, 4)."""
    return np.asarray(Z_UP_FROM_Y_UP.T @ T_world_cam @ OPENGL_TO_OPENCV)


def pose_of_quaternion(translation_m: ArrayLike, quat_xyzw: ArrayLike) -> Array | None:
    """Return the pose of a translation and a quaternion, None where they are not finite or the quaternion no rotation.

    Shapes (3,), (4,) -> (4, 4).
    """
    t, q = np.asarray(translation_m, np.float64), np.asarray(quat_xyzw, np.float64)
    if not (np.isfinite(t).all() and np.isfinite(q).all()) or abs(np.linalg.norm(q) - 1.0) > 0.05:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(q).as_matrix(), t
    return T
