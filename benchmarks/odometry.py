"""How well and how fast the rgbd reconstruction follows a camera, with and without loop edges.

    python benchmarks/odometry.py --source PATH [--json FILE] [--workers N] [--beside-open3d]

Prints frames per second, posed frames, and the ATE RMSE after SE(3) alignment over all posed frames against the poses
that the source gives. `--beside-open3d` runs Open3D's dense frame-to-model tracking on the same frames.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from machine import machine, write_json
from numpy.typing import NDArray

from list3r.association.graph.pose_graph import optimize
from list3r.association.overlap.edges import EdgeEnd, measure_edge
from list3r.association.revisits.search import find_loops
from list3r.frames.base import Camera, Frame
from list3r.frames.chunking.chunks import ChunkSettings, ChunkSpan, plan_chunks
from list3r.frames.options import SourceOptions, parse_intrinsics
from list3r.frames.source import open_source
from list3r.memory.geometry import Sim3, umeyama
from list3r.memory.records import ChunkRow, Edge, FrameSamples, Keyframe
from list3r.memory.store.tables.local_instances import LocalNode
from list3r.pipeline.workers import OrderedPool
from list3r.reconstruction.keyframe_record import frame_samples, make_keyframes
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class Chunk:
    """What one chunk leaves behind."""

    span: ChunkSpan
    frame_indices: NDArray[np.int64]
    posed: NDArray[np.bool_]
    camera: Camera
    T_chunk_cam: Poses
    T_source_cam: Poses
    keyframes: tuple[Keyframe, ...]
    samples: FrameSamples
    seconds: dict[str, float]


class Chunks:
    """Finished chunks as the store would give them to `find_loops`."""

    def __init__(self) -> None:
        self.done: list[Chunk] = []
        self.known: list[Edge] = []

    def chunk_checksums(self) -> dict[int, int]:
        """Finished chunks do not change."""
        return dict.fromkeys(range(len(self.done)), 1)

    def chunks(self, session_id: int | None = None) -> list[ChunkRow]:
        """One row for each chunk so far."""
        place, size = (0.0, 0.0, 0.0, 0.0), (0, 0)
        return [ChunkRow(k, 0, k, 0, 0, 0, Sim3.identity(), place, size, "metric") for k in range(len(self.done))]

    def keyframes(self, chunk_id: int) -> list[Keyframe]:
        """The keyframes of a chunk."""
        return list(self.done[chunk_id].keyframes)

    def keyframe(self, chunk_id: int, frame_index: int) -> Keyframe:
        """One keyframe."""
        return next(k for k in self.done[chunk_id].keyframes if k.frame_index == frame_index)

    def frame_samples(self, chunk_id: int) -> FrameSamples:
        """Points of all frames of a chunk."""
        return self.done[chunk_id].samples

    def local_nodes(self, chunk_ids: Sequence[int] | None = None) -> list[LocalNode]:
        """Nothing: no instances are looked for here."""
        return []

    def feature_space(self, chunk_id: int) -> str:
        """That of no features."""
        return "none@1/0"

    def edges(self) -> list[Edge]:
        """Those known so far, between neighbours and loops."""
        return self.known

    def keyframe_descriptors(
        self, chunk_ids: Sequence[int] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Keys and descriptors of the keyframes of some chunks, of all so far by default."""
        wanted = range(len(self.done)) if chunk_ids is None else chunk_ids
        all_keyframes = [(c, k) for c in wanted for k in self.done[c].keyframes]
        keys = np.array([(c, k.frame_index) for c, k in all_keyframes], np.int64).reshape(-1, 2)
        return keys, np.array([k.descriptor for _, k in all_keyframes], np.float32)


def reconstruct(path: str, options: SourceOptions, span: ChunkSpan) -> Chunk:
    """Read and reconstruct one chunk on one core."""
    cv2.setNumThreads(1)
    marks = [time.process_time()]
    source = open_source(path, options)
    frames = [f for f in source.read(span.start, span.stop) if isinstance(f, Frame)]
    marks.append(time.process_time())
    assert source.info.camera is not None
    result = RgbdReconstructor()(frames, source.info.camera)
    marks.append(time.process_time())
    keyframes, samples = make_keyframes(frames, result, keep_jpeg=False), frame_samples(result)
    marks.append(time.process_time())
    missing = np.full((4, 4), np.nan)
    given = np.stack([missing if f.T_source_cam is None else f.T_source_cam for f in frames])
    seconds = dict(zip(("read", "reconstruct", "keyframes"), np.diff(marks).tolist(), strict=True))
    return Chunk(
        span,
        result.frame_indices,
        result.posed,
        source.info.camera,
        result.T_chunk_cam,
        given,
        keyframes,
        samples,
        seconds,
    )


def associate(chunks: list[Chunk]) -> tuple[list[Edge], list[Edge]]:
    """Edges between neighbours, and loop edges."""
    adjacent = [
        measure_edge(EdgeEnd(k, u.samples), EdgeEnd(k + 1, v.samples), v.camera, metric=True).edge
        for k, (u, v) in enumerate(itertools.pairwise(chunks))
    ]
    store, loops = Chunks(), list[Edge]()
    for k, chunk in enumerate(chunks):
        store.done.append(chunk)
        store.known = [*adjacent[:k], *loops]
        loops += find_loops(store, k)
    return adjacent, loops


def trajectory(chunks: list[Chunk], edges: list[Edge]) -> dict[int, Poses]:
    """Poses of all posed frames in the first chunk's frame, each from the first chunk that holds it."""
    graph = optimize(range(len(chunks)), edges, {}, metric=True)
    out: dict[int, Poses] = {}
    for k, chunk in enumerate(chunks):
        if graph.components[k] != 0:
            continue
        for index, posed, T in zip(chunk.frame_indices, chunk.posed, chunk.T_chunk_cam, strict=True):
            if posed and int(index) not in out:
                out[int(index)] = graph.S_graph_chunk[k].as_matrix() @ T
    return out


def ate_rmse(poses: dict[int, Poses], truth: dict[int, Poses]) -> float:
    """ATE RMSE after SE(3) alignment over the frames of both, metres."""
    shared = sorted(set(poses) & set(truth))
    if len(shared) < 3:
        return float("nan")
    a = np.stack([poses[k][:3, 3] for k in shared])
    b = np.stack([truth[k][:3, 3] for k in shared])
    error = umeyama(a, b, with_scale=False).apply(a) - b
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def open3d_trajectory(path: str, options: SourceOptions) -> tuple[dict[int, Poses], float]:
    """Open3D's dense frame-to-model tracking (`t.pipelines.slam`), and its seconds without reading."""
    import open3d as o3d
    import open3d.core as o3c

    source = open_source(path, options)
    camera = source.info.camera
    assert camera is not None
    device, slam = o3c.Device("CPU:0"), o3d.t.pipelines.slam
    T, seconds, out = o3c.Tensor(np.eye(4)), 0.0, dict[int, Poses]()
    model = slam.Model(0.0058, 16, 40000, T, device)
    intrinsics = o3c.Tensor(camera.matrix())
    live = slam.Frame(camera.height, camera.width, intrinsics, device)
    ray = slam.Frame(camera.height, camera.width, intrinsics, device)
    for k, frame in enumerate(f for f in source.read(0, source.info.frame_count) if isinstance(f, Frame)):
        assert frame.depth is not None
        begin = time.process_time()
        live.set_data_from_image("depth", o3d.t.geometry.Image((frame.depth * 1000).astype(np.uint16)))
        live.set_data_from_image("color", o3d.t.geometry.Image(np.ascontiguousarray(frame.color)))
        if k:
            T = T @ model.track_frame_to_model(live, ray, 1000.0, 5.0, 0.07).transformation
        model.update_frame_pose(k, T)
        model.integrate(live, 1000.0, 5.0, 8.0)
        model.synthesize_model_frame(ray, 1000.0, 0.1, 5.0, 8.0, False)
        seconds += time.process_time() - begin
        out[frame.index] = T.numpy().copy()
    return out, seconds


def run(path: str, options: SourceOptions, workers: int, beside_open3d: bool) -> dict[str, object]:
    """Measure, and return the figures."""
    source = open_source(path, options)
    count = source.info.frame_count
    spans = plan_chunks(count, ChunkSettings())
    begin = time.perf_counter()
    with OrderedPool(partial(reconstruct, path, options), workers) as pool:
        chunks = list(pool.map(spans))
    wall, begin = time.perf_counter() - begin, time.process_time()
    adjacent, loops = associate(chunks)
    associate_s = time.process_time() - begin
    poses, alone = trajectory(chunks, adjacent + loops), trajectory(chunks, adjacent)
    truth = {
        int(k): T
        for chunk in chunks
        for k, T in zip(chunk.frame_indices, chunk.T_source_cam, strict=True)
        if np.isfinite(T).all()
    }
    stages = {stage: sum(c.seconds[stage] for c in chunks) for stage in chunks[0].seconds}
    figures: dict[str, object] = {
        "source": path,
        "workers": workers,
        "frames": count,
        "chunks": len(chunks),
        "posed": len(poses),
        "wall_s": round(wall + associate_s, 2),
        "frames_per_s": round(count / (wall + associate_s), 2),
        "cpu_ms_per_frame": {k: round(1e3 * v / count, 1) for k, v in (stages | {"associate": associate_s}).items()},
        "loops": {"tried": len(loops), "accepted": sum(e.accepted for e in loops)},
        "ate_se3_without_loops_m": round(ate_rmse(alone, truth), 4),
        "ate_se3_m": round(ate_rmse(poses, truth), 4),
    }
    if beside_open3d:
        figures["open3d"] = _beside_open3d(path, options, truth)
    return figures


def _beside_open3d(path: str, options: SourceOptions, truth: dict[int, Poses]) -> dict[str, object]:
    try:
        poses, seconds = open3d_trajectory(path, options)
    except ImportError as error:
        return {"skipped": f"open3d cannot be imported here: {error}"}
    return {
        "ate_se3_m": round(ate_rmse(poses, truth), 4),
        "cpu_ms_per_frame": round(1e3 * seconds / max(1, len(poses)), 1),
    }


def main() -> None:
    """Parse arguments, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", required=True, help="folder of RGB-D frames that `list3r inspect` recognises")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--intrinsics", help="fx,fy,cx,cy of the colour camera where the source does not tell")
    parser.add_argument("--every", type=int, default=1, help="take every n-th frame")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--beside-open3d", action="store_true", help="run Open3D's tracking too, if it is installed")
    given = parser.parse_args()
    intrinsics = parse_intrinsics(given.intrinsics) if given.intrinsics else None
    options = SourceOptions(intrinsics=intrinsics, every=given.every)
    print(machine())
    figures = run(given.source, options, given.workers, given.beside_open3d)
    print(json.dumps(figures, indent=2))
    write_json(given.json, figures)


if __name__ == "__main__":
    main()
