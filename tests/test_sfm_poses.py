"""Poses of frames between keyframes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.poses import angle_deg, small_motion
from list3r.reconstruction.sfm.frame_poses import pose_of
from list3r.reconstruction.sfm.kernels import pose_equations
from list3r.reconstruction.sfm.settings import FramePoseSettings

CAMERA = Camera(640, 480, 520.0, 510.0, 318.0, 242.0)
LENS = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])


def scene(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A pose T_cam_map, points (200, 3) and where they are seen (200, 2), px."""
    rng = np.random.default_rng(seed)
    T = small_motion(rng.normal(0.0, 0.3, 6))
    seen = rng.uniform([-1.0, -0.8, 1.5], [1.0, 0.8, 4.0], (200, 3))
    points = (seen - T[:3, 3]) @ T[:3, :3]
    return T, points, seen[:, :2] / seen[:, 2:] * LENS[:2] + LENS[2:]


def error_px(T: NDArray[np.float64], points: NDArray[np.float64], px: NDArray[np.float64], scale: float) -> float:
    """Half the sum of Cauchy's kernel over the errors of all points, px squared."""
    seen = points @ T[:3, :3].T + T[:3, 3]
    off = seen[:, :2] / seen[:, 2:] * LENS[:2] + LENS[2:] - px
    return float(0.5 * scale**2 * np.log1p((off**2).sum(axis=1) / scale**2).sum())


def test_the_gradient_is_that_of_the_error_and_the_information_is_symmetric() -> None:
    T, points, px = scene(1)
    T, everything = small_motion(np.full(6, 0.002)) @ T, np.ones(len(points), bool)
    information, gradient = pose_equations(T, px, points, everything, LENS, 0.5)
    step = 1e-6
    for axis, expected in enumerate(gradient):
        ends = (small_motion(sign * step * np.eye(6)[axis]) @ T for sign in (1.0, -1.0))
        ahead, behind = (error_px(end, points, px, 0.5) for end in ends)
        assert (ahead - behind) / (2.0 * step) == pytest.approx(expected, rel=1e-4, abs=1e-3)
    assert np.array_equal(information, information.T) and np.linalg.eigvalsh(information).min() > 0.0


@pytest.mark.parametrize("seed", range(5))
def test_a_pose_is_found_though_a_fifth_of_the_points_are_seen_elsewhere(seed: int) -> None:
    T, points, px = scene(seed)
    wrong = np.arange(len(px)) % 5 == 0
    xy = (px + np.where(wrong[:, None], 60.0, 0.0)).astype(np.float32)
    start = np.linalg.inv(small_motion(np.full(6, 0.01)) @ T)
    found = pose_of(xy, points, CAMERA, start, FramePoseSettings())
    assert found is not None
    off = found[0] @ T
    assert np.linalg.norm(off[:3, 3]) < 1e-4 and angle_deg(off) < 0.01
    assert np.array_equal(found[1], ~wrong)


def test_points_behind_the_camera_tell_no_pose() -> None:
    T, points, px = scene(3)
    start = np.linalg.inv(small_motion(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0])) @ T)
    information, _ = pose_equations(np.linalg.inv(start), px, points, np.ones(len(points), bool), LENS, 0.5)
    assert not information.any()
