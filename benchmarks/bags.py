"""A large recording of a robot, read from end to end: how fast, and in how much memory.

python benchmarks/bags.py --gigabytes 1 --json benchmarks/results/bags.json

Raw pictures and depth of 640 x 480 with cameras and `/tf`, interleaved by time, are written by `rosbags` as mcap and as
db3. A process of its own opens the recording and reads all frames; the disk's own speed is that of reading the file's
bytes just before (it may lie in the system's cache both times). Speeds by processor time say what the reader costs on
a machine that is busy with other work.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json

WIDTH, HEIGHT = 640, 480
FRAME_BYTES = WIDTH * HEIGHT * 5
READ = """
import resource, sys, time
from list3r.frames.base import Frame
from list3r.frames.source import open_source
started, begun = time.monotonic(), time.process_time()
source = open_source(sys.argv[1])
opened, listed, first = time.monotonic(), time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
count = sum(isinstance(f, Frame) for f in source.read(0, source.info.frame_count))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
cpu = listed - begun, time.process_time() - listed
print(opened - started, time.monotonic() - opened, *cpu, first / 1024, peak / 1024, count)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gigabytes", type=float, default=1.0)
    parser.add_argument("--kinds", default="mcap,db3")
    parser.add_argument("--json", type=Path)
    words = parser.parse_args()
    rows = []
    for kind in words.kinds.split(","):
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "walk"
            write(path, kind, int(words.gigabytes * 1e9 / FRAME_BYTES))
            rows.append({"kind": kind, **read(path)})
            print(json.dumps(rows[-1]), flush=True)
    print(machine())
    write_json(words.json, {"rows": rows})


def write(path: Path, kind: str, frames: int) -> None:
    """Write so many frames."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    rng = np.random.default_rng(0)
    color, depth = (
        rng.integers(0, 255, WIDTH * HEIGHT * 3, np.uint8),
        np.full(WIDTH * HEIGHT, 1500, "<u2").view(np.uint8),
    )

    def header(time_s: float) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=int(time_s), nanosec=round(1e9 * (time_s % 1)))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")

    def image(time_s: float, encoding: str, step: int, data: Any) -> Any:
        return types["sensor_msgs/msg/Image"](
            header=header(time_s), height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=0, step=step, data=data
        )

    k = np.array([500.0, 0, 319.5, 0, 500.0, 239.5, 0, 0, 1])
    region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        names = (("/color/image_raw", "Image"), ("/depth/image_raw", "Image"), ("/color/camera_info", "CameraInfo"))
        topics = [writer.add_connection(n, f"sensor_msgs/msg/{t}", typestore=store) for n, t in names]
        for number in range(frames):
            time_s = 100.0 + number / 30.0
            info = types["sensor_msgs/msg/CameraInfo"](
                header=header(time_s), height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=np.zeros(5), k=k,
                r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=region,
            )  # fmt: skip
            messages = (image(time_s, "rgb8", 3 * WIDTH, color), image(time_s, "16UC1", 2 * WIDTH, depth), info)
            for topic, message in zip(topics, messages, strict=True):
                writer.write(topic, int(1e9 * time_s), store.serialize_cdr(message, topic.msgtype))


def read(path: Path) -> dict[str, Any]:
    """Read a recording's bytes, then its frames in a process of its own."""
    size = sum(p.stat().st_size for p in path.iterdir())
    started = time.monotonic()
    for file in path.iterdir():
        with file.open("rb") as data:
            while data.read(2**22):
                pass
    plain_s = time.monotonic() - started
    out = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True).stdout
    opened_s, read_s, opened_cpu_s, read_cpu_s, opened_mb, peak_mb, frames = (float(v) for v in out.split())
    begun = time.process_time()
    for file in path.iterdir():
        with file.open("rb") as data:
            while data.read(2**22):
                pass
    plain_cpu_s = time.process_time() - begun
    return {
        "gigabytes": round(size / 1e9, 3),
        "frames": int(frames),
        "bytes_mb_s": round(size / 1e6 / plain_s),
        "bytes_cpu_mb_s": round(size / 1e6 / plain_cpu_s),
        "list_cpu_mb_s": round(size / 1e6 / opened_cpu_s),
        "read_cpu_mb_s": round(size / 1e6 / read_cpu_s),
        "list_s": round(opened_s, 1),
        "list_mb_s": round(size / 1e6 / opened_s),
        "read_s": round(read_s, 1),
        "read_mb_s": round(size / 1e6 / read_s),
        "opened_mb": round(opened_mb),
        "peak_mb": round(peak_mb),
    }


if __name__ == "__main__":
    main()
