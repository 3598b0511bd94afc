"""What surrounds a chunk: gathering is exact, counts a thing once, and finds places that one chunk cannot tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration import Home, judged_loops
from list3r.association.revisits.constellations.neighbourhood import Neighbour, NeighbourhoodSettings, gather
from list3r.association.revisits.cross_check import Side
from list3r.association.revisits.instance_similarity import SimilaritySettings, instance_set
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3, rotation_exp
from list3r.memory.core.records import FrameSamples, Support
from list3r.memory.store.tables.local_instances import LocalNode

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
SPACE = "looks@1/16"


def thing(local_id: int, points: np.ndarray, seed: int) -> LocalNode:
    rng = np.random.default_rng(seed)
    count = len(points)
    support = Support(points.astype(np.float32), np.ones(count, np.float32), np.full((count, 3), 120, np.uint8))
    frames = np.arange(3)
    boxes, areas = np.zeros((3, 4), np.float32), np.full(3, 50, np.int32)
    feature = rng.standard_normal(16).astype(np.float32)
    seen = np.ones(3, np.float32)
    return LocalNode(1, local_id, 1, 1.0, False, False, None, feature, support, frames, boxes, areas, seen)


def side(nodes: list[LocalNode]) -> Side:
    """Three frames at one place, and the points of all things as samples of the first."""
    points = np.concatenate([n.support.points for n in nodes])
    poses = np.tile(np.eye(4), (3, 1, 1))
    samples = replace(
        FrameSamples.empty(),
        frame=np.zeros(len(points), np.int64),
        pixel=np.arange(len(points), dtype=np.int32),
        points=points,
        confidence=np.ones(len(points), np.float32),
        instance=np.concatenate([np.full(len(n.support.points), n.local_id, np.int32) for n in nodes]),
        camera_frames=np.arange(3),
        T_chunk_cam=poses,
    )
    return Side(samples, CAMERA, instance_set(nodes, poses, SPACE, SimilaritySettings()))


def blob(center: tuple[float, float, float], seed: int) -> np.ndarray:
    return np.asarray(center) + np.random.default_rng(seed).uniform(-0.15, 0.15, (60, 3))


def seen_from(S_here_chunk: Sim3, nodes: list[LocalNode]) -> Neighbour:
    """A neighbour that holds things of this frame in its own gauge."""
    back = S_here_chunk.inverse()
    moved = [
        replace(n, support=replace(n.support, points=back.apply(n.support.points).astype(np.float32))) for n in nodes
    ]
    return Neighbour(S_here_chunk, moved, side(moved))


CHAIR, MUG, LAMP = (
    thing(4, blob((0, 0, 2), 1), 11),
    thing(7, blob((1, 0, 2), 2), 12),
    thing(4, blob((0, 1, 3), 3), 13),
)
GAUGE = Sim3(np.asarray(0.6), rotation_exp(np.array([0.2, -0.4, 1.9])), np.array([3.0, -1.0, 2.0]))


def test_a_chunk_alone_is_left_as_it_is() -> None:
    alone = seen_from(Sim3.identity(), [CHAIR, MUG])
    nodes, whole = gather([alone], SPACE)
    assert nodes == list(alone.nodes)
    assert whole is alone.side


def test_what_a_neighbour_adds_stands_where_it_is() -> None:
    nodes, whole = gather([seen_from(Sim3.identity(), [CHAIR, MUG]), seen_from(GAUGE, [LAMP])], SPACE)
    assert len(nodes) == 3
    assert len({n.local_id for n in nodes}) == 3
    assert np.allclose(nodes[2].support.points, LAMP.support.points, atol=1e-5)
    assert np.all(np.diff(whole.samples.camera_frames) > 0)
    mine = whole.samples.instance == nodes[2].local_id
    assert np.allclose(whole.samples.points[mine], LAMP.support.points, atol=1e-5)


def test_the_sides_of_one_thing_are_one_thing() -> None:
    front = replace(
        CHAIR, support=replace(CHAIR.support, points=CHAIR.support.points - np.array([0, 0, 0.05], np.float32))
    )
    behind = replace(front, support=replace(front.support, points=CHAIR.support.points + np.float32(0.05)))
    nodes, whole = gather([seen_from(Sim3.identity(), [front, MUG]), seen_from(GAUGE, [behind])], SPACE)
    assert [n.local_id for n in nodes] == [CHAIR.local_id, MUG.local_id]
    assert len(nodes[0].support.points) == 120
    assert (whole.samples.instance == CHAIR.local_id).sum() == 120
    assert set(whole.instances.local_id) == {CHAIR.local_id, MUG.local_id}


def test_cameras_see_the_same_depths_after_gathering() -> None:
    part = seen_from(GAUGE, [LAMP])
    _, whole = gather([seen_from(Sim3.identity(), [CHAIR]), part], SPACE)
    last, points = whole.samples.T_chunk_cam[-1], whole.samples.points[-60:]
    own = np.linalg.inv(part.side.samples.T_chunk_cam[-1])
    before = part.side.samples.points @ own[:3, :3].T + own[:3, 3]
    after = (points - last[:3, 3]) @ last[:3, :3]
    assert np.allclose(after, float(GAUGE.scale) * before, atol=1e-5)


@pytest.mark.parametrize("count", [1, 5])
def test_surroundings_never_hold_more_instances_than_asked_for(count: int) -> None:
    nodes = [thing(k, blob((k, 0, 2), k), k) for k in range(4)]
    few = NeighbourhoodSettings(most_instances=count)
    _, whole = gather([seen_from(Sim3.identity(), nodes), seen_from(GAUGE, [LAMP])], SPACE, few)
    assert len(whole.instances.local_id) == min(count, 5)


@pytest.mark.slow
def test_a_room_seen_from_its_other_end_is_joined_and_a_stranger_is_not(tmp_path: Path) -> None:
    home = Home("opposite", 62, kept=(slice(-3, None), slice(1)))
    other = Home("opposite", 61, kept=(slice(0), slice(1)))
    rows = [
        row
        for store, chunk_id, truth, same in home.arrivals(tmp_path / "memory.l3r", other)
        for row in judged_loops(store, chunk_id, truth, same)
        if row["u"] < home.second
    ]
    believed = [r for r in rows if r["believed"]]
    assert believed
    assert all(r["right"] for r in believed)
