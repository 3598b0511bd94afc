"""Which 64 chunks tell what holds for all of a long memory: one of each pair, a power of two as step, the least step.

    python benchmarks/sampled.py --videos corridor:1,loop:1 --chunks 140,260 --json FILE

Walks through simulated homes, there and back until there are as many chunks as are asked for, are placed and derived
as a build does (`feedforward_sim`). Of each memory up, its floor and the light are told with the sample of now
(`sample_of`), by the step of decision 0167, by that of before, and of all chunks. Up is compared with that of the true
world as the cameras see both; the light by how many instances are described in other words than by that of
all chunks.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json

from benchmarks.feedforward_sim.feedforward import FeedForwardModel, FeedForwardSettings
from benchmarks.simulation.presets import make_video
from benchmarks.simulation.video import SimulatedVideo
from list3r.association.overlap.motion import flag_dynamic
from list3r.frames.base import Camera
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.memory.description.colors import Reference
from list3r.memory.library.rows import in_light
from list3r.memory.library.rules import WORLD
from list3r.memory.overlap import summaries
from list3r.memory.overlap.planes import place_planes
from list3r.memory.store.store import Store
from list3r.memory.world import gravity
from list3r.pipeline.mapping import add_chunk, finish_session

SAMPLED = 64
LENGTH, OVERLAP = 40, 12
"""Frames of a chunk, and those that it shares with the next."""


def least_step(chunks: Sequence[Any]) -> list[Any]:
    """The sample of before decision 0167: at most 64 chunks, by the least step."""
    return list(chunks[:: max(1, -(-len(chunks) // SAMPLED))])


def power_of_two(chunks: Sequence[Any]) -> list[Any]:
    """The sample of decision 0167."""
    return list(chunks[:: 1 << ((len(chunks) - 1) // SAMPLED).bit_length()])


SAMPLES: dict[str, Callable[[Sequence[Any]], list[Any]]] = {
    "now": summaries.sample_of,
    "power of two": power_of_two,
    "least step": least_step,
    "all": list,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", default="corridor:1,loop:1,twins:2")
    parser.add_argument("--chunks", default="130,200", help="how many chunks each walk has")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    print(machine())
    rows = []
    for name in args.videos.split(","):
        preset, seed = name.split(":")
        for row in measured(preset, int(seed), [int(n) for n in args.chunks.split(",")]):
            rows.append(row)
            write_json(args.json, {"rows": rows})


def measured(preset: str, seed: int, counts: list[int]) -> Iterator[dict[str, Any]]:
    """A row for each sample, of a walk when it has so many chunks; the session ends with the last."""
    video = there_and_back(make_video(preset, seed), max(counts) * (LENGTH - OVERLAP) + OVERLAP)
    model = FeedForwardModel(video, FeedForwardSettings(), seed=seed)
    spans = plan_chunks(len(video.time_s), ChunkSettings(LENGTH, OVERLAP), ())
    with tempfile.TemporaryDirectory() as scratch, Store.create(Path(scratch) / "memory.l3r") as store:
        with store.transaction():
            store.facts.scale_kind, store.facts.gravity, store.facts.poses = "relative", "unknown", "estimate"
            session = store.sessions.add("simulation", "", {}, len(video.time_s))
        for number, span in enumerate(spans, start=1):
            result = model.chunk(span)
            height, width = result.image_size
            camera = Camera(width, height, *result.intrinsics)
            add_chunk(store, session, replace(result, library=flag_dynamic(result.samples, result.library, camera)))
            if number == len(spans):
                finish_session(store, session)
            if number in counts:
                for name in SAMPLES:
                    row = {"video": preset, "seed": seed, "chunks": number, "sample": name, **told(store, video, name)}
                    print("  ".join(f"{k} {v}" for k, v in row.items()), flush=True)
                    yield row


def there_and_back(video: SimulatedVideo, frames: int) -> SimulatedVideo:
    """The same walk there, back and there again, until it has so many frames."""
    count = len(video.time_s)
    lap = np.concatenate([np.arange(count), np.arange(count - 2, 0, -1)])
    at, step = np.resize(lap, frames), float(video.time_s[1] - video.time_s[0])
    rows = {name: getattr(video, name)[at] for name in ("T_world_cam", "depth", "ids")}
    return replace(video, time_s=np.arange(frames, dtype=np.float64) * step, cuts=(), **rows)


def told(store: Store, video: Any, name: str) -> dict[str, Any]:
    """What a sample tells of a memory."""
    sample, known = SAMPLES[name], summaries.chunk_summaries(store)
    chunks = store.chunks.all()
    first = min(c.component for c in chunks)
    inside = [c for c in chunks if c.component == first]
    rows = sample(inside)
    planes = place_planes([(known.planes(c.chunk_id), c.S_world_chunk) for c in rows])
    summaries.sample_of = SAMPLES["all"]  # type: ignore[assignment]
    unit = summaries.world_unit(rows, known)
    found = gravity.gravity_from_planes(planes, summaries.cameras_of(store, rows), unit)
    light = summaries.light_of(sample(chunks), known)
    words, others = (described(store, x) for x in (light, summaries.light_of(chunks, known)))
    summaries.sample_of = SAMPLES["now"]  # type: ignore[assignment]
    return {
        "sampled": len(rows),
        "status": found.status,
        "up_error_deg": round(_up_error(store, video, found.up, {c.chunk_id for c in inside}), 4),
        "floor": None if found.floor_height is None else round(found.floor_height / unit, 4),
        "unit": round(unit, 5),
        "light": [round(float(x), 3) for x in np.ravel(np.concatenate([np.ravel(v) for v in vars(light).values()]))],
        "other_words": sum(words[k] != others[k] for k in words),
        "instances": len(words),
    }


def described(store: Store, light: Reference) -> dict[int, str]:
    """The words for all instances in a light."""
    world = store.facts[WORLD]
    assert world is not None
    looks, metric = {x.instance: x for x in store.library.looks.all()}, store.facts.scale_kind != "relative"
    out = {}
    for i in store.instances.all():
        anew = in_light(i, looks[i.id], replace(world, light=light), metric=metric)
        out[i.id] = i.description if anew is None else anew.description
    return out


def _up_error(store: Store, video: Any, up: np.ndarray, chunks: set[int]) -> float:
    """Degrees between up as it was told and that of the true world, as the cameras see both, in the mean.

    By how they are turned and not by where they are: those of a corridor lie on a line.
    """
    placed = [(f.frame_index, S.rotation) for f, S in store.trajectory.poses() if f.chunk_id in chunks]
    there = np.mean([video.T_world_cam[k, :3, :3] @ R.T @ up for k, R in placed], axis=0)
    return float(np.degrees(np.arccos(np.clip(there[2] / np.linalg.norm(there), -1.0, 1.0))))


if __name__ == "__main__":
    main()
