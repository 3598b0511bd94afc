"""Chunks of structure from motion are placed by their depth; the cameras stay where their own graph has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from list3r.association.graph.node_graph import bend_chunks
from list3r.association.graph.pose_graph import GraphResult, optimize
from list3r.association.graph.sampled_chunks import SampledChunks
from list3r.association.graph.surface_graph import place_by_surfaces
from list3r.association.overlap.camera_edge import camera_edge
from list3r.memory.core.bends import Bend
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameSamples
from tests.association_scenes import film

LENGTH, STEP, COUNT = 60, 40, 3
GAUGES = [Sim3.exp([0.4 * k, -0.3, 0.2 * k, 0.1 * k, 0.3, -0.2 * k, 0.1 * k]) for k in range(COUNT)]


def stretched(samples: FrameSamples, factor: float) -> FrameSamples:
    """The path of the cameras longer by a factor about its middle, what each frame sees with it: depth is untouched."""
    places = samples.T_chunk_cam[:, :3, 3]
    shift = (factor - 1.0) * (places - places.mean(axis=0))
    poses, points = samples.T_chunk_cam.copy(), samples.points.astype(np.float64)
    poses[:, :3, 3] += shift
    points += shift[np.searchsorted(samples.camera_frames, samples.frame)]
    return replace(samples, T_chunk_cam=poses, points=points.astype(np.float32))


def chunks(factor: float) -> dict[int, FrameSamples]:
    parts = [film(S_chunk_world=S, first=STEP * k, frames=LENGTH) for k, S in enumerate(GAUGES)]
    return {k + 1: stretched(s, factor if k == 1 else 1.0) for k, s in enumerate(parts)}


def by_cameras(samples: dict[int, FrameSamples]) -> tuple[GraphResult, dict[int, Bend]]:
    edges = [camera_edge(samples[k], samples[k + 1], k, k + 1) for k in sorted(samples)[:-1]]
    assert all(e is not None for e in edges)
    graph = optimize(sorted(samples), [e for e in edges if e is not None], {}, metric=False)
    return graph, bend_chunks(SampledChunks(samples.__getitem__), graph, (), False)[1]


def scale_errors(graph: GraphResult) -> list[float]:
    """Of every chunk beside the first, logarithm."""
    true = [float((GAUGES[0].inverse() @ S).scale) for S in GAUGES]
    return [float(np.log(graph.S_graph_chunk[k + 1].scale * true[k])) for k in range(1, COUNT)]


def cameras(samples: dict[int, FrameSamples], graph: GraphResult, bends: dict[int, Bend]) -> np.ndarray:
    out = []
    for k, s in samples.items():
        x = bends.get(k, Bend.none()).at(s.camera_frames)
        for n in range(len(s.camera_frames)):
            local = Sim3(x.scale[n], x.rotation[n], x.translation[n]).apply(s.T_chunk_cam[n, None, :3, 3])
            out.append(graph.S_graph_chunk[k].apply(local)[0])
    return np.array(out)


def test_depth_tells_how_large_a_chunk_is_and_the_cameras_stay() -> None:
    from list3r.memory.core.geometry import umeyama

    samples = chunks(1.1)
    graph, bends = by_cameras(samples)
    placed, beside = place_by_surfaces(SampledChunks(samples.__getitem__), graph, bends)
    assert abs(scale_errors(graph)[0]) > 0.04
    assert max(abs(e) for e in scale_errors(placed)) < 0.01
    assert np.allclose(placed.S_graph_chunk[1].as_matrix(), graph.S_graph_chunk[1].as_matrix(), atol=1e-9)
    before, after = cameras(samples, graph, bends), cameras(samples, placed, beside)
    assert np.abs(umeyama(after, before, with_scale=True).apply(after) - before).max() < 1e-3


def test_where_cameras_and_depth_agree_nothing_moves() -> None:
    samples = chunks(1.0)
    graph, bends = by_cameras(samples)
    placed, beside = place_by_surfaces(SampledChunks(samples.__getitem__), graph, bends)
    for k, S in placed.S_graph_chunk.items():
        assert np.abs((graph.S_graph_chunk[k].inverse() @ S).log()).max() < 5e-3
    assert np.abs(cameras(samples, placed, beside) - cameras(samples, graph, bends)).max() < 5e-3


def test_without_edges_nothing_is_said() -> None:
    samples = chunks(1.1)
    graph = optimize(sorted(samples), [], {}, metric=False)
    placed, beside = place_by_surfaces(SampledChunks(samples.__getitem__), graph, {})
    assert placed is graph and not beside
