"""Dense depth from colour alone, held against a depth sensor: how much, how right, how sure, how fast.

    python benchmarks/mvs.py --source PATH [--start 0 320 600] [--frames 100] [--poses sfm|rgbd|given]
                             [--device cuda] [--json FILE]

The sensor's depth is used for comparing only, after one scale for each run of frames; `--poses rgbd` takes the camera's
poses from it too, which leaves the stereo as the only source of error. Prints the share of pixels with depth, the
median relative error, the error by tenths of confidence and CPU seconds: of all with `--poses sfm`, which maps a chunk
and chooses the frames that get depth as a build does, of the stereo alone otherwise. `--device cuda` runs the same
frames on the CPU and on the GPU and compares.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from machine import machine, write_json
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame, FrameSource
from list3r.frames.chunking.borrowing import frames_around
from list3r.frames.chunking.pace import depth_step
from list3r.frames.options import SourceOptions, parse_intrinsics
from list3r.frames.source import open_source
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.mvs.stereo import PosedFrames, dense_depth
from list3r.reconstruction.registry import ModelOptions, make_reconstructor
from list3r.reconstruction.sfm.reconstructor import SfmReconstructor

Poses = NDArray[np.float64]


def reconstructed(
    source: FrameSource, frames: list[Frame], span: tuple[int, int], camera: Camera, every: int
) -> tuple[list[Frame], Reconstruction]:
    """The largest part of a chunk by `sfm`, as a build makes it: with frames around, and depth of every n-th frame."""
    model = make_reconstructor("sfm", ModelOptions())
    assert isinstance(model, SfmReconstructor)
    around = partial(frames_around, source, span, (0, source.info.frame_count))
    deep = {f.index for k, f in enumerate(frames, span[0]) if k % every == 0}
    found = max(model.parts(frames, camera, around, deep), key=lambda part: int(part.posed.sum()))
    held = set(found.frame_indices.tolist())
    return [f for f in frames if f.index in held], found


def poses_of(frames: list[Frame], camera: Camera, kind: str) -> tuple[NDArray[np.bool_], Poses]:
    """Which frames have a pose, and the poses, from the source or from its depth."""
    if kind == "given":
        known = [f.T_source_cam is not None and bool(np.isfinite(f.T_source_cam).all()) for f in frames]
        T = [
            f.T_source_cam if ok and f.T_source_cam is not None else np.eye(4)
            for f, ok in zip(frames, known, strict=True)
        ]
        return np.array(known), np.stack(T)
    found = make_reconstructor(kind, ModelOptions())(frames, camera)
    return found.posed, found.T_chunk_cam


def against_sensor(depth: NDArray[np.float32], confidence: NDArray[np.float16], frames: list[Frame]) -> dict[str, Any]:
    """Coverage and errors after one scale, on every third pixel."""
    sensor = np.stack([np.zeros(depth.shape[1:], np.float32) if f.depth is None else f.depth for f in frames])
    d, c, s = (a[:, 1::3, 1::3].astype(np.float64) for a in (depth, confidence, sensor))
    both = (d > 0) & (s > 0)
    out: dict[str, Any] = {"coverage": round(float((d > 0).mean()), 4)}
    if not both.any():
        return out
    ratio = d[both] / s[both]
    scale = float(np.median(ratio))
    error = np.abs(ratio / scale - 1.0)
    order = np.argsort(c[both], kind="stable")
    tenths = [
        {"confidence": round(float(c[both][k].mean()), 3), "median_error": round(float(np.median(error[k])), 4)}
        for k in np.array_split(order, 10)
    ]
    return {
        **out,
        "coverage_where_sensor_reads": round(float((d > 0)[s > 0].mean()), 4),
        "scale": round(scale, 4),
        "median_error": round(float(np.median(error)), 4),
        "share_above_10_percent": round(float((error > 0.1).mean()), 4),
        "by_confidence": tenths,
    }


def compare_devices(frames: list[Frame], posed: NDArray[np.bool_], T: Poses, camera: Camera) -> dict[str, Any]:
    """The same frames on CPU and GPU: seconds, and how far the depths are apart."""
    if not torch.cuda.is_available():
        return {"skipped": "no CUDA device here"}
    seconds, depths = {}, {}
    for device in ("cuda", "cpu", "cuda"):  # the first run loads the kernels
        begin = time.perf_counter()
        depths[device], _ = dense_depth(PosedFrames(frames, posed, T, camera), None, device)
        torch.cuda.synchronize()
        seconds[device] = round((time.perf_counter() - begin) / len(frames), 4)
    both = (depths["cpu"] > 0) & (depths["cuda"] > 0)
    apart = np.abs(depths["cuda"][both] / depths["cpu"][both] - 1.0)
    return {
        "gpu": torch.cuda.get_device_name(),
        "wall_s_per_frame": seconds,
        "same_coverage": round(float(((depths["cpu"] > 0) == (depths["cuda"] > 0)).mean()), 5),
        "share_within_0_1_percent": round(float((apart < 1e-3).mean()), 5),
    }


def run(path: str, options: SourceOptions, args: argparse.Namespace) -> dict[str, Any]:
    """Measure each run of frames."""
    source = open_source(path, options)
    camera = source.info.camera
    if camera is None:
        raise SystemExit("the intrinsics of the source are unknown; give --intrinsics fx,fy,cx,cy")
    every = args.depth_every or depth_step(source, args.frames)
    rows = []
    for start in args.start:
        span = start, min(start + args.frames * every, source.info.frame_count)
        frames = [f for f in source.read(*span) if isinstance(f, Frame)]
        begin = time.process_time()
        if args.poses == "sfm":
            deep, made = reconstructed(source, frames, span, camera, every)
            posed, T, used, depth, confidence = made.posed, made.T_chunk_cam, made.camera, made.depth, made.confidence
        else:
            deep, used = frames[::every], camera
            posed, T = poses_of(deep, camera, args.poses)
            begin = time.process_time()
            depth, confidence = dense_depth(PosedFrames(deep, posed, T, camera))
        spent = time.process_time() - begin
        row = {"start": start, "frames": len(frames), "with_depth": len(deep), "posed": int(posed.sum())}
        row |= {"cpu_s": round(spent, 1), **against_sensor(depth, confidence, deep)}
        if args.device == "cuda":
            row["devices"] = compare_devices(deep, posed, T, used)
        print(json.dumps(row), flush=True)
        rows.append(row)
    mean = {
        name: round(float(np.mean([row[name] for row in rows])), 4)
        for name in ("coverage", "median_error", "cpu_s")
        if all(name in row for row in rows)
    }
    return {"source": Path(path).name, "poses": args.poses, "depth_every": every, "mean": mean, "runs": rows}


def main() -> None:
    """Parse arguments, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", required=True, help="folder of RGB-D frames that `list3r inspect` recognises")
    parser.add_argument("--start", type=int, nargs="+", default=[0], help="first frame of each run")
    parser.add_argument("--frames", type=int, default=100, help="frames of a run that get depth")
    parser.add_argument("--depth-every", type=int, help="depth of every n-th frame; default: as a build does")
    parser.add_argument("--poses", choices=("sfm", "rgbd", "given"), default="sfm", help="where the poses come from")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="cuda compares CPU and GPU")
    parser.add_argument("--intrinsics", help="fx,fy,cx,cy of the colour camera where the source does not give it")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    options = SourceOptions(intrinsics=parse_intrinsics(given.intrinsics) if given.intrinsics else None)
    print(machine())
    figures = run(given.source, options, given)
    print(json.dumps(figures["mean"]))
    write_json(given.json, figures)


if __name__ == "__main__":
    main()
