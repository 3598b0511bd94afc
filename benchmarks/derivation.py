"""What deriving the library costs: a long walk, a long stay in one room, many sessions in one place, a corridor.

python benchmarks/derivation.py --json benchmarks/results/derivation.json

The chunks are those of `incremental.py`, but they are placed as a pose graph would place them instead of by one: while
a session lasts the last 60 tremble, and at its end the walk bends (of a stay every chunk shifts by some millimetres, as
measured in docs/decisions/0172). So the figures are of the library alone. Each walk has a process of its own. Printed
are processor seconds: all of the library while the session lasts a chunk, the longest call, its end, the end once more
with nothing new, an operator's merge; most memory of the process; and what is listed at the end: things, those of the
walk that were found (middle within 10 cm, diagonal within half as much again), relations.

With `--keep FOLDER` what is listed is written there, and with `--against FOLDER` it is compared with what another
version wrote: instances with a like (boxes overlap by 0.9), relations that both tell of those.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from incremental import SEEN, SPACING_M, STEP, again, begin, chunk, place_of, user_s
from machine import machine, write_json

from list3r.memory.core.geometry import Sim3, rotation_exp
from list3r.memory.core.records import ChunkResult
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store

WALKS = {"walk": ("rooms", 300), "stay": ("stay", 200), "sessions": ("rooms", 15), "corridor": ("corridor", 1000)}
"""The way of each, and the chunks of a session."""
SESSIONS = 20
SOLVED = 60
"""Chunks that the graph solves with each new one; those before stay where they are."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", default=",".join(WALKS), help="some of " + ", ".join(WALKS))
    parser.add_argument("--chunks", type=int, help="chunks of a session, instead of its own number")
    parser.add_argument("--at-end", action="store_true", help="derive the library when sessions end alone")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--json", type=Path)
    words = parser.parse_args()
    print(machine())
    found: dict[str, Any] = {}
    for name in words.walks.split(","):
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            row, listed = pool.submit(measure, name, words).result()
        if words.keep:
            words.keep.mkdir(parents=True, exist_ok=True)
            (words.keep / f"{name}.json").write_text(json.dumps(listed))
        if words.against and (words.against / f"{name}.json").exists():
            row |= compared(listed, json.loads((words.against / f"{name}.json").read_text()))
        found[name] = row
        print(f"{name}  " + "  ".join(f"{k} {v}" for k, v in row.items()), flush=True)
        write_json(words.json, {"walks": found})


def measure(name: str, words: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Build one memory; what it cost, and what it lists."""
    spent, chunks, seed = list[float](), words.chunks or WALKS[name][1], words.seed
    with tempfile.TemporaryDirectory() as scratch, Store.create(Path(scratch) / "walk.l3r") as store:
        for session in range(1, (SESSIONS if name == "sessions" else 1) + 1):
            begin(store, chunks)
            with store.transaction():
                store.facts.gravity = "known"
            for k in range(chunks):
                derived = session == 1 and not words.at_end
                spent.append(add(store, session, made(name, session, k, seed), seed, derived=derived))
            end_s = ended(store, session, name, seed)
        with store.transaction():
            again_s = timed(store)
        peak = peak_mb()
        a, b = (i.id for i in store.instances.all(structure=False)[:2])
        started = user_s()
        edits.merge(store, a, b, "benchmark")
        edit_s = user_s() - started
        edits.undo(store, None, "benchmark")
        listed, things = what_is_listed(store), truth(store, name, chunks, seed)
        row = {
            "chunks": len(store.chunks.all()),
            "chunk_s": round(float(np.mean(spent)), 4),
            "longest_s": round(max(spent), 2),
            "end_s": round(end_s, 2),
            "again_s": round(again_s, 2),
            "edit_s": round(edit_s, 2),
            "peak_mb": peak,
            "file_mb": round(store.path.stat().st_size / 1e6, 1),
            "things": len(things),
            "listed": sum(listed["things"]),
            "found": found_of(things, listed),
            "relations": len(listed["relations"]),
        }
    return row, listed


def made(name: str, session: int, k: int, seed: int) -> ChunkResult:
    """Chunk `k` of a session."""
    way = WALKS[name][0]
    return chunk(k, way, seed) if session == 1 else again(0, k, way, seed, session)


def add(store: Store, session: int, result: ChunkResult, seed: int, *, derived: bool) -> float:
    """Add a chunk as a build does, and bring the library up to it; processor seconds of that."""
    with store.transaction():
        chunk_id = store.chunks.add(session, result)
        rows = store.chunks.all()
        moved = {c.chunk_id: placed(seed, c.chunk_id, len(rows)) for c in rows[-SOLVED:]}
        store.chunks.place(moved, dict.fromkeys(moved, rows[0].chunk_id))
        return timed(store, chunk_id) if derived else 0.0


def placed(seed: int, chunk_id: int, solved: int) -> Sim3:
    """Where the graph of so many chunks places one: off by a fraction of a millimetre, otherwise each time."""
    rng = np.random.default_rng([seed, 21, chunk_id, solved])
    return Sim3(1.0, rotation_exp(np.radians(rng.normal(0.0, 0.002, 3))), rng.normal(0.0, 1e-4, 3))


def ended(store: Store, session: int, name: str, seed: int) -> float:
    """End a session: all chunks lie elsewhere, most as their neighbours do; processor seconds of the library."""
    rows = store.chunks.all()
    rng = np.random.default_rng([seed, 22])
    steps = rng.normal(0.0, 0.003 if name == "stay" else 2e-4, (len(rows), 3))
    turns = np.radians(0.002) * np.arange(len(rows)) * (name != "sessions")
    shifts = steps if name in ("stay", "sessions") else np.cumsum(steps, axis=0)
    with store.transaction():
        store.chunks.place(
            {
                c.chunk_id: Sim3(1.0, rotation_exp(np.array([0.0, 0.0, turn])), shift)
                for c, turn, shift in zip(rows, turns, shifts, strict=True)
            },
            dict.fromkeys((c.chunk_id for c in rows), rows[0].chunk_id),
        )
        spent = timed(store)
        store.sessions.complete(session)
    return spent


def timed(store: Store, chunk_id: int | None = None) -> float:
    """Derive the library, inside a transaction; processor seconds."""
    started = user_s()
    consolidate(store, chunk_id)
    return user_s() - started


def truth(store: Store, name: str, chunks: int, seed: int) -> np.ndarray:
    """Middle and diagonal of every thing of the walk, where a chunk that sees it lies. Shape (N, 4)."""
    way = WALKS[name][0]
    places = sorted({place_of(k, way) for k in range(chunks)})
    poses = {place_of(k, way): c.S_world_chunk for k, c in zip(range(chunks), store.chunks.all(), strict=False)}
    seen_from = {STEP * p + n: p for p in reversed(places) for n in range(SEEN)}
    out = []
    for number, place in sorted(seen_from.items()):
        own = np.random.default_rng([seed, number])
        size = own.uniform(0.15, 0.6, 3)
        center = np.array([SPACING_M * number, own.uniform(-0.4, 0.4), size[2] / 2])
        out.append([*poses[place].apply(center[None])[0], np.linalg.norm(size)])
    return np.array(out)


def what_is_listed(store: Store) -> dict[str, Any]:
    """Boxes of all instances, which of them are things, and relations."""
    found = store.instances.all()
    return {
        "ids": [i.id for i in found],
        "things": [i.structure is None for i in found],
        "boxes": [np.round(i.aabb, 4).tolist() for i in found],
        "relations": sorted([r.subject, r.predicate, r.object] for r in store.relations.all()),
    }


def found_of(things: np.ndarray, listed: dict[str, Any]) -> int:
    """How many things of the walk are listed."""
    boxes = np.array(listed["boxes"]).reshape(-1, 2, 3)[np.array(listed["things"], bool)]
    middle, size = boxes.mean(axis=1), np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1)
    near = np.linalg.norm(things[:, None, :3] - middle, axis=2) < 0.1
    ratio = things[:, None, 3] / np.maximum(size, 1e-9)
    return int((near & (ratio < 1.5) & (ratio > 1 / 1.5)).any(axis=1).sum())


def compared(now: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """How much of what is listed another version listed too."""
    a, b = (np.array(x["boxes"]).reshape(-1, 2, 3) for x in (now, before))
    like: dict[int, int] = {}
    for n, box in enumerate(a):
        cut = np.clip(np.minimum(box[1], b[:, 1]) - np.maximum(box[0], b[:, 0]), 0, None).prod(axis=1)
        iou = cut / (np.prod(box[1] - box[0]) + np.prod(b[:, 1] - b[:, 0], axis=1) - cut)
        if len(iou) and iou.max() >= 0.9:
            like[now["ids"][n]] = before["ids"][int(iou.argmax())]
    told = {tuple(r) for r in before["relations"]}
    both = sum((like.get(s, s), p, like.get(o, o)) in told for s, p, o in now["relations"])
    return {"instances_before": len(b), "alike": len(like), "same_ids": sum(k == v for k, v in like.items())} | {
        "relations_before": len(told),
        "relations_alike": both,
    }


def peak_mb() -> float:
    """Most memory of this process so far."""
    import resource

    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


if __name__ == "__main__":
    main()
