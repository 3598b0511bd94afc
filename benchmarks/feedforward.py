"""How wrong the simulated feed-forward model is, for comparison with published figures of pi^3-class models.

python benchmarks/feedforward.py --presets calm,loop --seeds 101,102,103

Per chunk: ATE after Sim(3), scale drift from end to end, depth error, how far confidence goes with the error. Per
pair of neighbours: error of their Sim(3) by plain confidence-weighted alignment. Per video: ATE of the chain of such
alignments, without loops.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.feedforward_sim.feedforward import FeedForwardModel
from benchmarks.simulation.presets import make_video
from benchmarks.simulation.video import SimulatedVideo
from list3r.association.overlap.overlap_edge import EdgeEnd, EdgeSettings, measure_edge
from list3r.frames.base import Camera
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3, rotation_log, umeyama
from list3r.memory.core.records import ChunkResult

Array = NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default="calm,loop,corridor")
    parser.add_argument("--seeds", default="101,102,103")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    print(machine())
    rows = []
    for preset in args.presets.split(","):
        for seed in args.seeds.split(","):
            rows.append(measure(preset, int(seed)))
            print(
                "  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{v}" for k, v in rows[-1].items()), flush=True
            )
    write_json(args.json, {"runs": rows})


def measure(preset: str, seed: int) -> dict[str, Any]:
    """All figures of one video; lengths in metres."""
    video = make_video(preset, seed)
    model = FeedForwardModel(video, seed=seed)
    started = time.process_time()
    chunks = [model.chunk(s) for s in plan_chunks(len(video.time_s), ChunkSettings())]
    seconds = (time.process_time() - started) / len(chunks)
    fits = [_fit(video, c) for c in chunks]
    ates = [_rms(S.apply(c.T_chunk_cam[:, :3, 3]) - _true(video, c)) for S, c in zip(fits, chunks, strict=True)]
    depth = [_depth_errors(video, c, model) for c in chunks]
    placed, adjacent = [fits[0]], []
    for u, v, S_u, S_v in zip(chunks[:-1], chunks[1:], fits[:-1], fits[1:], strict=True):
        S_v_u = _plain(u, v)
        adjacent.append(_error_at(S_v @ S_v_u @ S_u.inverse(), _true(video, u)[-15]))
        placed.append(placed[-1] @ S_v_u.inverse())
    path = np.concatenate([S.apply(c.T_chunk_cam[:, :3, 3])[15:-15] for S, c in zip(placed, chunks, strict=True)])
    truth = np.concatenate([_true(video, c)[15:-15] for c in chunks])
    off = np.array(adjacent)
    return {
        "preset": preset,
        "seed": seed,
        "chunk_ate": float(np.median(ates)),
        "chunk_ate_90": float(np.quantile(ates, 0.9)),
        "chunk_drift": float(np.median([d["drift"] for d in depth])),
        "depth_error": float(np.median([d["error"] for d in depth])),
        "confidence_rank": float(np.median([d["rank"] for d in depth])),
        "edge_m": float(np.median(off[:, 0])),
        "edge_deg": float(np.median(off[:, 1])),
        "edge_scale": float(np.median(off[:, 2])),
        "chain_ate": _rms(umeyama(path, truth, with_scale=True).apply(path) - truth),
        "chunk_cpu_s": seconds,
        "path_m": float(np.linalg.norm(np.diff(video.T_world_cam[:, :3, 3], axis=0), axis=1).sum()),
        "extent_m": float(np.linalg.norm(np.ptp(video.T_world_cam[:, :3, 3], axis=0))),
    }


def _true(video: SimulatedVideo, chunk: ChunkResult) -> Array:
    return video.T_world_cam[chunk.frame_indices][:, :3, 3]


def _fit(video: SimulatedVideo, chunk: ChunkResult) -> Sim3:
    """The similarity that lays a chunk's points and cameras on the true ones best, one point in eight."""
    s = chunk.samples
    frame, pixel = s.frame[::8], s.pixel[::8]
    camera = video.camera
    z = video.depth[frame, pixel // camera.width, pixel % camera.width]
    rays = np.stack(
        [
            (pixel % camera.width - camera.cx) / camera.fx,
            (pixel // camera.width - camera.cy) / camera.fy,
            np.ones(len(pixel)),
        ],
        axis=1,
    )
    T = video.T_world_cam[frame]
    true = np.einsum("nij,nj->ni", T[:, :3, :3], z[:, None] * rays) + T[:, :3, 3]
    moving = np.isin(video.ids[frame, pixel // camera.width, pixel % camera.width], [m.id for m in video.movers])
    S = umeyama(s.points[::8][~moving], true[~moving], with_scale=True)
    off = np.linalg.norm(S.apply(s.points[::8]) - true, axis=1)
    good = ~moving & (off < 3 * np.median(off))
    return umeyama(s.points[::8][good], true[good], with_scale=True)


def _plain(u: ChunkResult, v: ChunkResult) -> Sim3:
    height, width = v.image_size
    camera = Camera(width, height, *v.intrinsics)
    settings = EdgeSettings(method="plain")
    try:
        return measure_edge(EdgeEnd(1, u.samples), EdgeEnd(2, v.samples), camera, False, settings).edge.S_v_u
    except DegenerateError:
        return Sim3.identity()


def _error_at(S: Sim3, place: Array) -> tuple[float, float, float]:
    """How far a similarity of the world is from none: metres at a place, degrees, logarithm of scale."""
    shift = np.linalg.norm(S.apply(place[None])[0] - place)
    return float(shift), float(np.rad2deg(np.linalg.norm(rotation_log(S.rotation)))), float(abs(np.log(S.scale)))


def _depth_errors(video: SimulatedVideo, chunk: ChunkResult, model: FeedForwardModel) -> dict[str, float]:
    """Error of depth in camera coordinates after each frame's own scale, and its correlation with confidence."""
    s = chunk.samples
    row = np.searchsorted(s.camera_frames, s.frame)
    T = s.T_chunk_cam[row]
    z = np.einsum("ni,ni->n", s.points - T[:, :3, 3], T[:, :3, 2])
    flat = video.depth.reshape(len(video.depth), -1)
    true = flat[s.frame, s.pixel]
    ratio = np.log(np.maximum(z, 1e-6) / true)
    scales = np.array([np.median(ratio[row == k]) for k in range(len(s.camera_frames))])
    error = np.abs(ratio - scales[row])
    third = len(scales) // 5
    return {
        "drift": float(abs(np.median(scales[-third:]) - np.median(scales[:third]))),
        "error": float(np.mean(error)),
        "rank": float(-spearmanr(error[::7], s.confidence[::7]).statistic),
    }


def _rms(off: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


if __name__ == "__main__":
    main()
