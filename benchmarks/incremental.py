"""Cost of one more chunk as a memory grows, in time and memory.

python benchmarks/incremental.py --json benchmarks/results/incremental.json

The chunks are synthetic (objects, floors, samples, keyframes of a walk) and go through `mapping.add_chunk` like those
of a build: edge to the chunk before, revisits, pose graph, library. Three walks: `rooms`, on into new rooms for ever;
`corridor`, along one floor; `stay`, to and fro in one room, where every chunk overlaps all others. Every chunk sees 12
objects and a floor. Memories of several sizes are made, then the same number of chunks is added to each, turn by turn.
With `--sessions 2` the memory is that of an ended session, and the added chunks are the first of a later one, which
walks the way again from its middle; its changes are derived when it ends, which is timed too (`end_s`; for a first
session that of the library alone, just after the build). `finish_s` is the whole end of a build, which also solves the
graph and the non-rigid correction of chunks; in a long chain that moves nearly all of them. `edit_s` and `undo_s` are
an operator's merge and its undo. Printed are medians: user seconds of processor time of placing (edges, revisits,
graph) and of the library, objects written anew; the growth of the process when the memory was made, and its peak then.

`--walks sessions` is another table: a first session of `--first` chunks through rooms, then 19 later ones of `--repeat`
chunks each, which all walk where the first one began (`same`), or each along its own part of the way (`apart`). A row
gives the cost of a chunk of a session, of its end, and the peak of the process.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import resource
import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json

from list3r.memory.core.records import (
    ChunkResult,
    FrameSamples,
    Keyframe,
    LocalInstance,
    LocalLibrary,
    MaskTrack,
    Support,
)
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
from list3r.pipeline import mapping

SEEN, STEP = 12, 6
"""Objects in a chunk, and how many further the next one has gone."""
SPACING_M = 0.9
FRAMES, HOP = 20, 14
SPACE = "synthetic@1/64"
SESSIONS = 20
"""Sessions of a memory that has many."""
WALKS = ("rooms", "corridor", "stay")
IMAGE = (480, 640)
LENS = (500.0, 500.0, 320.0, 240.0)
LOOKING_ALONG = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""World to camera axes: along x, level."""
SAMPLES, KEYFRAMES, WORDS = 150, 2, 384
"""Samples of a frame, keyframes of a chunk, numbers of a descriptor."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", default="10,100,1000", help="sizes of memories to which a chunk is added")
    parser.add_argument("--walks", default="rooms,corridor,stay", help="some of rooms, corridor, stay, sessions")
    parser.add_argument("--first", type=int, default=120, help="chunks of the first of many sessions")
    parser.add_argument("--stay-chunks", type=int, default=100, help="most chunks of the walk that stays")
    parser.add_argument("--repeat", type=int, default=15, help="chunks that are added to each memory and timed")
    parser.add_argument(
        "--sessions", type=int, default=1, help="2: the chunks that are added belong to a later session"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--profile", action="store_true", help="where the time of the largest memory went")
    parser.add_argument("--json", type=Path)
    words = parser.parse_args()
    found: dict[str, list[dict[str, Any]]] = {}
    print(machine())
    for name in words.walks.split(","):
        if name == "sessions":
            for kind in ("same", "apart"):
                found[f"sessions, {kind}"] = many_sessions(kind, words)
                write_json(words.json, {"walks": found})
            continue
        sizes = [int(n) for n in words.chunks.split(",") if name != "stay" or int(n) <= words.stay_chunks]
        found[name] = measure(name, sizes, words)
        for row in found[name]:
            print(f"{name}  " + "  ".join(f"{k} {v}" for k, v in row.items()), flush=True)
        write_json(words.json, {"walks": found})


def measure(name: str, sizes: list[int], words: argparse.Namespace) -> list[dict[str, Any]]:
    """Medians of chunks added to memories of several sizes, turn by turn, so that all of them meet the same machine."""
    watched = cProfile.Profile()
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        stores: dict[int, Store] = {}
        resident: dict[int, float] = {}
        peak: dict[int, float] = {}
        size_mb: dict[int, float] = {}
        for n in sizes:
            path = Path(scratch) / f"{n}.l3r"
            stores[n] = stack.enter_context(Store.create(path))
            before = resident_mb()
            begin(stores[n], n + words.repeat)
            for k in range(n):
                add(stores[n], chunk(k, name, words.seed))
            resident[n], peak[n] = round(resident_mb() - before, 1), peak_mb()
            size_mb[n] = round(path.stat().st_size / 1e6, 1)
            if words.sessions > 1:
                end(stores[n], 1)
                begin(stores[n], words.repeat)
        rows: dict[int, list[dict[str, float]]] = {n: [] for n in sizes}
        for turn in range(words.repeat):
            for n in sizes:
                result = (
                    chunk(n + turn, name, words.seed) if words.sessions == 1 else again(n // 2, turn, name, words.seed)
                )
                if words.profile and n == sizes[-1]:
                    watched.enable()
                rows[n].append(add(stores[n], result, words.sessions))
                watched.disable()
        if words.profile:
            pstats.Stats(watched).sort_stats("cumtime").print_stats(60)
        out = []
        for n in sizes:
            row: dict[str, Any] = {"chunks": n, "instances": sum(stores[n].instances.count())}
            for key in ("placing_s", "library_s", "all_s"):
                row[key] = round(float(np.median([r[key] for r in rows[n]])), 4)
            if words.sessions == 1:
                row["finish_s"], row["finish_peak_mb"] = finished(stores[n])
            row["end_s"] = end(stores[n], words.sessions)
            row["edit_s"], row["undo_s"] = edited(stores[n])
            row["written"] = int(np.median([r["written"] for r in rows[n]]))
            out.append({**row, "memory_mb": resident[n], "peak_mb": peak[n], "file_mb": size_mb[n]})
    return out


def many_sessions(kind: str, words: argparse.Namespace) -> list[dict[str, Any]]:
    """Cost of a chunk and of the end of each of many sessions."""
    out: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch, Store.create(Path(scratch) / "many.l3r") as store:
        begin(store, words.first)
        for k in range(words.first):
            add(store, chunk(k, "rooms", words.seed))
        finished(store)
        for session in range(2, SESSIONS + 1):
            begin(store, words.repeat)
            start = 0 if kind == "same" else (session - 2) * words.repeat % (words.first - words.repeat)
            rows = [
                add(store, again(start, turn, "rooms", words.seed, session), session) for turn in range(words.repeat)
            ]
            row: dict[str, Any] = {"session": session, "chunks": len(store.chunks.all())}
            row["instances"] = sum(store.instances.count())
            row |= {key: round(float(np.median([r[key] for r in rows])), 4) for key in ("library_s", "all_s")}
            row |= {"end_s": end(store, session), "peak_mb": peak_mb()}
            out.append(row)
            print(f"sessions, {kind}  " + "  ".join(f"{k} {v}" for k, v in row.items()), flush=True)
    return out


def begin(store: Store, chunks: int) -> None:
    """A session of so many chunks."""
    with store.transaction():
        store.facts.scale_kind = "metric"
        store.sessions.add("walk", "synthetic", {}, HOP * chunks + FRAMES)


def end(store: Store, session: int) -> float:
    """End a session: user seconds of the library and its changes."""
    started = user_s()
    with store.transaction():
        consolidate(store)
        store.sessions.complete(session)
    return round(user_s() - started, 3)


def finished(store: Store) -> tuple[float, float]:
    """User seconds of a build's last step, and the peak of the process: the graph of all chunks is solved with their
    non-rigid correction, and instances of moved chunks are derived again.
    """
    started = user_s()
    mapping.finish_session(store, 1)
    return round(user_s() - started, 3), peak_mb()


def edited(store: Store) -> tuple[float, float]:
    """User seconds of an operator's merge of two objects, and of its undo."""
    a, b = (i.id for i in store.instances.all(structure=False)[:2])
    started = user_s()
    edits.merge(store, a, b, "benchmark")
    merged = user_s()
    edits.undo(store, None, "benchmark")
    return round(merged - started, 3), round(user_s() - merged, 3)


def again(start: int, turn: int, name: str, seed: int, session: int = 2) -> ChunkResult:
    """Chunk `turn` of a later session: the scene of the first one from chunk `start` on, with other errors."""
    made = chunk(start + turn, name, seed)
    rng = np.random.default_rng([seed, 8, turn, session])
    off = rng.normal(0.0, 0.003, 3)
    frames = np.arange(HOP * turn, HOP * turn + FRAMES)

    def seen(found: LocalInstance) -> LocalInstance:
        points = found.support.points + off + rng.normal(0.0, 0.002, found.support.points.shape)
        support = replace(found.support, points=points.astype(np.float32))
        return replace(found, support=support, track=replace(found.track, frames=frames))

    library = replace(made.library, instances=tuple(map(seen, made.library.instances)))
    keyframes = tuple(
        replace(k, frame_index=int(f))
        for k, f in zip(made.keyframes, frames[:: FRAMES // len(made.keyframes)], strict=False)
    )
    shift = int(frames[0]) - int(made.frame_indices[0])
    samples = replace(made.samples, frame=made.samples.frame + shift, camera_frames=frames.astype(np.int64))
    return replace(
        made,
        index=turn,
        frame_indices=frames,
        times_s=frames / 30.0,
        library=library,
        keyframes=keyframes,
        samples=samples,
    )


def add(store: Store, result: ChunkResult, session: int = 1) -> dict[str, float]:
    """Add one chunk as a build does: user seconds of placing it and of the library, objects written.

    A chunk of a later session is placed where it is: its keyframes have nothing to be recognised by.
    """
    library_s = 0.0
    consolidate = mapping.consolidate

    def timed(*arguments: Any) -> Any:
        nonlocal library_s
        started = user_s()
        report = consolidate(*arguments)
        library_s = user_s() - started
        return report

    before, started = store.embeddings.changes(), user_s()
    mapping.consolidate = timed  # type: ignore[assignment]
    try:
        if session == 1:
            mapping.add_chunk(store, session, result)
        else:
            with store.transaction():
                chunk_id = store.chunks.add(session, result)
                first = min(c.component for c in store.chunks.all())
                store.chunks.place({chunk_id: store.chunks.all()[0].S_world_chunk}, {chunk_id: first})
                mapping.consolidate(store, chunk_id)
    finally:
        mapping.consolidate = consolidate
    taken = user_s() - started
    written = sum(len(store.embeddings.changed(space, before)[0]) for space in store.embeddings.spaces())
    return {"placing_s": taken - library_s, "library_s": library_s, "all_s": taken, "written": written}


def place_of(k: int, name: str) -> int:
    """How far along the way chunk k is."""
    return k % 2 if name == "stay" else k


def chunk(k: int, name: str, seed: int) -> ChunkResult:
    """Chunk k of a walk; its frame of reference is the world's, with an error of 5 mm."""
    rng = np.random.default_rng([seed, 7, k])
    error = rng.normal(0.0, 0.005, 3)
    place = place_of(k, name)
    frames = np.arange(HOP * k, HOP * k + FRAMES)
    objects = [make_object(n, STEP * place + n, seed, error, frames, rng) for n in range(SEEN)]
    objects.append(floor(SEEN, place, name, error, frames, rng))
    links = np.array([(a, b) for a in range(len(objects)) for b in range(a)], np.int32)
    T_chunk_cam = np.stack([camera(int(f), name, error) for f in frames])
    samples = samples_of(k, frames, T_chunk_cam, name, seed, error)
    return ChunkResult(
        index=k,
        frame_indices=frames,
        times_s=frames / 30.0,
        posed=np.ones(FRAMES, bool),
        T_chunk_cam=T_chunk_cam,
        T_source_cam=None,
        intrinsics=LENS,
        image_size=IMAGE,
        scale_kind="metric",
        keyframes=tuple(
            keyframe(int(f), place, seed, T) for f, T in zip(frames, T_chunk_cam, strict=True) if f % 7 == 0
        ),
        samples=samples,
        library=LocalLibrary(tuple(objects), links, SPACE),
    )


def camera(frame: int, name: str, error: np.ndarray) -> np.ndarray:
    """T_chunk_cam of a frame: it goes along x, or to and fro."""
    along = frame / HOP if name != "stay" else abs((frame / HOP + 1.0) % 2.0 - 1.0)
    T = np.eye(4)
    T[:3, :3] = LOOKING_ALONG
    T[:3, 3] = np.array([SPACING_M * STEP * along - 3.0, 0.0, 1.5]) + error
    return T


def samples_of(
    k: int, frames: np.ndarray, T_chunk_cam: np.ndarray, name: str, seed: int, error: np.ndarray
) -> FrameSamples:
    """Points of objects and floor in every frame, the same pixels of one frame in every chunk, with 2 mm of noise."""
    frame, pixel, points, instance = [], [], [], []
    for f, T in zip(frames.tolist(), T_chunk_cam, strict=True):
        rng = np.random.default_rng([seed, 3, f])
        ahead = T[0, 3] - error[0] + rng.uniform(1.0, 7.0, SAMPLES)
        p = np.stack([ahead, rng.uniform(-1.5, 1.5, SAMPLES), np.where(rng.random(SAMPLES) < 0.5, 0.0, 0.7)], axis=1)
        p[:, 2] *= rng.random(SAMPLES)
        at = (p - (T[:3, 3] - error)) @ T[:3, :3]
        uv = np.rint(at[:, :2] / at[:, 2:] * LENS[0] + np.array(LENS[2:])).astype(int)
        seen = np.all((uv >= 0) & (uv < np.array(IMAGE[::-1])), axis=1)
        number, first = np.unique((uv @ np.array([1, IMAGE[1]]))[seen], return_index=True)
        noise = np.random.default_rng([seed, 4, k, f]).normal(0.0, 0.002, (len(first), 3))
        points.append(p[seen][first] + error + noise)
        pixel.append(number)
        frame.append(np.full(len(number), f))
        instance.append(np.full(len(number), -1))
    count = sum(map(len, frame))
    return FrameSamples(
        frame=np.concatenate(frame),
        pixel=np.concatenate(pixel).astype(np.int32),
        points=np.concatenate(points).astype(np.float32),
        confidence=np.full(count, 0.9, np.float32),
        instance=np.concatenate(instance).astype(np.int32),
        camera_frames=frames.astype(np.int64),
        T_chunk_cam=T_chunk_cam,
    )


def keyframe(frame: int, place: int, seed: int, T_chunk_cam: np.ndarray) -> Keyframe:
    """A keyframe without features; frames of one place are similar."""
    own = np.random.default_rng([seed, 5, place]).normal(size=WORDS)
    own = own + 0.3 * np.random.default_rng([seed, 6, frame]).normal(size=WORDS)
    return Keyframe(
        frame_index=frame,
        T_chunk_cam=T_chunk_cam,
        descriptor=(own / np.linalg.norm(own)).astype(np.float32),
        keypoints_xy=np.zeros((0, 2), np.float32),
        keypoint_descriptors=np.zeros((0, 32), np.uint8),
        points_cam=np.zeros((0, 3), np.float32),
        depth_small=np.zeros((0, 0), np.float32),
        camera_small=LENS,
    )


def make_object(
    local_id: int, number: int, seed: int, error: np.ndarray, frames: np.ndarray, rng: np.random.Generator
) -> LocalInstance:
    """Object `number` of the way, always the same: a box that is on the floor."""
    own = np.random.default_rng([seed, number])
    size = own.uniform(0.15, 0.6, 3)
    center = np.array([SPACING_M * number, own.uniform(-0.4, 0.4), size[2] / 2])
    points = surface(center, size, 400, rng) + error
    feature = own.normal(size=64)
    return local(local_id, points, tuple(own.integers(40, 220, 3)), feature, frames, 31 * (number % 19))


def floor(
    local_id: int, place: int, name: str, error: np.ndarray, frames: np.ndarray, rng: np.random.Generator
) -> LocalInstance:
    """The piece of floor under a chunk; where there are rooms it ends where the room does, a step up or down."""
    rooms = name == "rooms"
    start = SPACING_M * STEP * (place // 2 * 2 if rooms else place)
    at = np.array([start + SPACING_M * SEEN / 2, 0.0, -0.01 - (0.3 if rooms and place // 2 % 2 else 0.0)])
    points = surface(at, np.array([SPACING_M * SEEN, 3.0, 0.02]), 1500, rng) + error
    feature = np.random.default_rng(99).normal(size=64)
    plane = np.array([0.0, 0.0, 1.0, -float(at[2]) - 0.01])
    return local(local_id, points, (120, 120, 120), feature, frames, 600, plane)


def surface(center: np.ndarray, size: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Noisy points on an upright box. Shape (count, 3)."""
    p = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.choice(3, count, p=np.roll(size, 1) * np.roll(size, 2) / np.sum(np.roll(size, 1) * np.roll(size, 2)))
    p[np.arange(count), axis] = 0.5 * rng.choice([-1.0, 1.0], count)
    return np.asarray(center + p * size + rng.normal(0.0, 0.003, p.shape))


def local(
    local_id: int,
    points: np.ndarray,
    rgb: tuple[int, ...],
    feature: np.ndarray,
    frames: np.ndarray,
    left: int,
    plane: np.ndarray | None = None,
) -> LocalInstance:
    """A local instance with the same box in all of its frames."""
    count = len(frames)
    track = MaskTrack(
        frames=frames,
        boxes_xyxy=np.tile(np.float32([left + 5, 100, left + 35, 200]), (count, 1)),
        centers_xy=np.tile(np.float32([left + 20, 150]), (count, 1)),
        areas_px=np.full(count, 3000, np.int32),
        visible_fraction=np.full(count, 0.9, np.float32),
        masks=tuple(np.array([20 * 640 + 10, 20], np.uint32) for _ in range(count)),
        image_size=IMAGE,
    )
    p = points.astype(np.float32)
    support = Support(p, np.full(len(p), 0.8, np.float32), np.tile(np.uint8(rgb), (len(p), 1)))
    unit = (feature / np.linalg.norm(feature)).astype(np.float32)
    return LocalInstance(local_id, track, unit, support, 0.9, plane=plane, structure=plane is not None)


def user_s() -> float:
    """User seconds of processor time of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime


def peak_mb() -> float:
    """Largest resident set of this process so far."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def resident_mb() -> float:
    """Resident set of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * resource.getpagesize() / 1e6, 1)


if __name__ == "__main__":
    main()
