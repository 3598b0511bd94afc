"""Accuracy and speed of the rgbd reconstruction's tracking, without loops.

PYTHONPATH=. python benchmarks/odometry.py --seeds 7301-7340 --json benchmarks/results/odometry.json
PYTHONPATH=. python benchmarks/odometry.py --house FOLDER/aws-robomaker-small-house-world --seeds 1-6
PYTHONPATH=. python benchmarks/odometry.py --source .../redkitchen [--beside-open3d]

Walks of 120 frames, nine a second, through left-out rooms of `training/worlds` or the house, with a sensor's noise and
an exposure that changes; or the chunks of a source with poses. An error is that of the motion over eight frames that
all have a pose, as distance and angle; more than 5 cm is a slip. With `--beside-open3d` Open3D's dense frame-to-model
tracking (`t.pipelines.slam`) follows the same frames.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from discovery import seeds_of
from machine import machine, write_json
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.frames.source import open_source
from list3r.memory.core.errors import SourceError, TrackingError
from list3r.reconstruction.poses import angle_deg
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from training.worlds.film import FilmSettings, frames_of, make_film

Poses = NDArray[np.float64]
FRAMES = 120
APART = 8
"""Frames over which a motion is compared."""
SLIP_M = 0.05
SENSORS = ("structured", "lidar", "tof")


@dataclass(frozen=True)
class Walk:
    """Frames with known poses, not finite where unknown."""

    name: str
    frames: list[Frame]
    camera: Camera
    T_world_cam: Poses
    """Shape (F, 4, 4)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="7301-7340", help="such as 1-3,7")
    parser.add_argument("--house", type=Path, help="folder of a Gazebo world; walks there")
    parser.add_argument("--source", type=Path, help="RGB-D frames that know their poses")
    parser.add_argument("--beside-open3d", action="store_true", help="run Open3D's tracking too, if it is installed")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    methods: dict[str, Callable[[Walk], tuple[Poses, NDArray[np.bool_]]]] = {"rgbd": follow}
    if args.beside_open3d:
        methods["open3d"] = follow_by_open3d
    rows: list[dict[str, Any]] = []
    for walk in chunks_of(args.source) if args.source else filmed(seeds_of(args.seeds), args.house):
        for name, method in methods.items():
            rows.append({"method": name, "walk": walk.name, **measure(walk, method)})
            print(json.dumps(rows[-1]), flush=True)
    if not any(r["compared"] for r in rows):
        raise SystemExit(
            "no walk has frames with a pose to compare; is there depth, and does the source know its poses?"
        )
    table = {name: summary([r for r in rows if r["method"] == name]) for name in methods}
    print(machine())
    print(json.dumps(table, indent=1))
    write_json(args.json, {"apart": APART, "slip_m": SLIP_M, "mean": table, "walks": rows})


def filmed(seeds: Sequence[int], house: Path | None) -> Iterator[Walk]:
    """Walks through rooms or a house."""
    for seed in seeds:
        sensor = SENSORS[seed % 3]
        if house is not None:
            from training.worlds.gazebo import film_house

            try:
                film = film_house(house, seed, sensor, FRAMES, 1)
            except SourceError as error:
                print(error, flush=True)
                continue
        else:
            film = make_film(FilmSettings(seed, held_out=True, frames=FRAMES, every=1, sensor=sensor))
        yield Walk(f"{seed} {sensor}", frames_of(film), film.camera, film.T_world_cam)


def chunks_of(path: Path) -> Iterator[Walk]:
    """The chunks of a source."""
    source = open_source(path)
    camera, missing = source.info.camera, np.full((4, 4), np.nan)
    if camera is None:
        raise SystemExit(f"{path} has no camera; give frames with depth, poses and a camera")
    for span in plan_chunks(source.info.frame_count, ChunkSettings()):
        frames = [f for f in source.read(span.start, span.stop) if isinstance(f, Frame)]
        poses = np.stack([missing if f.T_source_cam is None else f.T_source_cam for f in frames])
        yield Walk(f"frames {span.start} to {span.stop - 1}", frames, camera, poses)


def follow(walk: Walk) -> tuple[Poses, NDArray[np.bool_]]:
    """Poses (F, 4, 4), and which frames have one."""
    found = RgbdReconstructor()(walk.frames, walk.camera)
    return found.T_chunk_cam, found.posed


def follow_by_open3d(walk: Walk) -> tuple[Poses, NDArray[np.bool_]]:
    """The same by Open3D."""
    import open3d as o3d
    import open3d.core as o3c

    device, slam, camera = o3c.Device("CPU:0"), o3d.t.pipelines.slam, walk.camera
    T, out = o3c.Tensor(np.eye(4)), []
    model = slam.Model(0.0058, 16, 40000, T, device)
    intrinsics = o3c.Tensor(camera.matrix())
    live, ray = (slam.Frame(camera.height, camera.width, intrinsics, device) for _ in range(2))
    for k, frame in enumerate(walk.frames):
        assert frame.depth is not None
        live.set_data_from_image("depth", o3d.t.geometry.Image((frame.depth * 1000).astype(np.uint16)))
        live.set_data_from_image("color", o3d.t.geometry.Image(np.ascontiguousarray(frame.color)))
        if k:
            T = T @ model.track_frame_to_model(live, ray, 1000.0, 5.0, 0.07).transformation
        model.update_frame_pose(k, T)
        model.integrate(live, 1000.0, 5.0, 8.0)
        model.synthesize_model_frame(ray, 1000.0, 0.1, 5.0, 8.0, False)
        out.append(T.numpy().copy())
    return np.stack(out), np.ones(len(out), bool)


def measure(walk: Walk, method: Callable[[Walk], tuple[Poses, NDArray[np.bool_]]]) -> dict[str, Any]:
    """Errors of one walk."""
    cv2.setNumThreads(1)
    started = time.process_time()
    try:
        T, posed = method(walk)
    except TrackingError:
        T, posed = np.tile(np.eye(4), (len(walk.frames), 1, 1)), np.zeros(len(walk.frames), bool)
    spent, known = time.process_time() - started, np.isfinite(walk.T_world_cam).all(axis=(1, 2))
    shift, turn = [], []
    for a in range(len(T) - APART):
        b = a + APART
        if posed[[a, b]].all() and known[[a, b]].all():
            true = np.linalg.inv(walk.T_world_cam[a]) @ walk.T_world_cam[b]
            off = np.linalg.inv(true) @ np.linalg.inv(T[a]) @ T[b]
            shift.append(float(np.linalg.norm(off[:3, 3])))
            turn.append(angle_deg(off))
    return {
        "frames": len(T),
        "posed": int(posed.sum()),
        "compared": len(shift),
        "slipped": int((np.array(shift) > SLIP_M).sum()),
        "worst_m": round(max(shift), 4) if shift else None,
        "worst_deg": round(max(turn), 3) if turn else None,
        "median_m": round(float(np.median(shift)), 5) if shift else None,
        "median_deg": round(float(np.median(turn)), 4) if turn else None,
        "cpu_ms_per_frame": round(1000 * spent / len(T), 1),
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of all walks together."""
    medians = [r for r in rows if r["compared"]]
    frames = sum(r["frames"] for r in rows)
    return {
        "walks": len(rows),
        "posed": round(sum(r["posed"] for r in rows) / frames, 4),
        "walks_that_slip": sum(r["slipped"] > 0 for r in rows),
        "slipped": round(sum(r["slipped"] for r in rows) / max(1, sum(r["compared"] for r in rows)), 4),
        "worst_m": max(r["worst_m"] for r in medians),
        "median_m": round(float(np.mean([r["median_m"] for r in medians])), 5),
        "median_deg": round(float(np.mean([r["median_deg"] for r in medians])), 4),
        "cpu_ms_per_frame": round(sum(r["cpu_ms_per_frame"] * r["frames"] for r in rows) / frames, 1),
    }


if __name__ == "__main__":
    main()
