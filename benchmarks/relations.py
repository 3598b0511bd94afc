"""Relations of simulated homes against the truth, with the true masks of objects.

python benchmarks/relations.py --seeds 1,2,3,4 --json benchmarks/results/relations.json

The pictures, depth noise, poses, tracking, merging and all rules are those of a build; only the masks are given, so
that the geometry and the rules are measured without discovery (`benchmarks/simulated.py` measures both together). Walls
and ceilings do not count, and all floors are one. An object counts when it was seen in 12 frames and once covered 300
pixels of 320 x 240. Objects half on a rug have no support in the truth; next_to_decided leaves out pairs within 3 cm of
the bound (two deviations of a measured gap). Every claim counts, whatever its confidence. near and attached_to (to the
right wall) are measured too, and the relations derived on demand: left, right, front and behind of objects near each
other from every 30th camera, and between two objects. The same memory with gravity set to unknown must make no vertical
claim.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from machine import machine, write_json
from relations_asked import asked
from threadpoolctl import threadpool_limits

from list3r.evaluation.relations import Triple, evaluate_relations
from list3r.evaluation.scene import scene_relations
from list3r.frames.chunking.chunks import plan_chunks
from list3r.frames.source import SourceOptions, open_source
from list3r.instances.base import Proposals
from list3r.instances.geometric.features import object_feature
from list3r.instances.geometric.views import chunk_views
from list3r.instances.neural.candidates import plane_of_mask, without_spill
from list3r.instances.settings import FEATURE_SPACE, InstanceSettings
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.store.store import Store
from list3r.pipeline.chunks.chunk import ChunkTask, process_parts
from list3r.pipeline.mapping import add_chunk, finish_session
from list3r.pipeline.settings import BuildSettings
from list3r.queries.relations import VERTICAL
from list3r.simulation.dataset import WalkSettings, frame_name, write_walk
from list3r.simulation.worlds.gaps import surface_gap
from list3r.simulation.worlds.objects import SimulatedObject
from list3r.simulation.worlds.truth import NEXT_TO_M

MIN_PX, MIN_FRAMES = 300, 12
PREDICATES = ("on", "in", "next_to", "near")
ASKED = ("viewpoint", "between")
CLOSE_M = 0.03
"""Pairs with a gap nearer to the bound of next_to than two deviations of a measured gap are undecided."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3,4")
    parser.add_argument("--poses", choices=("given", "estimate"), default="estimate")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch, threadpool_limits(1):
        for seed in (int(word) for word in args.seeds.split(",")):
            rows.append(measure(seed, args.poses, args.keep or Path(scratch)))
            print({k: v for k, v in rows[-1].items() if k not in ("wrong", "missed")})
    pooled = {}
    for name in (*PREDICATES, "next_to_decided", "attached_to", *ASKED):
        true, claimed, correct = (sum(r[name][k] for r in rows) for k in ("true", "claimed", "correct"))
        pooled[name] = {
            "true": true,
            "claimed": claimed,
            "precision": round(correct / claimed, 4) if claimed else None,
            "recall": round(correct / true, 4) if true else None,
        }
        print(f"{name:16} {pooled[name]}")
    vertical = sum(r["vertical_without_gravity"] for r in rows)
    print(f"vertical relations without gravity: {vertical}")
    objects = statistics.fmean(r["things"] for r in rows)
    print(machine())
    write_json(args.json, {"pooled": pooled, "vertical_without_gravity": vertical, "things": objects, "seeds": rows})


def measure(seed: int, poses: str, root: Path) -> dict[str, Any]:
    """One home: build it from given masks, and compare."""
    walk, memory = root / f"walk-{seed}", root / f"memory-{seed}.l3r"
    if not (walk / "truth.json").exists():
        write_walk(walk, WalkSettings(seed=seed, write_ids=True))
    truth = _truth(walk)
    memory.unlink(missing_ok=True)
    with Store.create(memory) as store:
        report = build(store, walk, truth, poses)
        truth_of = _most_common(store, report)
        claimed = [(r.subject, r.predicate, r.object) for r in store.relations.all()]
        kept = {i for i, e in truth.items() if e["frames_seen"] >= MIN_FRAMES and e["largest_px"] >= MIN_PX}
        matched = {k: v for k, v in truth_of.items() if v in kept}
        floors = sorted(i for i, e in truth.items() if e["label"] == "floor")
        one = {i: floors[0] if i in floors else i for i in truth}
        matched = {k: one[v] for k, v in matched.items() if v in floors or not truth[v]["structure"]}
        true = [(one[s], p, one[o]) for s, p, o in _relations(walk)]
        torn = _between_rug_and_floor(seed)
        errors = evaluate_relations(_without(true, torn), _without(claimed, torn, matched), matched, PREDICATES)
        on_walls = {k: v for k, v in truth_of.items() if v in kept}
        attached = evaluate_relations(_relations(walk), claimed, on_walls, ("attached_to",)).total
        near = {(s, o) for s, p, o in true if p == "near"}
        derived = asked(store, WalkSettings(seed=seed), matched, near)
        with store.transaction():
            store.facts.gravity = "unknown"
        vertical = _vertical_without_gravity(store)
    row: dict[str, Any] = {"seed": seed, "things": len(set(matched.values())), "true_things": len(kept)}
    for name, entry in errors.by_predicate.items():
        row[name] = {"true": entry.true_count, "claimed": entry.estimated_count, "correct": entry.correct}
    names = {i: f"{e['label']}#{i}" for i, e in truth.items()}
    close = _close_calls(seed)
    neighbours = {(s, o) for s, p, o in true if p == "next_to"} - close
    wrong = {(s, o) for s, p, o in errors.wrong if p == "next_to"} - close
    missed = {(s, o) for s, p, o in errors.missed if p == "next_to"} - close
    counted = {pair for pair in neighbours if set(pair) <= set(matched.values())}
    correct = len(counted) - len(missed)
    row["attached_to"] = {"true": attached.true_count, "claimed": attached.estimated_count, "correct": attached.correct}
    for name in ASKED:
        row[name] = {k: derived[f"{name}_{k}"] for k in ("true", "claimed", "correct")}
    row["next_to_decided"] = {"true": len(counted), "claimed": correct + len(wrong), "correct": correct}
    row["wrong"] = [f"{names[s]} {p} {names[o]}" for s, p, o in errors.wrong]
    row["missed"] = [f"{names[s]} {p} {names[o]}" for s, p, o in errors.missed]
    row["vertical_without_gravity"] = vertical
    return row


def build(store: Store, walk: Path, truth: dict[int, dict[str, Any]], poses: str) -> dict[tuple[int, int], int]:
    """Add all chunks with given masks; the true id of every local instance."""
    settings = BuildSettings("rgbd", poses, keep_pictures=False)
    source = open_source(walk, SourceOptions())
    with store.transaction():
        store.facts.scale_kind = "metric"
        store.facts.poses = poses
        session = store.sessions.add(str(walk), "", {"poses": poses}, source.info.frame_count)
    report: dict[tuple[int, int], int] = {}
    for span in plan_chunks(source.info.frame_count, settings.chunks):
        discoverer = ToldMasks(walk, truth, settings.instances)
        result = process_parts(ChunkTask(str(walk), SourceOptions(), span, settings), discoverer)[-1]
        chunk = add_chunk(store, session, result)
        for instance in result.library.instances:
            report[chunk, instance.local_id] = _true_id(walk, instance.track)
    finish_session(store, session)
    return report


class ToldMasks:
    """A discoverer that reads the ids of the objects from the truth."""

    feature_space = FEATURE_SPACE

    def __init__(self, walk: Path, truth: dict[int, dict[str, Any]], settings: InstanceSettings) -> None:
        self._walk, self._truth, self._settings = walk, truth, settings

    def __call__(self, frames: Any, reconstruction: Any, position: int) -> Proposals:
        """True masks on the frame at `position`, each object once."""
        views = chunk_views(frames, reconstruction, self._settings)
        view = views.view(position)
        ids = _ids(self._walk, int(frames[position].index))
        area = np.bincount(ids.ravel())
        present = [int(k) for k in np.flatnonzero(area >= 20) if int(k) in self._truth]
        labels = np.zeros(ids.shape, np.int32)
        features = []
        for number, obj in enumerate(present):
            mask = ids == obj
            labels[mask] = number + 1
            small = mask[:: views.stride, :: views.stride] & view.confirmed
            up = -view.T_chunk_cam[:3, 1]
            points = view.points[small] if small.any() else np.zeros((1, 3), np.float32)
            rgb = view.rgb[small] if small.any() else np.zeros((1, 3), np.uint8)
            features.append(object_feature(points, rgb, up, views.unit))
        labels = without_spill(labels, view, views.stride)
        bounds = [bool(self._truth[k]["structure"]) for k in present]
        planes = np.full((len(present), 4), np.nan)
        for n in np.flatnonzero(bounds).tolist():
            planes[n] = plane_of_mask(labels == n + 1, views, position)
        return Proposals(
            position,
            labels,
            np.ones(len(present), np.float32),
            np.array(features, np.float32).reshape(len(present), -1),
            planes,
            identity=np.array(present, np.int64),
            structure=np.array(bounds, bool),
        )


def _ids(walk: Path, index: int) -> np.ndarray:
    image = cv2.imread(str(walk / "ids" / f"{frame_name(index)}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image.astype(np.int32)


def _true_id(walk: Path, track: Any) -> int:
    """The object that most of a track's masks are on."""
    from list3r.memory.core.masks import decode_mask

    votes: Counter[int] = Counter()
    for row in range(0, len(track.frames), 5):
        mask = decode_mask(track.masks[row], track.image_size)
        under = _ids(walk, int(track.frames[row]))[mask]
        votes.update({int(k): int(n) for k, n in zip(*np.unique(under, return_counts=True), strict=True)})
    return votes.most_common(1)[0][0]


def _most_common(store: Store, report: dict[tuple[int, int], int]) -> dict[int, int]:
    """True id of every global instance; of several instances of one object the one with most observations counts."""
    votes: dict[int, Counter[int]] = {}
    for seen in store.observations.all():
        votes.setdefault(seen.instance_id, Counter())[report[seen.chunk_id, seen.local_id]] += 1
    best: dict[int, tuple[int, int]] = {}
    for instance, counter in sorted(votes.items()):
        true, count = counter.most_common(1)[0]
        if true not in best or count > best[true][0]:
            best[true] = (count, instance)
    return {instance: true for true, (_, instance) in best.items()}


def _close_calls(seed: int) -> set[tuple[int, int]]:
    """Pairs of objects for which next_to is undecided at an error of a few centimetres."""
    objects = [t for t in WalkSettings(seed=seed).world().objects if t.structure is None]
    close = set()
    for a in objects:
        for b in objects:
            if a.id != b.id:
                limit = float(np.clip(0.25 * (a.box().size.max() + b.box().size.max()), *NEXT_TO_M))
                if abs(limit - surface_gap(a, b)) < CLOSE_M:
                    close.add((a.id, b.id))
    return close


def _without(triples: list[Triple], torn: set[tuple[int, int]], truth_of: dict[int, int] | None = None) -> list[Triple]:
    """The triples without excluded ones: support of objects half on a rug, and whether they are near it."""
    objects = {obj for obj, _ in torn}
    pairs = torn | {(rug, obj) for obj, rug in torn}
    named = [(s, o) if truth_of is None else (truth_of.get(s), truth_of.get(o)) for s, _, o in triples]
    return [
        t
        for t, (s, o) in zip(triples, named, strict=True)
        if not (t[1] == "on" and s in objects) and not (t[1] == "near" and (s, o) in pairs)
    ]


def _between_rug_and_floor(seed: int) -> set[tuple[int, int]]:
    """Objects with some feet on a rug and some next to it, where neither is the answer; with the rug."""
    objects = WalkSettings(seed=seed).world().objects
    torn = set()
    for rug_id, rug in ((t.id, t.box()) for t in objects if t.label == "rug"):
        for obj in objects:
            feet = [b for b in part_boxes(obj) if b.center[2] - b.size[2] / 2 < 0.05]
            if obj.structure is None and obj.label != "rug" and feet:
                away = [np.abs((b.center - rug.center) @ rug.rotation)[:2] - rug.size[:2] / 2 for b in feet]
                over = [bool((a < 0).all()) for a in away]
                if any(over) and not all(over):
                    torn.add((obj.id, rug_id))
    return torn


def part_boxes(obj: SimulatedObject) -> list[OrientedBox]:
    """The box of each part of an object in the world."""
    rotation, position = obj.rotation(), np.array(obj.position)
    corners = [part.extent() for part in obj.parts]
    return [OrientedBox(position + rotation @ ((low + high) / 2), high - low, rotation) for low, high in corners]


def _vertical_without_gravity(store: Store) -> int:
    """Vertical relations that a consolidation without gravity leaves; a relation query must call them unknown."""
    from list3r.memory.library.consolidation import consolidate

    with store.transaction():
        consolidate(store)
    return sum(r.predicate in VERTICAL for r in store.relations.all())


def _truth(walk: Path) -> dict[int, dict[str, Any]]:
    import json

    return {int(e["id"]): e for e in json.loads((walk / "truth.json").read_text())["instances"]}


def _relations(walk: Path) -> list[tuple[int, str, int]]:
    import json

    return scene_relations(json.loads((walk / "truth.json").read_text()))


if __name__ == "__main__":
    main()
