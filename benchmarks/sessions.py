"""A simulated home filmed twice, with objects moved, removed and added in between; and redkitchen cut in two.

python benchmarks/sessions.py --seeds 1,2,3,4,5 --json benchmarks/results/sessions.json

The second walk goes the other way round and starts elsewhere. Placement: the residual rigid motion between the second
session's camera path and the truth after alignment by the first session alone. Ids: of the unchanged objects that both
memories found. Events: moved, removed and added against the changes of the world that the camera saw well enough (150
px in some frame of each walk that should show it). An event is about the object of its id in the memory before (for
added: after), else about the object within 0.1 m of its place; a move must also end at the object. True events of less
visible changes are ignored. The third entry of `missed` says whether the memory had the object before (or, for added,
at all).
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray

from benchmarks.simulation.changes import random_changes
from benchmarks.simulation.walks import ChangedWalk
from list3r.evaluation.scene import alignment_of, evaluate_scene, read_scene
from list3r.evaluation.trajectory import Trajectory, read_tum
from list3r.memory.core.geometry import OrientedBox, Sim3
from list3r.memory.core.records import ChangeEvent
from list3r.memory.store.store import Store
from list3r.simulation.dataset import WalkSettings, write_walk
from list3r.simulation.walk import camera_path

MIN_PX = 150
KINDS = ("moved", "removed", "added")
ELSEWHERE_M = 0.05
"""Objects that were moved less far count as unchanged."""


class ReturnWalk(ChangedWalk):
    """The same rooms the other way round."""

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        tour = tuple(reversed(self.world().tour))
        time_s, poses = camera_path(tour, None, self.path, self.walk_seed or 0)
        return time_s[self.start :], poses[self.start :]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--discovery", default="", help="such as learned,sam2; without it the default")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    parser.add_argument("--workers", default="1")
    parser.add_argument("--jobs", type=int, default=1, help="how many are measured side by side")
    parser.add_argument("--redkitchen", type=Path, help="the sequence's folder; its two halves become two sessions")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        root = args.keep or Path(scratch)
        seeds = [int(word) for word in args.seeds.split(",") if word]
        runs = [(seed, method) for seed in seeds for method in args.discovery.split(",")]
        with ThreadPoolExecutor(args.jobs) as pool:
            table = pool.submit(redkitchen, root, args.redkitchen, args.workers) if args.redkitchen else None
            homes = pool.map(lambda run: one_home(root / str(run[0]), run[0], args.workers, run[1]), runs)
            for (seed, method), row in zip(runs, homes, strict=True):
                rows.append({"seed": seed, "discovery": method or "default", **row})
                print(json.dumps(rows[-1]), flush=True)
            halves = table.result() if table else None
    totals = {m: total([r for r in rows if r["discovery"] == m]) for m in dict.fromkeys(r["discovery"] for r in rows)}
    result: dict[str, Any] = {"seeds": rows, "total": totals if len(totals) > 1 else total(rows)}
    result |= {"redkitchen": halves} if halves else {}
    print(machine())
    print(json.dumps({k: v for k, v in result.items() if k != "seeds"}, indent=1))
    write_json(args.json, result)


def one_home(root: Path, seed: int, workers: str, discovery: str = "") -> dict[str, Any]:
    """Film twice, build, update, measure."""
    first = WalkSettings(seed=seed)
    changes = random_changes(first.world(), seed, moved=3, removed=2, added=2)
    if not (root / "first" / "truth.json").exists():
        write_walk(root / "first", first)
    if not (root / "second" / "truth.json").exists():
        write_walk(root / "second", ReturnWalk(seed=seed, walk_seed=seed + 1000, start=40, changes=changes))
    one, two = root / f"one{discovery}.l3r", root / f"two{discovery}.l3r"
    common = ("--poses", "estimate", "--workers", workers, *(("--discovery", discovery) if discovery else ()))
    if not one.exists():
        run_list3r("build", str(root / "first"), "-m", str(one), *common)
    two.unlink(missing_ok=True)
    shutil.copy(one, two)
    report, usage = run_list3r("update", str(two), str(root / "second"), *common)
    with Store.open(one) as before, Store.open(two) as after:
        figures = measure(before, after, [root / "first", root / "second"])
    return {"placed": report["placed"], "chunks": report["chunks"], "ties": report["ties"], **usage, **figures}


@dataclass(frozen=True)
class Due:
    """Changes that a memory could report of a walk."""

    changes: set[tuple[str, int]]
    """Kind and object."""
    besides: set[tuple[str, int]]
    """Ignored changes."""
    scenes: Sequence[dict[str, Any]]
    """Where objects were when they were last seen before, and where they are."""

    @staticmethod
    def of(scenes: Sequence[dict[str, Any]]) -> Due:
        """Return the changes between two walks."""
        done = _changes(scenes)
        faint = _changes(scenes, 0) - done
        faint |= {(kind, t) for k, t in faint if k == "moved" for kind in ("removed", "added")}
        return Due(done, faint, scenes)


def measure(before: Store, after: Store, walks: Sequence[Path], due: Due | None = None) -> dict[str, Any]:
    """Placement, ids and events of an updated memory against the truth of the walks in it, before and with the last;
    the events against the changes since the walk before it, or those `due`.
    """
    last = len(walks)
    truth = [read_tum(walk / "groundtruth.txt") for walk in (walks[0], walks[-1])]
    scenes = [read_scene(walk / "truth.json") for walk in walks[-2:]]
    S_truth_one = alignment_of(truth[0], _path(before, 1), with_scale=False)
    S_truth_two = alignment_of(truth[0], _path(after, 1), with_scale=False)
    moved_m, turned_deg = _placement(truth[1], _path(after, last), S_truth_two)
    first = evaluate_scene(_scene(before), scenes[0], S_truth_one)
    was = {e: t for t, e, _ in first["matched_ids"]}
    second = evaluate_scene(_scene(after), scenes[1], S_truth_two)
    now = {e: t for t, e, _ in second["matched_ids"]}
    due = due or Due.of(scenes)
    done = due.changes
    unchanged = [(i, t) for i, t in was.items() if t in now.values() and t not in {obj for _, obj in done}]
    kept = sum(now.get(after.ids.resolve(i)) == t for i, t in unchanged)
    claimed = {_report(e, was, now, due.scenes, S_truth_two) for e in after.events.all(last) if e.kind in KINDS}
    claimed -= due.besides
    wrong = sorted((k, t) for k, t in claimed - done)
    known = {t for t in was.values()} | {t for k, t in done if k == "added"}
    return {
        "placed_m": round(moved_m, 4),
        "placed_deg": round(turned_deg, 3),
        "unchanged": len(unchanged),
        "ids_kept": kept,
        "events": {k: _counts(claimed, done, k) for k in KINDS},
        "missed": sorted((k, t, t in known) for k, t in done - claimed),
        "false": wrong,
        "false_removed_unseen": sum(k == "removed" and _unseen(scenes[1], t) for k, t in wrong),
        "first": objects_found(first),
        "last": objects_found(second),
    }


def objects_found(found: dict[str, Any]) -> dict[str, Any]:
    """Objects and relations after a session: counts."""
    names = ("true_count", "estimated_count", "matched", "duplicates", "merged_pairs")
    out: dict[str, Any] = {k: {n: found[f"instances_{k}"][n] for n in names} for k in ("0.25", "0.50")}
    for name, entry in found["relations"]["by_predicate"].items():
        out[name] = {n: entry[n] for n in ("true_count", "estimated_count", "correct")}
    return out


def _changes(scenes: Sequence[dict[str, Any]], least_px: int = MIN_PX) -> set[tuple[str, int]]:
    """Changes of objects that the camera saw well enough, anywhere."""
    a, b = ({e["id"]: e for e in s["instances"] if not e["structure"]} for s in scenes)
    seen_a, seen_b = ({k for k, e in s.items() if e["largest_px"] >= least_px} for s in (a, b))
    out = {("removed", k) for k in seen_a - set(b)} | {("added", k) for k in seen_b - set(a)}
    return out | {("moved", k) for k in seen_a & seen_b if is_elsewhere(a[k], b[k])}


def is_elsewhere(a: dict[str, Any], b: dict[str, Any] | None) -> bool:
    """Whether an object has moved between two truths. The truth's `carried` distance decides where given: the box of
    the visible part shifts when another side is seen.
    """
    if b is None:
        return True
    places = (
        (a["carried"], b["carried"]) if "carried" in a and "carried" in b else (a["box"]["center"], b["box"]["center"])
    )
    return float(np.linalg.norm(np.subtract(*places))) > ELSEWHERE_M


def _report(
    event: ChangeEvent,
    was: dict[int, int],
    now: dict[int, int],
    scenes: Sequence[dict[str, Any]],
    S_truth_world: Sim3,
) -> tuple[str, int]:
    """Kind of an event and its true object; a number below zero for none. The object is that of the id, else the one
    centred at the event's place; a moved object must be at the event's end.
    """
    places = [
        _there(box, scene, S_truth_world) for box, scene in zip((event.from_box, event.to_box), scenes, strict=True)
    ]
    named = now.get(event.instance_id) if event.kind == "added" else was.get(event.instance_id)
    if named is None:
        named = places[1] if event.kind == "added" else places[0]
    if named is None or (event.kind == "moved" and places[1] != named):
        return event.kind, -event.instance_id
    return event.kind, named


def _there(box: OrientedBox | None, scene: dict[str, Any], S_truth_world: Sim3, most_m: float = 0.1) -> int | None:
    """The object of a scene with the same centre as a box."""
    if box is None:
        return None
    at = S_truth_world.apply(box.center[None])[0]
    objects = [e for e in scene["instances"] if not e["structure"]]
    off = [float(np.linalg.norm(np.array(e["box"]["center"]) - at)) for e in objects]
    return int(objects[int(np.argmin(off))]["id"]) if off and min(off) <= most_m else None


def _unseen(scene: dict[str, Any], obj: int) -> bool:
    return any(e["id"] == obj and e["largest_px"] == 0 for e in scene["instances"])


def _counts(claimed: set[tuple[str, int]], done: set[tuple[str, int]], kind: str) -> dict[str, int]:
    said, true = ({t for k, t in s if k == kind} for s in (claimed, done))
    return {"hit": len(said & true), "false": len(said - true), "missed": len(true - said)}


def _scene(store: Store) -> dict[str, Any]:
    from list3r.exporters.scene_json import scene_dict

    return scene_dict(store)


def _path(store: Store, session: int) -> Trajectory:
    """The path of a session as far as it is in one world with the first chunk, else all of it."""
    chunks = store.chunks.all()
    world = {c.chunk_id for c in chunks if c.component == chunks[0].component}
    every = store.trajectory.poses(session)
    poses = [p for p in every if p[0].chunk_id in world] or every
    T = np.array([Sim3(1.0, S.rotation, S.translation).as_matrix() for _, S in poses])
    return Trajectory(np.array([f.time_s for f, _ in poses]), T)


def _placement(truth: Trajectory, estimate: Trajectory, S_truth_world: Sim3) -> tuple[float, float]:
    """Metres at the middle of the path, and degrees, by which the session as a whole is off."""
    rest = alignment_of(truth, estimate, with_scale=False) @ S_truth_world.inverse()
    middle = S_truth_world.apply(np.median(estimate.T_world_cam[:, :3, 3], axis=0)[None])
    turn = np.degrees(np.arccos(np.clip((np.trace(rest.rotation) - 1) / 2, -1, 1)))
    return float(np.linalg.norm(rest.apply(middle) - middle)), float(turn)


def total(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All seeds together."""
    if not rows:
        return {}
    out: dict[str, Any] = {
        "placed_m_worst": max(r["placed_m"] for r in rows),
        "placed_deg_worst": max(r["placed_deg"] for r in rows),
        "ids_kept": round(sum(r["ids_kept"] for r in rows) / max(sum(r["unchanged"] for r in rows), 1), 4),
        "false_removed_unseen": sum(r["false_removed_unseen"] for r in rows),
    }
    sums = {k: {n: sum(r["events"][k][n] for r in rows) for n in ("hit", "false", "missed")} for k in KINDS}
    sums["all"] = {n: sum(s[n] for s in sums.values()) for n in ("hit", "false", "missed")}
    for kind, s in sums.items():
        out[kind] = {**s, "f1": round(2 * s["hit"] / max(2 * s["hit"] + s["false"] + s["missed"], 1), 4)}
    return out


def redkitchen(root: Path, source: Path, workers: str, cut: int = 500) -> dict[str, Any]:
    """The first frames as one session, the rest as another: nothing has changed, so nothing may be said to."""
    memory = root / "redkitchen.l3r"
    memory.unlink(missing_ok=True)
    common = ("--poses", "estimate", "--workers", workers)
    run_list3r("build", str(source), "-m", str(memory), "--frames", f"0:{cut}", *common)
    with Store.open(memory) as store:
        before = {i.id: i for i in store.instances.all(structure=False)}
    report, usage = run_list3r("update", str(memory), str(source), "--frames", f"{cut}:100000", *common)
    with Store.open(memory) as store:
        events = {e.instance_id: e for e in store.events.all(2)}
        small = [k for k, i in before.items() if np.linalg.norm(i.box.size) < 0.4]
        again = [k for k in small if k in events and events[k].kind == "seen_again"]
        gone = [k for k in small if store.ids.resolve(k) != k]
    changed = [(e.kind, k) for k, e in events.items() if e.kind in KINDS]
    small_objects = {"small": len(small), "small_seen_again": len(again), "small_aliased": len(gone)}
    return {**report["events"], "placed": report["placed"], **usage, **small_objects, "false": changed}


if __name__ == "__main__":
    main()
