"""A simulated home filmed many times, other things moved, removed and added each time.

python benchmarks/visits.py --seeds 1,2 --json benchmarks/results/visits.json

The walks go this way and that, in one memory. After each visit the things that the memory lists are held against the
truth of that visit, by boxes, and the events that it tells of the visit against what the camera could be the first to
see then (`known_places.py`), as in `sessions.py`. `pairs` counts the pairs of chunks that overlap; `library_s` is
processor time of the library, seconds. The totals count the visits from `--from` on.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from known_places import KnownPlaces
from machine import machine, write_json
from sessions import KINDS, ReturnWalk, measure

import list3r
from benchmarks.simulation.changes import random_changes
from benchmarks.simulation.walks import ChangedWalk
from list3r.memory.store.store import Store
from list3r.pipeline import mapping
from list3r.pipeline.settings import BuildSettings
from list3r.simulation.dataset import WalkSettings, write_walk
from list3r.simulation.worlds.world import SimulatedWorld

DONE = {"moved": 2, "removed": 1, "added": 1}
"""Changes of the initial home, before each visit but the first."""


@dataclass(frozen=True)
class VisitWalk(ChangedWalk):
    """The same rooms at another visit: its added objects are at no other."""

    visit: int = 1

    def world(self) -> SimulatedWorld:
        """The world of the visit."""
        known = {t.id for t in WalkSettings(seed=self.seed).world().objects}
        world = super().world()
        added = (replace(t, id=t.id if t.id in known else 100 * self.visit + t.id) for t in world.objects)
        return replace(world, objects=tuple(added))


class BackWalk(VisitWalk, ReturnWalk):
    """The same the other way round."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--visits", type=int, default=7)
    parser.add_argument("--from", type=int, default=5, dest="first", help="visit from which it is counted")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder in which walks are kept")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in map(int, args.seeds.split(",")):
            walks = [filmed((args.keep or Path(scratch)) / str(seed), seed, n) for n in range(1, args.visits + 1)]
            known = KnownPlaces(walks)
            memory = Path(scratch) / f"{seed}.l3r"
            for n in range(1, args.visits + 1):
                found = visited(memory, walks[:n], known, args.workers)
                rows.append({"seed": seed, "visit": n, **found})
                print(json.dumps(rows[-1]), flush=True)
    table = total([r for r in rows if r["visit"] >= args.first])
    print(machine())
    print(json.dumps(table, indent=1))
    write_json(args.json, {"from": args.first, "total": table, "visits": rows})


def filmed(root: Path, seed: int, visit: int) -> Path:
    """The folder of a walk, filmed unless it is there."""
    walk, first = root / str(visit), WalkSettings(seed=seed)
    if (walk / "truth.json").exists():
        return walk
    if visit == 1:
        write_walk(walk, first)
        return walk
    kind = BackWalk if visit % 2 == 0 else VisitWalk
    changes = random_changes(first.world(), 100 * seed + visit, **DONE)
    write_walk(walk, kind(seed=seed, walk_seed=1000 * visit + seed, start=20 * visit, changes=changes, visit=visit))
    return walk


def visited(memory: Path, walks: Sequence[Path], known: KnownPlaces, workers: int) -> dict[str, Any]:
    """Add the last walk to the memory of those before, and measure what it tells then."""
    settings = BuildSettings(poses="estimate")
    if len(walks) == 1:
        list3r.build(walks[0], memory, settings=settings, workers=workers, force=True).close()
        return {}
    before = memory.with_suffix(".before.l3r")
    before.write_bytes(memory.read_bytes())
    consolidate, spent = mapping.consolidate, list[float]()

    def timed(*arguments: Any) -> Any:
        started = time.process_time()
        report = consolidate(*arguments)
        spent.append(time.process_time() - started)
        return report

    mapping.consolidate = timed  # type: ignore[assignment]
    try:
        list3r.update(memory, walks[-1], workers=workers).close()
    finally:
        mapping.consolidate = consolidate
    with Store.open(before) as one, Store.open(memory) as two:
        found = measure(one, two, walks, known.due(len(walks) - 1))
        pairs = len(two.pair_scores.pairs())
    return {
        "events": found["events"],
        "false": found["false"],
        "missed": found["missed"],
        "last": found["last"],
        "ids_kept": found["ids_kept"],
        "unchanged": found["unchanged"],
        "library_s": round(sum(spent), 2),
        "pairs": pairs,
    }


def total(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All visits together."""
    out: dict[str, Any] = {
        "ids_kept": round(sum(r["ids_kept"] for r in rows) / max(sum(r["unchanged"] for r in rows), 1), 4)
    }
    for kind in (*KINDS, "all"):
        of = KINDS if kind == "all" else (kind,)
        s = {n: sum(r["events"][k][n] for r in rows for k in of) for n in ("hit", "false", "missed")}
        out[kind] = {**s, "f1": round(2 * s["hit"] / max(2 * s["hit"] + s["false"] + s["missed"], 1), 4)}
    for name in rows[0]["last"] if rows else ():
        counts: Counter[str] = Counter()
        for row in rows:
            counts.update(row["last"][name])
        out[name] = dict(counts)
    return out


if __name__ == "__main__":
    main()
