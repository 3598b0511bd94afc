"""Speed and memory of reading a large recording of a robot.

python benchmarks/bags.py --gigabytes 1 --json benchmarks/results/bags.json

Raw pictures and depth of 640 x 480 with a camera and `/tf`, interleaved by time, are written by `rosbags` as mcap and
db3, as mcap with compressed chunks (`-zstd`), and as a bag of ROS 1 compressed by LZ4. A separate process opens the
recording and reads all frames; the disk's own speed is that of reading the file's bytes just before (it may be in the
system's cache both times). Speeds by processor time are the reader's cost on a busy machine.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
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
    parser.add_argument("--kinds", default="mcap,db3,mcap-zstd,bag-lz4")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for kind in args.kinds.split(","):
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "walk"
            path = write(path, kind, int(args.gigabytes * 1e9 / FRAME_BYTES))
            rows.append({"kind": kind, **read(path)})
            print(json.dumps(rows[-1]), flush=True)
    print(machine())
    write_json(args.json, {"rows": rows})


def write(path: Path, kind: str, frames: int) -> Path:
    """Write so many frames; return the recording."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    first = kind.startswith("bag")
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    if first:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    packed = store.serialize_ros1 if first else store.serialize_cdr
    types = store.types
    rng = np.random.default_rng(0)
    color, depth = (
        rng.integers(0, 255, WIDTH * HEIGHT * 3, np.uint8),
        np.full(WIDTH * HEIGHT, 1500, "<u2").view(np.uint8),
    )

    def header(time_s: float) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=int(time_s), nanosec=round(1e9 * (time_s % 1)))
        number = {"seq": 0} if first else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **number)

    def place(time_s: float) -> Any:
        moved = types["geometry_msgs/msg/Vector3"](x=0.1 * (time_s - 100.0), y=0.0, z=0.0)
        turned = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        T = types["geometry_msgs/msg/Transform"](translation=moved, rotation=turned)
        head = replace(header(time_s), frame_id="map")
        step = types["geometry_msgs/msg/TransformStamped"](header=head, child_frame_id="camera", transform=T)
        return types["tf2_msgs/msg/TFMessage"](transforms=[step])

    def image(time_s: float, encoding: str, step: int, data: Any) -> Any:
        return types["sensor_msgs/msg/Image"](
            header=header(time_s), height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=0, step=step, data=data
        )

    k = np.array([500.0, 0, 319.5, 0, 500.0, 239.5, 0, 0, 1])
    region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    names = [("/color/image_raw", "Image"), ("/depth/image_raw", "Image"), ("/color/camera_info", "CameraInfo")]
    topics_of = [*((n, f"sensor_msgs/msg/{t}") for n, t in names), ("/tf", "tf2_msgs/msg/TFMessage")]
    path = path.with_suffix(".bag") if first else path
    with writer_of(path, kind) as writer:
        topics = [writer.add_connection(n, t, typestore=store) for n, t in topics_of]
        for number in range(frames):
            time_s = 100.0 + number / 30.0
            lens = dict(
                zip("DKRP" if first else "dkrp", (np.zeros(5), k, np.eye(3).ravel(), np.zeros(12)), strict=True)
            )
            info = types["sensor_msgs/msg/CameraInfo"](
                header=header(time_s), height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", **lens,
                binning_x=0, binning_y=0, roi=region,
            )  # fmt: skip
            pictures = (image(time_s, "rgb8", 3 * WIDTH, color), image(time_s, "16UC1", 2 * WIDTH, depth))
            for topic, message in zip(topics, (*pictures, info, place(time_s)), strict=True):
                writer.write(topic, int(1e9 * time_s), packed(message, topic.msgtype))
    return path


def writer_of(path: Path, kind: str) -> Any:
    """Return the writer of a kind of recording."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    if kind.startswith("bag"):
        first = Writer1(path)
        first.set_compression(Writer1.CompressionFormat.LZ4)
        return first
    plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
    writer = Writer(path, version=9, storage_plugin=plugin)
    if kind.endswith("-zstd"):
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    return writer


def read(path: Path) -> dict[str, Any]:
    """Read a recording's bytes, then its frames in a process of its own."""
    files = list(path.iterdir()) if path.is_dir() else [path]
    size = sum(p.stat().st_size for p in files)
    started = time.monotonic()
    for file in files:
        with file.open("rb") as data:
            while data.read(2**22):
                pass
    plain_s = time.monotonic() - started
    out = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True).stdout
    opened_s, read_s, opened_cpu_s, read_cpu_s, opened_mb, peak_mb, frames = (float(v) for v in out.split())
    begun = time.process_time()
    for file in files:
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
