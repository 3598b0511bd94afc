"""Nodes within chunks: bending that overlaps and loops show is undone, and what is rigid stays so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.association.graph.chunk_nodes import ChunkNodes, NodeSettings, measured_walk, relate_frames
from list3r.association.graph.node_graph import bend_chunks
from list3r.association.graph.pose_graph import GraphResult, optimize
from list3r.association.graph.sampled_chunks import SampledChunks
from list3r.association.overlap.overlap_edge import EdgeEnd, measure_edge
from list3r.memory.core.bends import Bend
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples
from list3r.memory.store.store import Store
from tests.association_scenes import CAMERA, film, walk

LENGTH, STEP, COUNT = 60, 40, 4
GAUGES = [Sim3.exp([0.4 * k, -0.3, 0.2 * k, 0.1 * k, 0.3, -0.2 * k, 0.1 * k]) for k in range(COUNT)]


def bent(samples: FrameSamples, end: np.ndarray) -> FrameSamples:
    """A chunk whose frames drift from nothing to `end` (7,) about the first camera."""
    first = Sim3.from_matrix(samples.T_chunk_cam[0])
    points, poses = samples.points.astype(np.float64), samples.T_chunk_cam.copy()
    for k, frame in enumerate(samples.camera_frames):
        S = first @ Sim3.exp(end * k / (len(samples.camera_frames) - 1)) @ first.inverse()
        mine = samples.frame == frame
        points[mine] = S.apply(points[mine])
        poses[k, :3, :3], poses[k, :3, 3] = S.rotation @ poses[k, :3, :3], S.apply(poses[k, None, :3, 3])[0]
    return replace(samples, points=points.astype(np.float32), T_chunk_cam=poses)


def chunks(deviation: float, seed: int = 3) -> dict[int, FrameSamples]:
    rng = np.random.default_rng(seed)
    parts = [film(S_chunk_world=S, first=STEP * k, frames=LENGTH) for k, S in enumerate(GAUGES)]
    return {k + 1: bent(s, deviation * rng.normal(size=7)) for k, s in enumerate(parts)}


def graph_of(samples: dict[int, FrameSamples], loop: bool = True) -> GraphResult:
    """Chunks by adjacent edges, and a true loop between the first frame of all and the last."""
    ids = sorted(samples)
    edges = [measure_edge(EdgeEnd(a, samples[a]), EdgeEnd(a + 1, samples[a + 1]), CAMERA, False).edge for a in ids[:-1]]
    if loop:
        last = STEP * (COUNT - 1) + LENGTH - 1
        ends = [Sim3.from_matrix(samples[c].T_chunk_cam[n]) for c, n in ((1, 0), (COUNT, -1))]
        true = [Sim3.from_matrix(walk(last + 1)[n]) for n in (0, last)]
        scale = [np.asarray(_stretch(samples[c], n)) for c, n in ((1, 0), (COUNT, last))]
        ends = [Sim3(s, e.rotation, e.translation) for s, e in zip(scale, ends, strict=True)]
        S_v_u = ends[1] @ true[1].inverse() @ true[0] @ ends[0].inverse()
        cov = np.eye(7) * 1e-6
        edges.append(Edge(1, COUNT, "loop", S_v_u, 0.9, 0.9, 99, 0.0, True, "", frames=(0, last), covariance=cov))
    return optimize(ids, edges, {}, metric=False)


def _stretch(samples: FrameSamples, frame: int) -> float:
    """Chunk units per metre at a frame, by its depth."""
    truth = film(first=frame, frames=1)
    at = int(np.searchsorted(samples.camera_frames, frame))
    mine = samples.frame == frame
    away = np.linalg.norm(samples.points[mine] - samples.T_chunk_cam[at, :3, 3], axis=1)
    return float(np.median(away / np.linalg.norm(truth.points - truth.T_chunk_cam[0, :3, 3], axis=1)))


def error(samples: dict[int, FrameSamples], graph: GraphResult, bends: dict[int, Bend]) -> float:
    """RMS distance of all cameras from the truth after Sim(3), metres."""
    from list3r.memory.core.geometry import umeyama

    found, true = [], []
    for k, s in samples.items():
        x = bends.get(k, Bend.none()).at(s.camera_frames)
        for n, f in enumerate(s.camera_frames):
            local = Sim3(x.scale[n], x.rotation[n], x.translation[n]).apply(s.T_chunk_cam[n, None, :3, 3])
            found.append(graph.S_graph_chunk[k].apply(local)[0])
            true.append(walk(int(f) + 1)[-1][:3, 3])
    S = umeyama(np.array(found), np.array(true), with_scale=True)
    return float(np.sqrt(((S.apply(np.array(found)) - true) ** 2).sum(axis=1).mean()))


def test_bending_is_undone() -> None:
    samples = chunks(0.02)
    graph = graph_of(samples)
    straight, bends = bend_chunks(SampledChunks(samples.__getitem__), graph, (), False)
    assert set(bends) == set(samples)
    assert error(samples, straight, bends) < 0.75 * error(samples, graph, {})
    assert np.allclose(straight.S_graph_chunk[1].as_matrix(), graph.S_graph_chunk[1].as_matrix(), atol=1e-9)


def test_exact_chunks_stay_as_they_are() -> None:
    samples = chunks(0.0)
    graph = graph_of(samples)
    straight, bends = bend_chunks(SampledChunks(samples.__getitem__), graph, (), False)
    assert max(np.abs(b.twists).max() for b in bends.values()) < 1e-3
    assert error(samples, straight, bends) < 1e-3


def test_given_poses_and_a_switched_off_graph_do_not_bend() -> None:
    samples = chunks(0.02)
    graph = graph_of(samples)
    _, bends = bend_chunks(SampledChunks(samples.__getitem__), graph, (1, 2), False)
    assert set(bends) == {3, 4}
    same, none = bend_chunks(SampledChunks(samples.__getitem__), graph, (), False, NodeSettings(enabled=False))
    assert same is graph and not none


def test_metric_chunks_keep_their_scale() -> None:
    samples = {k: bent(film(first=STEP * (k - 1), frames=LENGTH), np.array([0.02] * 6 + [0.0])) for k in range(1, 4)}
    edges = [measure_edge(EdgeEnd(a, samples[a]), EdgeEnd(a + 1, samples[a + 1]), CAMERA, True).edge for a in (1, 2)]
    graph = optimize([1, 2, 3], edges, {}, metric=True)
    straight, bends = bend_chunks(SampledChunks(samples.__getitem__), graph, (), True)
    assert all(float(S.scale) == pytest.approx(1.0, abs=1e-12) for S in straight.S_graph_chunk.values())
    assert all(np.abs(b.twists[:, 6]).max() < 1e-12 for b in bends.values())


def test_metric_chunks_bend_alike_wherever_their_origins_lie() -> None:
    """A chunk whose frame is that of a source far away holds its points at hundreds of metres."""
    found = []
    for far in (0.0, 400.0):
        off = np.eye(4)
        off[0, 3] = far
        samples = {k: bent(film(first=STEP * (k - 1), frames=LENGTH), np.array([0.01] * 6 + [0.0])) for k in (1, 2, 3)}
        samples = {
            k: replace(s, points=s.points + np.float32([far, 0, 0]), T_chunk_cam=off @ s.T_chunk_cam)
            for k, s in samples.items()
        }
        edges = [
            measure_edge(EdgeEnd(a, samples[a]), EdgeEnd(a + 1, samples[a + 1]), CAMERA, True).edge for a in (1, 2)
        ]
        straight, _ = bend_chunks(
            SampledChunks(samples.__getitem__), optimize([1, 2, 3], edges, {}, metric=True), (), True
        )
        here = Sim3.exp(np.array([far, 0, 0, 0, 0, 0, 0]))
        found.append([here.inverse() @ S @ here for S in straight.S_graph_chunk.values()])
    for near, away in zip(*found, strict=True):
        assert np.allclose(near.as_matrix(), away.as_matrix(), atol=2e-4)


def test_what_samples_tell_is_found_once_while_a_memory_is_open(tmp_path: Path) -> None:
    from tests.test_consolidation import add, chunk, create

    store = create(tmp_path / "a.l3r")
    for k in range(2):
        add(store, chunk(k))
    edge = Edge(1, 2, "adjacent", Sim3.identity(), 0.9, 0.9, 99, 0.0, True, "")
    first = SampledChunks.of(store).nodes(1, 10), SampledChunks.of(store).relations(edge, 10)
    again = SampledChunks.of(store)
    assert (again.nodes(1, 10), again.relations(edge, 10)) == first
    assert again.nodes(1, 0) is not first[0]
    alone = SampledChunks(store.chunks.samples)
    assert np.array_equal(alone.nodes(1, 10).center, first[0].center)
    assert np.array_equal(alone.relations(edge, 10).off, first[1].off)
    store.close()


def test_chunks_that_show_nothing_and_parts_apart() -> None:
    samples = chunks(0.02)
    samples[5] = FrameSamples.empty()
    broken = samples[2].T_chunk_cam.copy()
    broken[3] = np.nan
    samples[2] = replace(samples[2], T_chunk_cam=broken)
    graph = graph_of({k: samples[k] for k in (1, 2, 3, 4)})
    alone = Sim3.exp([9.0, 0, 0, 0, 0, 0, 0])
    graph = replace(graph, S_graph_chunk={**graph.S_graph_chunk, 5: alone}, components={**graph.components, 5: 5})
    straight, bends = bend_chunks(SampledChunks(samples.__getitem__), graph, (), False)
    assert 5 not in bends and np.allclose(straight.S_graph_chunk[5].as_matrix(), alone.as_matrix())
    assert all(np.isfinite(b.twists).all() for b in bends.values())


def test_an_edge_that_is_not_believed_holds_nothing_but_leaves_nothing_loose() -> None:
    samples = chunks(0.02)
    graph = graph_of(samples, loop=False)
    doubted = replace(graph.edges[1], accepted=False, scores={**graph.edges[1].scores, "trust": 0.0})
    graph = replace(graph, edges=(graph.edges[0], doubted, graph.edges[2]))
    straight, bends = bend_chunks(SampledChunks(samples.__getitem__), graph, (), False)
    assert all(np.isfinite(S.as_matrix()).all() for S in straight.S_graph_chunk.values())
    assert all(np.abs(b.twists).max() < 0.5 for b in bends.values())


def test_how_much_chunks_bend_is_measured_on_their_overlaps() -> None:
    walks = []
    for deviation in (0.0, 0.02):
        samples = chunks(deviation)
        found = []
        for a in (1, 2, 3):
            edge = measure_edge(EdgeEnd(a, samples[a]), EdgeEnd(a + 1, samples[a + 1]), CAMERA, False).edge
            nodes = ChunkNodes.of(samples[a], 10)
            assert nodes.count.sum() == LENGTH
            found.append(relate_frames(samples[a], samples[a + 1], edge, nodes))
        assert [len(r.frames) for r in found] == [LENGTH - STEP] * 3
        walks.append(measured_walk(found))
    assert (walks[0] < 1e-9).all() and (walks[1] > 10 * walks[0]).all()
    assert (measured_walk([]) == 0).all()


def test_bends_are_kept_and_move_the_cameras(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory(), writable=True) as store:
        _check_bend_of(store)


def _check_bend_of(store: Store) -> None:
    chunk = store.chunks.all()[0].chunk_id
    before = {f.frame_index: S for f, S in store.trajectory.poses() if f.chunk_id == chunk}
    frames = sorted(before)
    shift = np.zeros((2, 7))
    shift[1, 0] = 0.5
    bend = Bend(np.array([frames[0], frames[-1]], float), shift)
    with store.transaction():
        store.bends.replace({chunk: bend})
    assert np.array_equal(store.bends.all()[chunk].twists, shift)
    after = {f.frame_index: S for f, S in store.trajectory.poses() if f.chunk_id == chunk}
    assert np.allclose(after[frames[0]].translation, before[frames[0]].translation)
    moved = np.linalg.norm(after[frames[-1]].translation - before[frames[-1]].translation)
    assert moved == pytest.approx(0.5 * float(store.chunks.get(chunk).S_world_chunk.scale))
    assert store.verify() == []
