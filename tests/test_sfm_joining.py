"""Chunks from motion are joined by cameras and by where features are seen: known truth recovered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from list3r.association.overlap.camera_edge import better_edge, camera_edge
from list3r.association.revisits.reprojection_edge import refine_loop
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3, rotation_exp, rotation_log
from list3r.memory.core.records import Edge, FrameSamples, Keyframe
from list3r.reconstruction.sfm.mapping import KeyframeView, SparseMap, steady

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
TRUE = Sim3(np.asarray(1.4), rotation_exp(np.array([0.2, -0.5, 0.1])), np.array([0.3, -1.0, 2.0]))
"""v from u."""


def walk(first: int, stop: int, step: float = 0.02) -> FrameSamples:
    """Cameras of frames first to stop along one path, chunk u's coordinates."""
    frames = np.arange(first, stop)
    T = np.tile(np.eye(4), (len(frames), 1, 1))
    T[:, :3, :3] = rotation_exp(np.stack([0.01 * frames, 0.004 * frames, 0 * frames], axis=1))
    T[:, :3, 3] = np.stack([step * frames, 0.3 * step * np.sin(frames / 3), 0.2 * step * frames], axis=1)
    return replace(FrameSamples.empty(), camera_frames=frames, T_chunk_cam=T)


def moved(samples: FrameSamples, noise: float, seed: int = 101) -> FrameSamples:
    """The same cameras in v's coordinates, their places off by noise."""
    rng = np.random.default_rng(seed)
    T = samples.T_chunk_cam.copy()
    T[:, :3, :3] = TRUE.rotation @ T[:, :3, :3] @ rotation_exp(rng.normal(0, 0.002, (len(T), 3)))
    T[:, :3, 3] = TRUE.apply(T[:, :3, 3]) + rng.normal(0, noise, (len(T), 3))
    return replace(samples, T_chunk_cam=T)


def off(S: Sim3) -> tuple[float, float]:
    """Degrees and log scale by which a similarity misses the true one."""
    miss = TRUE.inverse() @ S
    return float(np.degrees(np.linalg.norm(rotation_log(miss.rotation)))), abs(float(np.log(miss.scale)))


def test_shared_cameras_give_the_relation_and_how_sure_it_is():
    edge = camera_edge(walk(0, 40), moved(walk(20, 60), 0.004), 1, 2)
    assert edge is not None and edge.accepted and edge.inliers == 20
    degrees, scale = off(edge.S_v_u)
    assert degrees < 0.2 and scale < 0.03
    miss = (edge.S_v_u.inverse() @ TRUE).log()
    assert edge.covariance is not None and miss @ np.linalg.solve(edge.covariance, miss) < 14.1


def test_one_frame_far_off_does_not_bend_it():
    v = moved(walk(20, 60), 0.002)
    v.T_chunk_cam[5, :3, 3] += 0.5
    edge = camera_edge(walk(0, 40), v, 1, 2)
    assert edge is not None and off(edge.S_v_u)[1] < 0.03


@pytest.mark.parametrize("v", [walk(38, 60), walk(50, 60)], ids=["two frames", "none"])
def test_too_few_shared_frames_give_no_edge(v):
    assert camera_edge(walk(0, 40), moved(v, 0.0), 1, 2) is None


def test_cameras_that_stand_still_give_no_edge():
    assert camera_edge(walk(0, 40, 0.0), moved(walk(20, 60, 0.0), 0.004), 1, 2) is None


def test_the_edge_by_points_stays_where_cameras_do_not_tell():
    points = loop(TRUE)
    assert better_edge(points, None) is points and better_edge(None, None) is None
    by_cameras = camera_edge(walk(0, 40), moved(walk(20, 60), 0.004), 1, 2)
    better = better_edge(points, by_cameras)
    assert better is not None and by_cameras is not None and better.S_v_u is by_cameras.S_v_u
    assert better.scores["spread"] == points.scores["spread"]


def loop(S: Sim3) -> Edge:
    scores = {"spread": 2.0}
    return Edge(1, 2, "loop", S, 0.8, 0.8, 30, 0.05, True, "seen again", scores, (7, 90), np.eye(7) * 1e-4)


def keyframes(depth_noise: float) -> tuple[Keyframe, Keyframe]:
    """Two views of 120 points whose depths are off by a share."""
    rng = np.random.default_rng(103)
    points = rng.uniform([-1.2, -0.9, 1.5], [1.2, 0.9, 3.5], (120, 3))
    descriptors = rng.integers(0, 255, (120, 128)).astype(np.uint8)
    T_u, T_v = np.eye(4), np.eye(4)
    T_v[:3, :3], T_v[:3, 3] = rotation_exp(np.array([0.05, -0.12, 0.02])), (0.4, 0.1, -0.2)
    made = []
    for T, S in ((T_u, Sim3.identity()), (T_v, TRUE)):
        cam = np.linalg.inv(T)
        seen = points @ cam[:3, :3].T + cam[:3, 3]
        xy = seen[:, :2] / seen[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy) + rng.normal(0, 0.5, (120, 2))
        off_by = 1.0 + rng.normal(0, depth_noise, (120, 1))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = S.rotation @ T[:3, :3], S.apply(T[:3, 3])
        rays = np.concatenate([(xy - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, np.ones((120, 1))], axis=1)
        in_camera = rays * seen[:, 2:] * off_by * float(S.scale)
        made.append((pose, xy, in_camera))
    return tuple(
        Keyframe(
            n,
            pose,
            np.zeros(4, np.float32),
            xy.astype(np.float32),
            descriptors,
            in_camera.astype(np.float32),
            np.zeros((0, 0), np.float32),
            (1.0, 1.0, 0.0, 0.0),
        )
        for n, (pose, xy, in_camera) in enumerate(made)
    )


def test_a_loop_tilted_by_rough_depth_is_put_right_by_the_picture():
    u, v = keyframes(0.06)
    tilted = TRUE @ Sim3.exp(np.array([0.02, -0.05, 0.03, 0.03, 0.03, -0.01, 0.06]))
    assert off(tilted)[0] > 2 and off(tilted)[1] > 0.05
    edge = refine_loop(loop(tilted), u, v, CAMERA, CAMERA)
    degrees, scale = off(edge.S_v_u)
    assert degrees < 1.0 and scale < 0.03
    miss = (edge.S_v_u.inverse() @ TRUE).log()
    assert edge.covariance is not None and miss @ np.linalg.solve(edge.covariance, miss) < 14.1


def test_a_loop_without_features_stays_as_it_is():
    u, v = keyframes(0.06)
    blind = replace(v, points_cam=np.full_like(v.points_cam, np.nan))
    edge = loop(TRUE)
    assert refine_loop(edge, u, blind, CAMERA, CAMERA) is edge


@pytest.mark.parametrize(("scale", "one_scale"), [(1.0, True), (2.0, True), (15.0, False)])
def test_a_map_whose_scale_was_lost_on_the_way_is_not_steady(scale: float, one_scale: bool) -> None:
    rng = np.random.default_rng(7)
    poses, points, seen = {}, {}, {}
    for key in range(6):
        size = scale if key > 2 else 1.0
        ids = np.arange(50 * key, 50 * key + 50)
        poses[key] = np.eye(4)
        poses[key][0, 3] = 0.1 * key * size
        points |= {int(n): size * np.array([0, 0, 3.0]) + rng.uniform(-0.5, 0.5, 3) for n in ids}
        seen[key] = KeyframeView(ids, np.zeros((50, 2), np.float32))
    assert steady(SparseMap(poses, points, CAMERA, seen=seen), 4.0) is one_scale
