"""Depth moved between cameras: exact on planes, whole on surfaces, and nothing between surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera
from list3r.frames.decoding.decode import clean_depth
from list3r.frames.registration.reprojection import DepthReprojection, Undistortion
from list3r.reconstruction.base import backproject
from tests.frames_scenes import moved, paint

DEPTH = Camera(160, 120, 146.0, 146.0, 80.0, 60.0)
COLOR = Camera(160, 120, 131.0, 131.0, 80.0, 60.0)


def plane_depth(camera: Camera, normal: np.ndarray, offset: float) -> np.ndarray:
    """Depth of the plane normal . p = offset."""
    rays = backproject(np.ones((camera.height, camera.width), np.float32), camera)
    return (offset / (rays @ normal)).astype(np.float32)


@pytest.mark.parametrize(
    "color", [COLOR, Camera(320, 240, 262.0, 262.0, 160.0, 120.0), Camera(96, 72, 75.0, 80.0, 50.0, 35.0)]
)
def test_a_slanted_plane_stays_that_plane_without_holes(color: Camera) -> None:
    T = moved(-0.02, -0.005, 0.01)
    T[:3, :3] = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix()
    normal, offset = np.array([0.3, -0.2, 0.93]), 1.4
    out = DepthReprojection(DEPTH, color, T)(plane_depth(DEPTH, normal, offset))
    normal_color = T[:3, :3] @ normal
    expected = plane_depth(color, normal_color, offset + normal_color @ T[:3, 3])
    seen = out > 0
    inner = np.zeros_like(seen)
    inner[color.height // 4 : -color.height // 4, color.width // 4 : -color.width // 4] = True
    assert seen[inner].all()
    # Half a pixel of rounding on this slant.
    assert np.abs(out - expected)[seen].max() < 0.75 * 1.4 * 0.6 / min(DEPTH.fx, color.fx)


def test_the_same_camera_changes_nothing() -> None:
    depth = paint([(3.0, 0, 0, 9, 9, 1), (1.0, 0.1, 0.1, 0.2, 0.2, 1)], DEPTH, np.eye(4))[1]
    np.testing.assert_array_equal(DepthReprojection(DEPTH, DEPTH, np.eye(4))(depth), depth)


@pytest.mark.parametrize("color", [COLOR, Camera(320, 240, 262.0, 262.0, 160.0, 120.0)])
def test_near_hides_far_and_no_depth_lies_between(color: Camera) -> None:
    scene, T = [(3.0, 0, 0, 9, 9, 1), (1.0, 0, 0, 0.2, 0.2, 1)], moved(-0.03, 0.0, 0.0)
    out = DepthReprojection(DEPTH, color, T)(paint(scene, DEPTH, np.eye(4))[1])
    truth = paint(scene, color, T)[1]
    known = out > 0
    assert set(np.unique(out[known]).round(4)) == {1.0, 3.0}
    # Only a seam of the card's outline may differ; the shadow that the depth camera cannot see stays empty.
    wrong = known & (np.abs(out - truth) > 0.01)
    assert wrong.sum() < 4 * 0.4 * color.fx * max(1.0, color.fx / DEPTH.fx)
    row = color.height // 2
    shadow = int(0.03 * color.fx * (1 / 1.0 - 1 / 3.0))
    assert (out[row] == 0).sum() >= shadow - 2


def test_a_hole_in_depth_stays_a_hole() -> None:
    depth = np.full((120, 160), 1.5, np.float32)
    depth[50:60, 70:80] = 0
    out = DepthReprojection(DEPTH, COLOR, moved(0.01, 0, 0))(depth)
    assert 60 <= (out[40:80, 50:110] == 0).sum() <= 100


def test_every_kind_of_unknown_becomes_zero() -> None:
    raw16 = np.array([[0, 65535, 1000]], np.uint16)
    np.testing.assert_allclose(clean_depth(raw16, 1000, None), [[0, 0, 1.0]])
    raw = np.array([[np.nan, -1, np.inf, 2.0, 9.0, 0.0]], np.float32)
    np.testing.assert_allclose(clean_depth(raw, 1, 5.0), [[0, 0, 0, 2.0, 0, 0]])
    np.testing.assert_allclose(clean_depth(np.array([[-5, 500]], np.int32), 1000, None), [[0, 0.5]])


def test_undistortion_takes_a_bent_line_straight() -> None:
    lens = Camera(320, 240, 260.0, 260.0, 160.0, 120.0, (-0.2, 0.03, 0.0, 0.0, 0.0))
    # A point at normalised x, y is seen at x(1 + k1 r2 + k2 r4).
    image = np.zeros((240, 320, 3), np.uint8)
    y = np.linspace(-0.4, 0.4, 2000)
    r2 = 0.45**2 + y * y
    bend = 1 - 0.2 * r2 + 0.03 * r2**2
    u, v = np.rint(260 * 0.45 * bend + 160).astype(int), np.rint(260 * y * bend + 120).astype(int)
    image[v, u] = 255
    straight = Undistortion(lens).color(image)[..., 0].astype(float)
    rows = slice(30, 210)
    columns = (straight[rows] * np.arange(320)).sum(1) / straight[rows].sum(1)
    assert np.abs(columns - (260 * 0.45 + 160)).max() < 0.75
