"""Scale is carried by parallax: a camera that turns on the spot loses it, and loops give it back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from list3r.association.graph.node_graph import bend_chunks
from list3r.association.graph.pose_graph import optimize
from list3r.association.graph.sampled_chunks import SampledChunks
from list3r.association.overlap.camera_edge import camera_edge
from list3r.memory.core.geometry import Sim3, umeyama
from list3r.memory.core.records import Edge, FrameSamples
from list3r.reconstruction.scale_loss import lost_scale

TURN = (60, 80)
"""Frames in which the camera turns by 90 degrees; before and after it walks sideways, 2 cm a frame."""
COUNT = 140
CHUNKS = {1: (0, 50), 2: (30, 110), 3: (90, 140)}
BREAK, GROWTH = 70, 1.25
GAUGES = {1: Sim3.identity(), 2: Sim3.exp([0.3, 0, 0.1, 0, 0.2, 0, 0.1]), 3: Sim3.exp([0, 0.2, 0, 0.1, 0, 0, -0.2])}


def walk() -> np.ndarray:
    """The true cameras. Shape (COUNT, 4, 4)."""
    poses, T = [], np.eye(4)
    for k in range(COUNT):
        turning = TURN[0] <= k < TURN[1]
        step = [0.0005 if turning else 0.02, 0, 0, 0, np.pi / 2 / (TURN[1] - TURN[0]) if turning else 0.0, 0, 0]
        T = T @ Sim3.exp(step).as_matrix()
        poses.append(T)
    return np.stack(poses)


def reach(count: int = COUNT) -> np.ndarray:
    return np.full(count, 2.5)


def mapped(first: int, stop: int, S_chunk_world: Sim3) -> FrameSamples:
    """What a chunk makes of its frames: all that comes after `BREAK` is larger by `GROWTH`, about the camera there."""
    rays = np.array([(x, y, 1.0) for y in (-0.4, 0.0, 0.4) for x in np.linspace(-0.5, 0.5, 8)])
    seen, poses = [], []
    true, frames = walk(), np.arange(first, stop)
    at = true[BREAK, :3, 3]
    grown = Sim3(np.asarray(GROWTH), np.eye(3), at - GROWTH * at)
    for k in frames.tolist():
        S = S_chunk_world @ grown if k > BREAK >= first else S_chunk_world
        depth = 2.5 + 0.3 * np.sin(np.arange(len(rays)))
        seen.append(S.apply((depth[:, None] * rays) @ true[k, :3, :3].T + true[k, :3, 3]))
        pose = (S @ Sim3.from_matrix(true[k])).as_matrix()
        pose[:3, :3] /= float(S.scale)
        poses.append(pose)
    each = len(rays)
    return FrameSamples(
        frame=np.repeat(frames, each),
        pixel=np.tile(np.arange(each, dtype=np.int32), len(frames)),
        points=np.concatenate(seen).astype(np.float32),
        confidence=np.ones(each * len(frames), np.float32),
        instance=np.full(each * len(frames), -1, np.int32),
        camera_frames=frames,
        T_chunk_cam=np.stack(poses),
    )


def test_a_turn_on_the_spot_loses_scale_and_a_walk_does_not() -> None:
    deviation = np.sqrt(lost_scale(walk(), reach()))
    assert np.sqrt((deviation[20:40] ** 2).sum()) < 0.02
    assert np.sqrt((deviation[TURN[0] : TURN[1]] ** 2).sum()) > 0.2


def test_units_and_the_direction_of_time_change_nothing() -> None:
    there, back = walk(), walk()[::-1].copy()
    larger = there.copy()
    larger[:, :3, 3] *= 7.0
    expected = lost_scale(there, reach())
    assert np.allclose(lost_scale(larger, 7.0 * reach()), expected)
    assert np.allclose(lost_scale(back, reach())[::-1], expected)
    assert lost_scale(there[:1], reach(1)).shape == (0,)


@pytest.mark.parametrize("turning", [(), (1, 2, 3)])
def test_a_loop_is_believed_against_a_scale_that_broke_at_a_turn(turning: tuple[int, ...]) -> None:
    samples = {k: mapped(*span, GAUGES[k]) for k, span in CHUNKS.items()}
    chunks = SampledChunks(samples.__getitem__)
    edges = [edge for a in (1, 2) if (edge := camera_edge(samples[a], samples[a + 1], a, a + 1)) is not None]
    loop = GAUGES[3] @ GAUGES[1].inverse()
    sure = np.diag([0.03] * 3 + [0.01] * 3 + [0.03]) ** 2
    edges.append(Edge(1, 3, "loop", loop, 0.9, 0.9, 99, 0.0, True, "", frames=(20, 120), covariance=sure))
    weighed = [chunks.turned(e, turning, 10) for e in edges]
    graph = optimize([1, 2, 3], weighed, {}, metric=False)
    stated = tuple(replace(e, covariance=own.covariance) for e, own in zip(graph.edges, edges, strict=True))
    straight, bends = bend_chunks(chunks, replace(graph, edges=stated), (), False, turning=turning)
    assert [e.accepted for e in graph.edges] == [True, True, bool(turning)]
    found, true = [], walk()
    for k, (first, stop) in CHUNKS.items():
        S = bends[k].at(samples[k].camera_frames)
        for n in range(stop - first):
            own = Sim3(S.scale[n], S.rotation[n], S.translation[n]).apply(samples[k].T_chunk_cam[n, None, :3, 3])
            found.append(straight.S_graph_chunk[k].apply(own)[0])
    places = np.concatenate([true[slice(*span), :3, 3] for span in CHUNKS.values()])
    S = umeyama(np.array(found), places, with_scale=True)
    error = np.sqrt(((S.apply(np.array(found)) - places) ** 2).sum(axis=1).mean())
    assert error < 0.02 if turning else error > 0.04
