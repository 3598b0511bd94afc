"""Matching of colour frames that cannot be tracked: SIFT and ALIKED by the same code.

    python benchmarks/links.py --source ../shared/data/redkitchen --intrinsics 525,525,320,240 --every 20 \
        --weights ../shared/weights --json benchmarks/results/links.json

For each step and each start the poses of the frames as one chunk, without dense depth: frames in the largest part,
frames in all parts of at least eight, number of parts, ATE of each such part after Sim(3), and CPU seconds.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from machine import machine, write_json

from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory
from list3r.frames.base import Frame, guessed_camera
from list3r.frames.options import parse_distortion, parse_intrinsics
from list3r.frames.source import SourceOptions, open_source
from list3r.memory.core.errors import TrackingError
from list3r.reconstruction.features.detectors import make_detector
from list3r.reconstruction.features.learned import LearnedDetector
from list3r.reconstruction.sfm.frame_poses import PosedSegment
from list3r.reconstruction.sfm.reconstructor import SfmReconstructor

FILES = {"aliked": "aliked/aliked-t16.pth"}
LEAST = 8
"""Frames of a part that counts."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, required=True)
    parser.add_argument("--intrinsics")
    parser.add_argument("--distortion")
    parser.add_argument("--every", default="20", help="steps, by commas")
    parser.add_argument("--starts", default="0", help="first frames, by commas")
    parser.add_argument("--kinds", default="sift,aliked")
    parser.add_argument("--weights", type=Path, help="folder with aliked/")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rows = []
    for kind in args.kinds.split(","):
        detector = None if kind == "sift" else make_detector(kind, args.weights / FILES[kind])
        for every in (int(n) for n in args.every.split(",")):
            for start in (int(n) for n in args.starts.split(",")):
                rows.append({"kind": kind, "every": every, "start": start, **_measured(args, every, start, detector)})
                print(rows[-1], flush=True)
    print(machine())
    write_json(args.json, {"source": args.source.name, "rows": rows})


def _measured(args: argparse.Namespace, every: int, start: int, detector: LearnedDetector | None) -> dict[str, Any]:
    options = SourceOptions(
        every=every,
        start=start,
        intrinsics=parse_intrinsics(args.intrinsics) if args.intrinsics else None,
        distortion=parse_distortion(args.distortion) if args.distortion else None,
    )
    source = open_source(args.source, options)
    frames = [f for f in source.read(0, source.info.frame_count) if isinstance(f, Frame)]
    grays = [np.asarray(cv2.cvtColor(f.color, cv2.COLOR_RGB2GRAY), np.uint8) for f in frames]
    camera = source.info.camera or guessed_camera(source.info)
    model, before = SfmReconstructor(detector=detector), time.process_time()
    try:
        segments = model._segments(frames, grays, camera)
    except TrackingError as error:
        return {"frames": len(frames), "posed": 0, "parts": 0, "said": str(error)}
    parts = [s for s in segments if len(s.T_map_cam) >= LEAST]
    return {
        "frames": len(frames),
        "largest": len(segments[0].T_map_cam),
        "posed": sum(len(s.T_map_cam) for s in parts),
        "parts": len(segments),
        "ate_sim3_m": [_ate(s, frames) for s in parts],
        "cpu_s": round(time.process_time() - before, 1),
    }


def _ate(segment: PosedSegment, frames: list[Frame]) -> float | None:
    """ATE after Sim(3), metres; None without enough true poses."""
    T_true = {k: frames[k].T_source_cam for k in sorted(segment.T_map_cam)}
    keys = [k for k, T in T_true.items() if T is not None and np.isfinite(T).all()]
    if len(keys) < 4:
        return None
    times = np.array(keys) / 30.0
    true = Trajectory(times, np.stack([np.asarray(T_true[k]) for k in keys]))
    made = Trajectory(times, np.stack([segment.T_map_cam[k] for k in keys]))
    return round(float(evaluate_trajectory(true, made).ate_sim3_m.rmse), 4)


if __name__ == "__main__":
    main()
