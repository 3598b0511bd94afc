"""A real RGB-D sequence with a random similarity for each chunk: association must find the scale itself.

python benchmarks/regauge.py --source SEQUENCE [--seeds 1,2,3] --json FILE

Every chunk is reconstructed as in a build; then its pose and scale (log-normal, 0.3) are discarded before it is added,
and joint windows come in a random gauge. Printed: ATE after Sim(3) alignment of the metric build and of each regauged
one, and their ratio.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json
from threadpoolctl import threadpool_limits

from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory
from list3r.frames.base import Frame
from list3r.frames.chunking.chunks import plan_chunks
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult, FrameSamples, JointWindow, Keyframe, LocalInstance
from list3r.memory.store.store import Store
from list3r.pipeline.chunks.chunk import ChunkTask, process_parts
from list3r.pipeline.mapping import add_chunk, finish_session
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.workers import OrderedPool, default_workers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, required=True)
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--frames", type=int, help="only the first so many")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    options, settings = SourceOptions(), BuildSettings("rgbd", keep_pictures=False)
    source = open_source(args.source, options)
    count = min(source.info.frame_count, args.frames or source.info.frame_count)
    tasks = [ChunkTask(str(args.source), options, span, settings) for span in plan_chunks(count, settings.chunks)]
    with OrderedPool(process_parts, default_workers()) as pool:
        results = [parts[-1] for parts in pool.map(tasks)]
    frames = [f for f in source.read(0, count) if isinstance(f, Frame) and f.T_source_cam is not None]
    truth = Trajectory(np.array([f.time_s for f in frames]), np.stack([np.asarray(f.T_source_cam) for f in frames]))
    with threadpool_limits(1):
        rows = [measure("metric", results, truth, args.source, None)]
        rows += [measure(f"seed {n}", results, truth, args.source, int(n)) for n in args.seeds.split(",")]
    for row in rows:
        row["ratio_to_se3"] = round(row["ate_sim3_m"] / rows[0]["ate_se3_m"], 4)
        row["ratio_to_sim3"] = round(row["ate_sim3_m"] / rows[0]["ate_sim3_m"], 4)
        print("  ".join(f"{k} {v}" for k, v in row.items()))
    print(machine())
    write_json(args.json, {"source": args.source.name, "frames": count, "runs": rows})


def measure(
    name: str, results: Sequence[ChunkResult], truth: Trajectory, path: Path, seed: int | None
) -> dict[str, Any]:
    """Associate the chunks, in gauges drawn from the seed, and compare the trajectory with the truth."""
    from list3r.association.revisits.joint_source import JointSourceReconstructor
    from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor

    rng = None if seed is None else np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as scratch, Store.create(Path(scratch) / "memory.l3r") as store:
        with store.transaction():
            store.facts.scale_kind = "metric" if rng is None else "relative"
            store.facts.poses = "estimate"
            session = store.sessions.add(str(path), "", {}, len(truth.time_s))
        sources = {s.session_id: s.source for s in store.sessions.all()}
        joint = JointSourceReconstructor(sources, {}, RgbdReconstructor(poses="estimate"))
        for result in results:
            if rng is None:
                add_chunk(store, session, result, library=False)
            else:
                add_chunk(store, session, regauge(result, _random(rng)), _Regauged(joint, rng), library=False)
        finish_session(store, session, library=False)
        poses = store.trajectory.poses()
        times = np.array([f.time_s for f, _ in poses])
        matrices = np.tile(np.eye(4), (len(poses), 1, 1))
        matrices[:, :3, :3] = [S.rotation for _, S in poses]
        matrices[:, :3, 3] = [S.translation for _, S in poses]
        errors = evaluate_trajectory(truth, Trajectory(times, matrices))
        loops = [e for e in store.edges.all() if e.kind == "loop"]
        return {
            "gauge": name,
            "posed": len(poses),
            "components": len({c.component for c in store.chunks.all()}),
            "ate_sim3_m": round(errors.ate_sim3_m.rmse, 5),
            "ate_se3_m": round(errors.ate_se3_m.rmse, 5),
            "loops": sum(e.accepted for e in loops),
            "candidates": len(loops),
        }


class _Regauged:
    """A joint reconstructor with windows in a random gauge."""

    def __init__(self, inner: Any, rng: np.random.Generator) -> None:
        self._inner, self._rng = inner, rng

    def __call__(
        self, u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]
    ) -> JointWindow | None:
        window = self._inner(u_session, u_frames, v_session, v_frames)
        if window is None:
            return None
        S = _random(self._rng)
        return JointWindow(_samples(window.u, S), _samples(window.v, S), "relative")


def _random(rng: np.random.Generator) -> Sim3:
    return Sim3.exp(np.concatenate([rng.normal(size=3), rng.normal(size=3), 0.3 * rng.normal(size=1)]))


def regauge(result: ChunkResult, S: Sim3) -> ChunkResult:
    """The same chunk in other coordinates: p_new = S p."""
    instances = tuple(_instance(i, S) for i in result.library.instances)
    return replace(
        result,
        T_chunk_cam=_cameras(result.T_chunk_cam, S),
        scale_kind="relative",
        keyframes=tuple(_keyframe(k, S) for k in result.keyframes),
        samples=_samples(result.samples, S),
        library=replace(result.library, instances=instances),
    )


def _cameras(T: np.ndarray, S: Sim3) -> np.ndarray:
    out = T.copy()
    out[:, :3, :3] = S.rotation @ T[:, :3, :3]
    out[:, :3, 3] = S.apply(T[:, :3, 3])
    return out


def _keyframe(keyframe: Keyframe, S: Sim3) -> Keyframe:
    scale = np.float32(S.scale)
    return replace(
        keyframe,
        T_chunk_cam=_cameras(keyframe.T_chunk_cam[None], S)[0],
        points_cam=keyframe.points_cam * scale,
        depth_small=keyframe.depth_small * scale,
    )


def _samples(samples: FrameSamples, S: Sim3) -> FrameSamples:
    points = S.apply(samples.points).astype(np.float32)
    return replace(samples, points=points, T_chunk_cam=_cameras(samples.T_chunk_cam, S))


def _instance(instance: LocalInstance, S: Sim3) -> LocalInstance:
    support = replace(instance.support, points=S.apply(instance.support.points).astype(np.float32))
    plane, motion = instance.plane, instance.motion
    if plane is not None:
        normal = S.rotation @ plane[:3]
        plane = np.append(normal, float(S.scale) * plane[3] - normal @ S.translation)
    if motion is not None:
        motion = replace(motion, positions=S.apply(motion.positions).astype(np.float32))
    return replace(instance, support=support, plane=plane, motion=motion)


if __name__ == "__main__":
    main()
