"""Latency of a memory as it grows: 1,000 to 1,000,000 instances, compared with a NumPy scan and an embedded vector
database.

python benchmarks/scale.py --instances 1000,1000000 --json benchmarks/results/scale.json

The instances are synthetic and written through the store's own verbs: rooms of 5 x 5 x 3 m side by side, 30 objects in
each, relations to the neighbours, features of 256 numbers in families that are apart by design (`features`). They have
no measured surfaces, so distances are to their boxes. Each size runs in its own process. The index of vectors is kept
in the cache of the user (`$LIST3R_CACHE`); here next to the memories. LanceDB is the other database (pip install
lancedb): its index of a million vectors takes 45 s of processor time, the process 4 GB.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json
from numpy.typing import NDArray

from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import Instance, Relation
from list3r.memory.store.store import Store
from list3r.queries.find import find
from list3r.queries.nearest import nearest
from list3r.queries.seen import visible
from list3r.queries.similar import similar
from list3r.queries.views.camera import PosedCamera
from list3r.queries.within import within

SPACE = "synthetic@1/256"
DIMENSION = 256
ROOM_M = np.array([5.0, 5.0, 3.0])
OBJECTS = 30
BATCH = 20_000
COLORS = "white black grey red orange yellow green teal blue purple brown pink".split()
SHAPES = "box cylinder sheet slab panel object table sphere".split()
INDEXED = 5_000
"""Up to so many vectors LanceDB has no index: its product codes want that many to learn from."""
NOUNS = 200
"""Labels that one object in fifty has."""
Floats = NDArray[np.float64]
QUESTIONS = {
    "label": "noun7",
    "words": "red table",
    "relation": "small red sphere near noun7",
    "kinds": "red box near blue table",
    "nothing": "zebra",
}
"""Phrases of `find`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", default="1000,10000,100000,1000000")
    parser.add_argument("--questions", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which the memories are kept and taken up again")
    parser.add_argument("--no-database", action="store_true", help="ours and NumPy only")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(measure(args.one, args.questions, args.seed, args.keep, database=not args.no_database)))
        return
    print(machine())
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for count in (int(word) for word in args.instances.split(",")):
            folder = args.keep or Path(scratch)
            command = [sys.executable, __file__, "--one", str(count), "--keep", str(folder)]
            command += ["--questions", str(args.questions), "--seed", str(args.seed)]
            command += ["--no-database"] if args.no_database else []
            cache = {**os.environ, "LIST3R_CACHE": str((args.keep or Path(scratch)) / "cache")}
            out = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=cache).stdout
            rows.append(json.loads(out.splitlines()[-1]))
            print("\n".join(f"{count:>9,}  {k:34} {v}" for k, v in rows[-1].items()), flush=True)
            write_json(args.json, {"sizes": rows})


def measure(count: int, questions: int, seed: int, folder: Path, *, database: bool) -> dict[str, Any]:
    """All figures of one size."""
    path = folder / f"scale-{count}-{seed}.l3r"
    written = write_memory(path, count, seed) if not path.exists() else None
    started = time.perf_counter()
    store = Store.open(path, writable=True)
    row: dict[str, Any] = {"instances": count, "write_s": written, "file_mb": round(path.stat().st_size / 1e6, 1)}
    row["open_s"] = round(time.perf_counter() - started, 4)
    rng = np.random.default_rng([seed, 2])
    world = rooms(count)
    points = rng.uniform(0.0, 1.0, (questions, 3)) * world
    row |= timed("nearest", [lambda p=p: nearest(store, point=p, k=5) for p in points])
    row |= timed("within_1m", [lambda p=p: within(store, center=p, radius=1.0) for p in points])
    ids = rng.integers(1, count + 1, questions)
    row |= timed("near_instance", [lambda n=n: nearest(store, instance_id=int(n), k=5) for n in ids])
    _, stored = store.embeddings.of(SPACE, sorted({int(n) for n in ids}))
    asked = views(stored, rng)
    for name, text in QUESTIONS.items():
        row |= timed(f"find_{name}", [lambda text=text: find(store, text)] * 5, warm=1)
    row |= timed("words_near_point", [lambda p=p: nearest(store, point=p, words="noun7") for p in points[:10]])
    row |= timed("camera", [lambda p=p: visible(store, camera_in(p), max_depth=6.0) for p in points[:20]])
    started, spent = time.perf_counter(), time.process_time()
    similar(store, vector=asked[0], space=SPACE, k=10)
    row["similar_first_s"] = round(time.perf_counter() - started, 2)
    row["similar_first_cpu_s"] = round(time.process_time() - spent, 2)
    found: dict[int, list[int]] = {}

    def ask(n: int) -> None:
        found[n] = [m.instance.id for m in similar(store, vector=asked[n], space=SPACE, k=10)]

    row |= timed("similar", [lambda n=n: ask(n) for n in range(len(asked))])
    row["resident_mb"] = resident_mb()
    row |= peers(store, points, asked, found, database=database)
    row |= timed("one_more_chunk", [lambda n=n: one_more_chunk(store, int(n), count) for n in range(20)], warm=1)
    row |= timed("similar_after_chunk", [lambda v=v: similar(store, vector=v, space=SPACE, k=10) for v in asked[:20]])
    store.close()
    with Store.open(path) as reader:
        started = time.perf_counter(), time.process_time()
        similar(reader, vector=asked[0], space=SPACE, k=10)
        row["similar_first_again_s"] = round(time.perf_counter() - started[0], 2)
        row["similar_first_again_cpu_s"] = round(time.process_time() - started[1], 2)
        next_ones = [lambda v=v: similar(reader, vector=v, space=SPACE, k=10) for v in asked[1:41]]
        row |= timed("similar_soon_after_opening", next_ones, warm=0)
    row |= cold(path, points)
    row["peak_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1)
    return row


def cold(path: Path, points: Floats) -> dict[str, float]:
    """`nearest` in a memory just opened, with its file not in the system's cache: dropped once at the start, or before
    each question, so that only SQLite's own cache remains.
    """
    out: dict[str, float] = {}
    for name, each in (("nearest_cold", False), ("nearest_cold_each", True)):
        leave_cache(path)
        with Store.open(path) as store:

            def ask(p: Floats, store: Store = store) -> Any:
                return nearest(store, point=p, k=5)

            out |= timed(f"{name}_first", [lambda ask=ask: ask(points[0])], warm=0)
            drop = (lambda: leave_cache(path)) if each else (lambda: None)
            out |= timed(name, [lambda p=p, ask=ask: ask(p) for p in points[1:]], warm=0, before=drop)
    return out


def leave_cache(path: Path) -> None:
    """Drop a file from the system's cache."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
        os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)
    finally:
        os.close(file)


# -------------------------------------------------------------------------------------------------- writes


def rooms(count: int) -> Floats:
    """Extent of the world: rooms in a square, one floor. Shape (3,)."""
    side = int(np.ceil(np.sqrt(np.ceil(count / OBJECTS))))
    return np.array([side, side, 1.0]) * ROOM_M


def write_memory(path: Path, count: int, seed: int) -> float:
    """A memory of made-up instances; CPU and disk seconds it took."""
    started = time.perf_counter()
    side = int(rooms(count)[0] / ROOM_M[0] + 0.5)
    with Store.create(path) as store:
        with store.transaction():
            store.facts.scale_kind = "metric"
            store.facts.gravity = "estimated"
        for first in range(1, count + 1, BATCH):
            ids = np.arange(first, min(first + BATCH, count + 1))
            rng = np.random.default_rng([seed, first])
            with store.transaction():
                store.instances.put(objects(ids, side, rng))
                store.embeddings.put(SPACE, ids.tolist(), features(len(ids), seed, rng))
                store.relations.replace(
                    [], [Relation(int(n), "near", int(n) - 1, 0.9, 0.1) for n in ids if n % OBJECTS != 1]
                )
    return round(time.perf_counter() - started, 1)


def objects(ids: NDArray[np.int64], side: int, rng: np.random.Generator) -> Iterator[Instance]:
    """Boxes of 5 cm to 2 m, small ones the most, anywhere in their room and turned about the vertical."""
    room = (ids - 1) // OBJECTS
    corner = np.stack([room % side, room // side, np.zeros_like(room)], axis=1) * ROOM_M
    size = 0.05 * 40.0 ** (rng.uniform(size=(len(ids), 3)) ** 2)
    center = corner + rng.uniform(0.0, 1.0, size.shape) * (ROOM_M - np.minimum(size, ROOM_M)) + size / 2
    angle = rng.uniform(0.0, np.pi, len(ids))
    color, shape, noun = (rng.integers(0, n, len(ids)) for n in (len(COLORS), len(SHAPES), 50 * NOUNS))
    for n, instance_id in enumerate(ids.tolist()):
        c, s = np.cos(angle[n]), np.sin(angle[n])
        box = OrientedBox(center[n], size[n], np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
        corners = box.corners()
        yield Instance(
            id=instance_id,
            label=f"noun{noun[n]}" if noun[n] < NOUNS else None,
            description=_described(size[n].max(), COLORS[color[n]], SHAPES[shape[n]]),
            center=center[n],
            aabb=np.stack([corners.min(axis=0), corners.max(axis=0)]),
            box=box,
            confidence=0.9,
            observations=30,
            first_seen_s=float(room[n]),
            last_seen_s=float(room[n]) + 10.0,
            state="present",
            structure=None,
            color_rgb=(240, 240, 240),
            color_name=COLORS[color[n]],
            component=1,
            best_view=None,
        )


def _described(edge_m: float, color: str, shape: str) -> str:
    size = "small" if edge_m < 0.3 else "medium" if edge_m < 1.0 else "large"
    return f"{size} {color} {shape}, {100 * edge_m:.0f} cm"


def camera_in(place: Floats) -> PosedCamera:
    """A level camera along x."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], place
    return PosedCamera(pose, (525.0, 525.0, 319.5, 239.5), (480, 640), 1, 1)


def features(count: int, seed: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Unit vectors: 2,000 kinds of objects, within a kind 32 ways to differ, and noise in all directions.

    Two objects of one kind have a cosine of about 0.6, two of different kinds of about 0. Shape (count, 256).
    """
    fixed = np.random.default_rng([seed, 1])
    kinds = fixed.normal(size=(2000, DIMENSION)) / np.sqrt(DIMENSION)
    ways = fixed.normal(size=(32, DIMENSION)) / np.sqrt(DIMENSION)
    own = rng.normal(size=(count, 32)) @ ways / np.sqrt(32)
    noise = rng.normal(size=(count, DIMENSION)) / np.sqrt(DIMENSION)
    made = kinds[rng.integers(0, len(kinds), count)] + 0.75 * own + 0.3 * noise
    return np.asarray(made / np.linalg.norm(made, axis=1, keepdims=True), np.float32)


def views(stored: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Other views of stored objects: cosine about 0.9 to the stored features."""
    made = stored + 0.45 * rng.normal(size=stored.shape) / np.sqrt(stored.shape[1])
    return np.asarray(made / np.linalg.norm(made, axis=1, keepdims=True), np.float32)


def one_more_chunk(store: Store, n: int, count: int) -> None:
    """The store's writes when a chunk has changed 30 objects of one room and found 5 new ones."""
    first = 1 + OBJECTS * (n % max(1, count // OBJECTS))
    changed = list(range(first, min(first + OBJECTS, count)))
    new = [store.ids.next() + k for k in range(5)]
    rng = np.random.default_rng(n)
    side = int(rooms(count)[0] / ROOM_M[0] + 0.5)
    with store.transaction():
        store.instances.put(objects(np.array(changed + new), side, rng))
        store.embeddings.put(SPACE, changed + new, features(len(changed) + 5, 1, rng))
        store.relations.replace(changed, [Relation(a, "near", a - 1, 0.9, 0.1) for a in changed[1:]])


# -------------------------------------------------------------------------------------------------- peers


def peers(
    store: Store, points: Floats, asked: NDArray[np.float32], found: dict[int, list[int]], *, database: bool
) -> dict[str, Any]:
    """A plain NumPy scan over the same data, which is also the truth for the recall, and a vector database."""
    out: dict[str, Any] = {}
    ids, vectors = store.embeddings.all(SPACE)
    asked = asked[: min(len(asked), 100)]
    truth: dict[int, list[int]] = {}

    def scan(n: int) -> None:
        cosine = vectors @ asked[n]
        truth[n] = ids[np.argpartition(-cosine, min(10, len(cosine) - 1))[:10]].tolist()

    out |= timed("numpy_similar", [lambda n=n: scan(n) for n in range(len(asked))])
    out["similar_recall_at_10"] = recall(found, truth)
    bounds = store.instances.bounds()
    assert bounds is not None
    _, boxes = store.instances.boxes_in_box(bounds[0], bounds[1])

    def scan_boxes(p: Floats) -> None:
        apart = np.maximum(0.0, np.maximum(boxes[:, 0] - p, p - boxes[:, 1]))
        np.argpartition(np.einsum("ij,ij->i", apart, apart), min(5, len(boxes) - 1))

    out |= timed("numpy_nearest", [lambda p=p: scan_boxes(p) for p in points[:50]], warm=1)
    return out | vector_database(ids, vectors, asked, truth) if database else out


def vector_database(
    ids: NDArray[np.int64], vectors: NDArray[np.float32], asked: NDArray[np.float32], truth: dict[int, list[int]]
) -> dict[str, Any]:
    """LanceDB, embedded: scanning its table, with its inverted index of product codes as it comes, and with refinement.

    Left out where it is not installed. Small tables have no index.
    """
    os.environ.setdefault("LANCE_LOG", "error")
    try:
        import lancedb
        import pyarrow
    except ImportError:
        print("lancedb is not installed (pip install lancedb); left out", file=sys.stderr)
        return {}
    out: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter(), time.process_time()
        column = pyarrow.FixedSizeListArray.from_arrays(vectors.ravel(), vectors.shape[1])
        table = lancedb.connect(folder).create_table("things", pyarrow.table({"id": ids, "vector": column}))
        out["lancedb_insert_s"] = round(time.perf_counter() - started[0], 2)
        out["lancedb_insert_cpu_s"] = round(time.process_time() - started[1], 2)
        out |= _asked_of(table, "lancedb_scan", asked[:20], truth)
        if len(ids) <= INDEXED:
            return out
        started = time.perf_counter(), time.process_time()
        table.create_index("vector", config=lancedb.index.IvfPq(distance_type="cosine"))
        out["lancedb_index_s"] = round(time.perf_counter() - started[0], 2)
        out["lancedb_index_cpu_s"] = round(time.process_time() - started[1], 2)
        out |= _asked_of(table, "lancedb_ivf_pq", asked, truth)
        return out | _asked_of(table, "lancedb_ivf_pq_refined", asked, truth, refined=True)


def _asked_of(
    table: Any, name: str, asked: NDArray[np.float32], truth: dict[int, list[int]], *, refined: bool = False
) -> dict[str, Any]:
    """Times and recall of a LanceDB table; `refined` takes 100 cells and compares 20 times as many by their vectors."""
    found: dict[int, list[int]] = {}

    def ask(n: int) -> None:
        query = table.search(asked[n]).distance_type("cosine").limit(10).select(["id", "_distance"])
        query = query.refine_factor(20).nprobes(100) if refined else query
        found[n] = query.to_arrow()["id"].to_pylist()

    times = timed(f"{name}_similar", [lambda n=n: ask(n) for n in range(len(asked))])
    return times | {f"{name}_recall_at_10": recall(found, {n: truth[n] for n in found})}


def recall(found: dict[int, list[int]], truth: dict[int, list[int]]) -> float:
    """Mean share of the true ten that were found, over the questions of `truth`."""
    return round(float(np.mean([len(set(found[n]) & set(t)) / len(t) for n, t in truth.items()])), 4)


def timed(
    name: str, questions: list[Callable[[], Any]], warm: int = 3, before: Callable[[], None] = lambda: None
) -> dict[str, float]:
    """p50 and p99 of single questions, milliseconds by the clock and of processor time, after a few to warm up that are
    asked once more. The clock includes other work of the machine; processor time is the cost of the question. `before`
    is not counted.
    """
    spent = []
    for n, ask in enumerate([*questions[:warm], *questions]):
        before()
        started = time.perf_counter(), time.process_time()
        ask()
        if n >= warm:
            spent.append((time.perf_counter() - started[0], time.process_time() - started[1]))
    wall, cpu = 1e3 * np.quantile(spent, [0.5, 0.99], axis=0).T
    values = {"p50_ms": wall[0], "p99_ms": wall[1], "cpu_p50_ms": cpu[0], "cpu_p99_ms": cpu[1]}
    return {f"{name}_{key}": round(float(value), 3) for key, value in values.items()}


def resident_mb() -> float:
    """Resident set of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * resource.getpagesize() / 1e6, 1)


if __name__ == "__main__":
    main()
