"""The two walls that are seen of a vessel are one thing; neighbours of one height are not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud, pack
from list3r.instances.rules.surfaces import Scene
from list3r.instances.rules.vessels import fit_circle, join_vessels
from list3r.instances.settings import SegmentSettings


def _arc(start_deg: float, stop_deg: float, radius: float) -> NDArray[np.float64]:
    """An upright wall of 20 cm along an arc about the origin. Shape (N, 3)."""
    angle, z = np.meshgrid(np.radians(np.arange(start_deg, stop_deg, 2.0)), np.arange(0.0, 0.2, 0.01))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1).reshape(-1, 3)


def _joined(*pieces: NDArray[np.float64]) -> NDArray[np.int32]:
    points = np.concatenate(pieces) + np.random.default_rng(0).normal(0.0, 0.004, (sum(map(len, pieces)), 3))
    labels = np.concatenate([np.full(len(p), n + 1, np.int32) for n, p in enumerate(pieces)])
    count, noise = len(points), np.full(len(points), 0.006, np.float32)
    cloud = Cloud(
        keys=pack(np.floor(points / 0.01).astype(np.int64)),
        points=points.astype(np.float32),
        normals=np.zeros((count, 3), np.float32),
        rgb=np.zeros((count, 3), np.float32),
        sigma=noise,
        reading=noise,
        weight=np.ones(count, np.float32),
        voxel=0.01,
        index=(),
    )
    scene = Scene(cloud, np.array([0.0, 0.0, 1.0]), noise, np.zeros((1, 3)), 1.0, SegmentSettings())
    joined = join_vessels(scene, [], labels)
    return np.array([joined[labels == n + 1][0] for n in range(len(pieces))])


@pytest.mark.parametrize("radius", [0.06, 0.12, 0.2])
def test_near_outside_and_far_inside_of_a_vessel_are_one(radius: float) -> None:
    near, far = _joined(_arc(190, 350, radius), _arc(10, 170, radius))
    assert near == far


def test_two_round_things_side_by_side_stay_two() -> None:
    a, b = _joined(_arc(180, 360, 0.05), _arc(180, 360, 0.05) + np.array([0.11, 0.0, 0.0]))
    assert a != b


def test_two_boxes_of_one_height_stay_two() -> None:
    x, z = np.meshgrid(np.arange(0.0, 0.2, 0.005), np.arange(0.0, 0.2, 0.01))
    front = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
    a, b = _joined(front, front + np.array([0.25, 0.02, 0.0]))
    assert a != b


def test_what_lies_in_a_bowl_stays_apart() -> None:
    near, far, ball = _joined(_arc(190, 350, 0.2), _arc(10, 170, 0.2), _arc(0, 360, 0.1))
    assert near == far != ball


def test_a_circle_is_found_from_two_arcs() -> None:
    middle = np.array([1.0, 2.0])
    center, radius = fit_circle(_arc(200, 300, 0.3)[:, :2] + middle, _arc(20, 100, 0.3)[:, :2] + middle)
    assert np.allclose(center, middle) and np.isclose(radius, 0.3)
