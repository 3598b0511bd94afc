"""Ten hours as a million frames: memory and time of listing them, of the plan of chunks, and of a frame at the end.

    python benchmarks/long_plan.py [--frames 1000000] [--kinds list,video] [--json FILE]

`list` is a folder whose list of frames names a hundred tiny pictures over and over, `video` a file of tiny pictures
copied over and over. Each is measured in its own process. The plan is that of a resumed build with known cuts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import av
import cv2
import numpy as np
from machine import machine, write_json

RATE = 1_000_000 / 36_000
MEASURE = """
import json, resource, sys, time
from dataclasses import replace
from pathlib import Path
from list3r.frames.base import Frame
from list3r.memory.store.store import Store
from list3r.pipeline.build import begin_session
from list3r.pipeline.request import RunOptions, Watch
from list3r.pipeline.session import prepare, plan_session
from list3r.pipeline.settings import BuildSettings
def mb():
    return round(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20)
source, out = sys.argv[1:]
rows, begun = {"before_mb": mb()}, time.process_time()
job = prepare(source, None, BuildSettings(), RunOptions())
rows |= {"frames": job.info.frame_count, "listed_mb": mb(), "listed_cpu_s": round(time.process_time() - begun, 1)}
store = Store.create(Path(out))
session = begin_session(store, job)
with store.transaction():
    store.sessions.put(replace(store.sessions.get(session), cuts=(), depth_step=1))
job = replace(job, options=replace(job.options, intrinsics=(60.0, 60.0, 31.5, 23.5)))
begun = time.process_time()
plan = plan_session(store, session, job, Watch())
rows |= {"chunks": len(plan.spans), "planned_mb": mb(), "planned_cpu_s": round(time.process_time() - begun, 1)}
begun, last = time.process_time(), job.info.frame_count - 1
read = [f for f in job.frames().read(last, last + 1) if isinstance(f, Frame)]
rows |= {"last": read[0].index, "last_cpu_s": round(time.process_time() - begun, 2), "end_mb": mb()}
rows["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
print(json.dumps(rows))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--kinds", default="list,video")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for kind in args.kinds.split(","):
        with tempfile.TemporaryDirectory() as scratch:
            source = WRITERS[kind](Path(scratch) / "source", args.frames)
            command = [sys.executable, "-c", MEASURE, str(source), str(Path(scratch) / "memory.l3r")]
            out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        rows.append({"kind": kind, **json.loads(out.splitlines()[-1])})
        print(json.dumps(rows[-1]), flush=True)
    print(machine())
    write_json(args.json, {"rows": rows})


def write_list(root: Path, frames: int) -> Path:
    """Write a folder as a live session keeps it."""
    (root / "p").mkdir(parents=True)
    for k, picture in enumerate(_pictures()):
        cv2.imwrite(str(root / f"p/{k:02d}.jpg"), picture)
    with (root / "frames.txt").open("w", encoding="utf-8") as file:
        file.writelines(f"{k / RATE:.4f} p/{k % 100:02d}.jpg\n" for k in range(frames))
    return root


def write_video(root: Path, frames: int) -> Path:
    """Write a file of a hundred pictures, copied until there are enough."""
    root.mkdir()
    once, path = root / "once.mp4", root / "walk.mp4"
    with av.open(str(once), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for picture in _pictures():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
    with av.open(str(once)) as container, av.open(str(path), "w") as out:
        copy = out.add_stream_from_template(container.streams.video[0])
        packets = [
            (bytes(p), p.pts, p.dts, p.duration, p.is_keyframe) for p in container.demux(video=0) if p.dts is not None
        ]
        length = sum(duration or 0 for _, _, _, duration, _ in packets)
        unit = container.streams.video[0].time_base
        for k in range(frames):
            data, pts, dts, duration, key = packets[k % len(packets)]
            packet = av.Packet(data)
            packet.pts, packet.dts = pts + k // len(packets) * length, dts + k // len(packets) * length
            packet.duration, packet.is_keyframe, packet.time_base, packet.stream = duration, key, unit, copy
            out.mux(packet)
    return path


WRITERS = {"list": write_list, "video": write_video}


def _pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (64, 48)) for _ in range(100)]


if __name__ == "__main__":
    main()
