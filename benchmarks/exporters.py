"""Cost of every export as a memory grows: processor seconds, peak memory, bytes.

python benchmarks/exporters.py --instances 0,1,1000,100000 --json benchmarks/results/exporters.json

The memories are synthetic: objects of 60 points with labels in several scripts, six to a table, in rooms side by side,
all written through the store's verbs; every chunk keeps ten pictures, the first of which shows its objects. Each export
runs in its own process. `plan.svg` among the formats is the plan as SVG.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from machine import STARTED_AT, write_json
from PIL import Image

from list3r.exporters.registry import FORMATS
from list3r.memory.core.geometry import OrientedBox, Sim3
from list3r.memory.core.records import (
    ChunkResult,
    FrameSamples,
    Instance,
    Keyframe,
    LocalInstance,
    LocalLibrary,
    MaskTrack,
    Observation,
    Relation,
    Support,
)
from list3r.memory.store.store import Store

NAMES = ("mug", "Stuhl", "écran", "книга", "椅子", "كوب", "🪴 plant", 'a <b> & "c"')
POINTS = 60
IN_CHUNK = 2000
OPTIONS = {"simready": ("--density", "300")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", default="0,1,1000,100000")
    parser.add_argument("--formats", default=",".join([*FORMATS, "plan.svg"]))
    parser.add_argument("--limit", type=float, default=600.0, help="Processor seconds of one export, at most.")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    args = parser.parse_args()
    done = json.loads(args.json.read_text(encoding="utf-8")) if args.json and args.json.exists() else {}
    rows: list[dict[str, Any]] = done.get("rows", [])
    with tempfile.TemporaryDirectory() as folder:
        for count in (int(word) for word in args.instances.split(",")):
            known = {r["format"] for r in rows if r["instances"] == count}
            names = [n for n in args.formats.split(",") if n not in known and is_here(n)]
            memory = Path(folder) / f"made-{count}.l3r"
            if names:
                write_memory(memory, count)
            for name in names:
                rows.append({"instances": count, **measure(memory, name, Path(folder) / "out", args.limit)})
                print(rows[-1], flush=True)
                write_json(args.json, {"rows": rows})
            memory.unlink(missing_ok=True)


def is_here(name: str) -> bool:
    """Return whether the package that a format takes is installed."""
    package = FORMATS[name.split(".")[0]].package
    return not package or importlib.util.find_spec(package) is not None


def measure(memory: Path, name: str, folder: Path, limit: float) -> dict[str, Any]:
    """Export in a process of its own; returns its processor seconds, peak memory and files."""
    folder.mkdir()
    to, _, ending = name.partition(".")
    suffix = f".{ending}" if ending else (*FORMATS[to].suffixes, "")[0]
    out = folder / f"out{suffix}"
    command = [sys.executable, "-m", "list3r", "export", str(memory), "--to", to, "--out", str(out)]
    began = time.monotonic()
    process = subprocess.Popen(
        [*command, *OPTIONS.get(name, ())],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_limit(limit),
    )
    said = process.stderr.read() if process.stderr else ""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    files = [p for p in folder.rglob("*") if p.is_file()]
    row: dict[str, Any] = {
        "format": name,
        "commit": STARTED_AT,
        "done": process.returncode == 0,
        "cpu_s": round(used.ru_utime + used.ru_stime, 2),
        "wall_s": round(time.monotonic() - began, 1),
        "peak_mb": round(used.ru_maxrss / 1024),
        "files": len(files),
        "mb": round(sum(p.stat().st_size for p in files) / 1e6, 3),
    }
    if process.returncode == 2:
        row["refused"] = said.strip().splitlines()[-1]
    subprocess.run(["rm", "-r", str(folder)], check=True)
    return row


def _limit(seconds: float) -> Any:
    def limited() -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))

    return limited


def write_memory(path: Path, count: int) -> None:
    """Write a finished memory of so many objects."""
    rng = np.random.default_rng(count)
    with Store.create(path) as store, store.transaction():
        session = store.sessions.add("made", "made", {}, 10 * (count // IN_CHUNK + 1))
        store.facts.scale_kind, store.facts.scale_source, store.facts.gravity = "metric", "made", "known"
        chunks = []
        for index, first in enumerate(range(0, max(count, 1), IN_CHUNK)):
            ids = range(first + 1, min(count, first + IN_CHUNK) + 1)
            instances = [make_object(n, rng) for n in ids]
            local = tuple(local_instance(k, i, 10 * index, rng) for k, i in enumerate(instances))
            chunk = store.chunks.add(session, chunk_of(index, local))
            chunks.append(chunk)
            store.instances.put(instances)
            store.observations.set(Observation(i.id, chunk, k) for k, i in enumerate(instances))
        store.chunks.place({c: Sim3.identity() for c in chunks}, dict.fromkeys(chunks, chunks[0]))
        tables = ((n, n - (n - 1) % 7) for n in range(1, count + 1))
        on = [Relation(n, "on", table, 0.9, 0.02) for n, table in tables if n != table]
        both = [r for a in on for r in (a, Relation(a.object, "supports", a.subject, a.confidence, a.margin))]
        store.relations.replace(None, both)
        store.sessions.complete(session)


def make_object(n: int, rng: np.random.Generator) -> Instance:
    """A table, or an object on the table before it."""
    place, k = divmod(n - 1, 7)
    room = np.array([2.0 * (place % 200), 2.0 * (place // 200), 0.0])
    size = np.array([1.2, 0.8, 0.7]) if k == 0 else rng.uniform(0.05, 0.3, 3)
    center = room + ([0, 0, 0.35] if k == 0 else [*rng.uniform(-0.4, 0.4, 2), 0.7 + size[2] / 2])
    rgb = tuple(int(v) for v in rng.integers(0, 256, 3))
    return Instance(
        id=n,
        label=NAMES[n % len(NAMES)] if n % 3 else None,
        description="large brown table, 1.2 m" if k == 0 else "small red box, 20 cm",
        center=center,
        aabb=np.stack([center - size / 2, center + size / 2]),
        box=OrientedBox(center, size, np.eye(3)),
        confidence=float(rng.uniform(0.3, 1.0)),
        observations=int(rng.integers(3, 60)),
        first_seen_s=0.0,
        last_seen_s=1.0,
        state="present",
        structure=None,
        color_rgb=(rgb[0], rgb[1], rgb[2]),
        color_name="red",
        component=1,
        best_view=None,
    )


def local_instance(k: int, i: Instance, frame: int, rng: np.random.Generator) -> LocalInstance:
    """Its local instance in a chunk: points on its box, a mask in one frame."""
    unit = rng.uniform(-0.5, 0.5, (POINTS, 3))
    axis = rng.integers(0, 3, POINTS)
    unit[np.arange(POINTS), axis] = np.sign(unit[np.arange(POINTS), axis]) * 0.5
    points = (i.center + unit * i.box.size).astype(np.float32)
    support = Support(points, np.full(POINTS, 0.8, np.float32), np.tile(np.array(i.color_rgb, np.uint8), (POINTS, 1)))
    track = MaskTrack(
        frames=np.array([frame]),
        boxes_xyxy=np.array([[10, 20, 30, 30]], np.float32),
        centers_xy=np.array([[20, 25]], np.float32),
        areas_px=np.array([200], np.int32),
        visible_fraction=np.array([0.9], np.float32),
        masks=(np.array([20 * 64 + 10, 20], np.uint32),),
        image_size=(48, 64),
    )
    return LocalInstance(k, track, np.eye(1, 16, k % 16, dtype=np.float32)[0], support, stability=0.9)


def picture(frame: int) -> Keyframe:
    """A keyframe kept for its picture alone."""
    pixels = np.random.default_rng(frame).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    jpeg = io.BytesIO()
    Image.fromarray(pixels).resize((64, 48)).save(jpeg, "JPEG")
    return Keyframe(
        frame_index=frame,
        T_chunk_cam=np.eye(4),
        descriptor=np.zeros(8, np.float32),
        keypoints_xy=np.zeros((0, 2), np.float32),
        keypoint_descriptors=np.zeros((0, 32), np.uint8),
        points_cam=np.zeros((0, 3), np.float32),
        depth_small=np.zeros((0, 0), np.float32),
        camera_small=(1.0, 1.0, 0.0, 0.0),
        jpeg=jpeg.getvalue(),
    )


def chunk_of(index: int, local: tuple[LocalInstance, ...]) -> ChunkResult:
    """A chunk of ten frames, the camera at rest."""
    frames = np.arange(10 * index, 10 * index + 10)
    poses = np.tile(np.eye(4), (10, 1, 1))
    nothing = FrameSamples(
        frame=np.zeros(0, np.int64),
        pixel=np.zeros(0, np.int32),
        points=np.zeros((0, 3), np.float32),
        confidence=np.zeros(0, np.float32),
        instance=np.zeros(0, np.int32),
        camera_frames=frames,
        T_chunk_cam=poses,
    )
    return ChunkResult(
        index=index,
        frame_indices=frames,
        times_s=frames / 30.0,
        posed=np.ones(10, bool),
        T_chunk_cam=poses,
        T_source_cam=None,
        intrinsics=(60.0, 60.0, 32.0, 24.0),
        image_size=(48, 64),
        scale_kind="metric",
        keyframes=tuple(picture(int(f)) for f in frames),
        samples=nothing,
        library=LocalLibrary(local, np.zeros((0, 2), np.int32), "made@1/16"),
    )


if __name__ == "__main__":
    main()
