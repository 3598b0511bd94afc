"""Axes of cameras and worlds as recorders state them, brought to ours: cameras as OpenCV's, worlds with z up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a camera with x right, y up, z back (OpenGL, ARKit) to x right, y down, z forward, and back. Shape (4, 4)."""
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From a world with y up to one with z up, by a quarter turn about x. Shape (4, 4)."""

CLOCKWISE = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""The camera of a picture turned clockwise by a quarter, in the camera of the picture. Shape (4, 4)."""
_LEAST_UPRIGHT = 0.4
"""Least z of the cameras' mean up, where z is up: people film level or look down at most by some 60 degrees."""


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


def quarter_turns(T_world_cam: Sequence[Array]) -> int:
    """Return how many clockwise quarter turns put the pictures upright, on average, in a world with z up."""
    return int(np.argmax(_mean_up(T_world_cam)))


def turns_in_gravity(T_world_cam: Sequence[Array]) -> int | None:
    """Return the quarter turns of `quarter_turns` where z can be up: the pictures stand on one of their sides.

    None where they stand on none of them on average, or there are no poses: then z of the poses' world is not up. Nor
    is it where pictures would not stand upright, but do so by y and more plainly.
    """
    up = _mean_up(T_world_cam)
    turns = int(np.argmax(up))
    by_y = abs(float(np.mean([T[1, 1] for T in T_world_cam]))) if turns else 0.0
    return turns if up[turns] > max(_LEAST_UPRIGHT, by_y) else None


def _mean_up(T_world_cam: Sequence[Array]) -> Array:
    """Mean z of the way up in the pictures, turned clockwise by 0, 1, 2 and 3 quarters. Shape (4,)."""
    if not len(T_world_cam):
        return np.zeros(4)
    right_z, down_z = np.mean([T[2, :2] for T in T_world_cam], axis=0)
    return np.array([-down_z, -right_z, down_z, right_z])


def lying_note(turns: int) -> tuple[str, ...]:
    """Return what is said of pictures that do not stand upright, for people; nothing of those that do."""
    how = ("", "lie on their side", "stand on their head", "lie on their side")[turns]
    return (f"the pictures {how}, as the phone was held; up and down are those of its gravity",) if turns else ()
