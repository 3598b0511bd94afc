"""An hour of video on a CPU: memory and time of listing it, of looking through it for cuts, and of its first chunks.

    python benchmarks/long_video.py --source FOLDER [--minutes 60] [--every 15] [--chunks 3] [--json FILE]

The video is made of the colour pictures of a folder (such as redkitchen), there and back again, 30 a second. Memory is
the sum over all processes, pages shared by several counted once.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
from machine import _resident, descendants, write_json

from list3r.frames.source import SourceOptions, open_source
from list3r.pipeline.build import build
from list3r.pipeline.request import Watch
from list3r.pipeline.settings import BuildSettings


class _EnoughError(Exception):
    """The first chunks are in the memory."""


def write_video(pictures: list[Path], path: Path, minutes: float) -> int:
    """The pictures there and back again, encoded once and copied until so many minutes are full; frames in the file."""
    once = path.with_name("once.mp4")
    with av.open(str(once), "w") as container:
        first = cv2.imread(str(pictures[0]))
        stream = container.add_stream("libx264", rate=30)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"preset": "veryfast", "crf": "28", "g": "120", "bf": "2"}
        for picture in [*pictures, *pictures[-2:0:-1]]:
            image = cv2.imread(str(picture))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())
    frames, shift, wanted = 0, 0, int(minutes * 60 * 30)
    with av.open(str(path), "w") as out:
        copy = None
        while frames < wanted:
            with av.open(str(once)) as container:
                copy = copy or out.add_stream_from_template(container.streams.video[0])
                length = 0
                for packet in container.demux(video=0):
                    if packet.dts is None or packet.pts is None:
                        continue
                    length += packet.duration or 0
                    packet.pts, packet.dts, packet.stream = packet.pts + shift, packet.dts + shift, copy
                    out.mux(packet)
                    frames += 1
                shift += length
    once.unlink()
    return frames


def resident_mb() -> float:
    """Of this process and all that it started."""
    return round(sum(_resident(pid) for pid in [os.getpid(), *descendants(os.getpid())]) / 1e6, 1)


def measure(video: Path, memory: Path, every: int, chunks: int) -> dict[str, Any]:
    """List the video, scan it and build its first chunks."""
    at_start, begun, cpu = resident_mb(), time.monotonic(), time.process_time()
    source = open_source(video)
    listing = {
        "frames": source.info.frame_count,
        "mb_before": at_start,
        "mb": resident_mb(),
        "cpu_s": round(time.process_time() - cpu, 2),
    }
    del source
    scan: list[dict[str, float]] = []
    added: list[dict[str, float]] = []
    begun, cpu = time.monotonic(), time.process_time()
    seconds: Callable[[], float] = lambda: round(time.monotonic() - begun, 1)  # noqa: E731

    def look(what: str, done: int, total: int) -> None:
        if what == "cuts" and done * 10 // total > len(scan) - 1:
            scan.append({"frames": done, "wall_s": seconds(), "cpu_s": time.process_time() - cpu, "mb": resident_mb()})

    def progress(done: int, total: int) -> None:
        added.append({"frames": done, "of": total, "wall_s": seconds(), "mb": resident_mb()})
        if len(added) > chunks:
            raise _EnoughError

    settings = BuildSettings("sfm", "estimate", device="cpu")
    try:
        build(video, memory, options=SourceOptions(every=every), settings=settings, watch=Watch(progress, look))
    except _EnoughError:
        pass
    return {"listing": listing, "scan": scan, "chunks": added, "memory_file_mb": round(memory.stat().st_size / 1e6, 1)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, required=True, help="folder of pictures")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--every", type=int, default=15, help="take every n-th frame for the chunks")
    parser.add_argument("--chunks", type=int, default=3, help="stop after so many")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    pictures = sorted(args.source.glob("*color*")) or sorted(args.source.glob("*.jpg"))
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "long.mp4"
        frames = write_video(pictures, video, args.minutes)
        print(f"{frames} frames, {video.stat().st_size / 1e6:.0f} MB", flush=True)
        found = measure(video, Path(folder) / "long.l3r", args.every, args.chunks)
    print(f"listing   {found['listing']}")
    for row in found["scan"]:
        print(f"cuts      {row['frames']:7.0f} frames, {row['cpu_s']:6.1f} CPU s, {row['mb']:6.1f} MB")
    for row in found["chunks"]:
        print(f"chunks    {row['frames']:7.0f} of {row['of']:.0f} frames, {row['wall_s']:6.1f} s, {row['mb']:6.1f} MB")
    write_json(args.json, {"benchmark": "long_video", "minutes": args.minutes, "every": args.every, **found})


if __name__ == "__main__":
    main()
