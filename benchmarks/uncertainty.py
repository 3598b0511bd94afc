"""Whether chunks are where the memory says: the share of true positions inside the stated 95 % region.

    python benchmarks/uncertainty.py --presets kidnap,loop --seeds 1,2 --json FILE

Simulated videos are worked through the real pipeline. A chunk's position is the centroid of its cameras. The first
chunk of a component is the frame of reference: the similarity from its point maps to the truth fixes the gauge, so the
truth is compared without any fit to the trajectory. Errors of the chunks of one video go together, so whole videos fail
or hold: the share is given for each.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from association import PRESETS, run_variant
from machine import machine, write_json
from numpy.typing import NDArray
from scipy.stats import chi2

from list3r.pipeline.workers import OrderedPool

Array = NDArray[np.float64]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default=",".join(PRESETS))
    parser.add_argument("--seeds", default="1,2,3,4")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    jobs = [(p, int(s)) for s in args.seeds.split(",") for p in args.presets.split(",")]
    videos: list[dict[str, Any]] = []
    with OrderedPool(run_video, args.workers) as pool:
        for row in pool.map(jobs):
            videos.append(row)
            figures = ("inside_share", "median_error_m", "median_stated_m", "ate_sim3_m")
            print(
                f"{row['preset']:9} seed {row['seed']}  {row['chunks']} chunks  "
                + "  ".join(f"{k} {row[k]:.3f}" for k in figures),
                flush=True,
            )
    summary = summarise(videos)
    for name, entry in summary.items():
        print(f"{name:9} " + "  ".join(f"{k} {v}" for k, v in entry.items()))
    print(machine())
    write_json(args.json, {"summary": summary, "videos": videos})


def run_video(job: tuple[str, int]) -> dict[str, Any]:
    """One simulated video."""
    from benchmarks.feedforward_sim.cuts import cuts_by_descriptor
    from benchmarks.feedforward_sim.feedforward import FeedForwardModel
    from benchmarks.simulation.presets import make_video
    from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks

    preset, seed = job
    video = make_video(preset, seed)
    model = FeedForwardModel(video, seed=seed)
    spans = plan_chunks(len(video.time_s), ChunkSettings(), cuts_by_descriptor(model.descriptors))
    found = run_variant("cwgo", [model.chunk(s) for s in spans], model, Truth(video))
    return {"preset": preset, "seed": seed, **found}


class Truth:
    """Compares where the chunks of a memory are, and how sure it is of that, with a simulated video."""

    def __init__(self, video: Any) -> None:
        self.frames = len(video.time_s)
        self._video = video

    def measure(self, store: Any) -> dict[str, Any]:
        """Mahalanobis distances of all chunks but the first of each component."""
        gauges: dict[int, Any] = {}
        rows = []
        for chunk in sorted(store.chunks.all(), key=lambda c: c.chunk_id):
            samples = store.chunks.samples(chunk.chunk_id)
            if chunk.chunk_id == chunk.component:
                gauges[chunk.component] = chunk.S_world_chunk @ self._chunk_from_truth(samples)
                continue
            centers = samples.T_chunk_cam[:, :3, 3]
            true_centers = gauges[chunk.component].apply(self._video.T_world_cam[samples.camera_frames, :3, 3])
            units = float(chunk.S_world_chunk.scale / gauges[chunk.component].scale)
            rows.append(
                {
                    "chunk": chunk.chunk_id,
                    "units": units,
                    **_compared(chunk, centers.mean(axis=0), true_centers.mean(axis=0)),
                }
            )
        inside = [r["mahalanobis_sq"] < chi2.ppf(0.95, 3) for r in rows]
        return {
            "chunks": len(rows),
            "inside": int(sum(inside)),
            "inside_share": float(np.mean(inside)),
            "median_error_m": float(np.median([r["error"] * r["units"] for r in rows])),
            "median_stated_m": float(np.median([r["stated"] * r["units"] for r in rows])),
            "ate_sim3_m": self._ate(store),
            "mahalanobis_sq": [round(r["mahalanobis_sq"], 3) for r in rows],
        }

    def _chunk_from_truth(self, samples: Any) -> Any:
        """The similarity from the truth to a chunk by all that the chunk saw and that is still, trimmed."""
        from list3r.memory.core.geometry import umeyama

        video = self._video
        row, column = np.divmod(samples.pixel, video.camera.width)
        truth = video.points(samples.frame, row, column)
        still = (video.depth[samples.frame, row, column] > 0) & ~np.isin(
            video.ids[samples.frame, row, column], [m.id for m in video.movers]
        )
        points, truth, good = samples.points[still].astype(np.float64), truth[still], np.ones(int(still.sum()), bool)
        for _ in range(5):
            found = umeyama(truth[good], points[good], with_scale=True)
            off = np.linalg.norm(found.apply(truth) - points, axis=1)
            good = off <= 3 * np.median(off)
        return found

    def _ate(self, store: Any) -> float:
        from list3r.memory.core.geometry import umeyama

        placed = store.trajectory.poses()
        estimate = np.stack([S.translation for _, S in placed])
        truth = self._video.T_world_cam[[f.frame_index for f, _ in placed], :3, 3]
        off = umeyama(estimate, truth, with_scale=True).apply(estimate) - truth
        return float(np.sqrt((off**2).sum(axis=1).mean()))


def _compared(chunk: Any, center: Array, true_center_world: Array) -> dict[str, float]:
    """Error of a point of a chunk by its stated covariance, lengths in chunk units."""
    from list3r.memory.core.geometry import skew

    error = chunk.S_world_chunk.inverse().apply(true_center_world[None])[0] - center
    by_tangent = np.concatenate([np.eye(3), -skew(center), center[:, None]], axis=1)
    covariance = by_tangent @ chunk.covariance @ by_tangent.T
    return {
        "mahalanobis_sq": float(error @ np.linalg.solve(covariance, error)),
        "error": float(np.linalg.norm(error)),
        "stated": float(np.sqrt(np.trace(covariance))),
    }


def summarise(videos: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Shares over all chunks, by preset and pooled, and the share of videos in which no chunk is outside."""
    out = {}
    for name in [*dict.fromkeys(v["preset"] for v in videos), "all"]:
        mine = [v for v in videos if name in (v["preset"], "all")]
        out[name] = {
            "videos": len(mine),
            "chunks": sum(v["chunks"] for v in mine),
            "inside_share": round(sum(v["inside"] for v in mine) / max(sum(v["chunks"] for v in mine), 1), 4),
            "lowest_of_a_video": round(min(v["inside_share"] for v in mine), 4),
            "videos_wholly_inside": sum(v["inside"] == v["chunks"] for v in mine),
        }
    return out


if __name__ == "__main__":
    main()
