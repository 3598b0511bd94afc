"""Calibration of the confidence of instances in whole memories, and fitting of its weights.

PYTHONPATH=. python benchmarks/confidence.py --keep FOLDER --world 9200-9202 --held 5101-5103 --home 61 --colour 46
PYTHONPATH=. python benchmarks/confidence.py --keep FOLDER --frames 450 --world 9100-9103 --home 51-54 --walks ... --fit
PYTHONPATH=. python benchmarks/confidence.py --keep FOLDER --frames 250 --colour 43-48 --json FILE1
PYTHONPATH=. python benchmarks/confidence.py --keep FOLDER --frames 250 --colour 43-48 --every 4 --json FILE2
PYTHONPATH=. python benchmarks/confidence.py --keep FOLDER --colour 43-48 --room 5121-5129 --measured FILE1 FILE2 --fit

Walks of 150 frames (`--colour`: 100; `--frames`) are built, and their libraries derived again without a threshold of
confidence: `--world` rooms of the training distribution, `--held` left-out ones, both with given poses, `--home` the
simulator's homes with a sensor's depth, `--colour` the same by colour alone, `--room` left-out rooms by colour alone
(300 frames, `colour.py --rooms`), each `--every` n-th frame of them. `--walks` are folders kept by
`discovery_memory.py`, `--measured` earlier results. Computed depth has weights of its own: `--fit` takes walks either
with or without a sensor.

An instance is right if it is matched with a true object by masks at IoU 0.5; objects hardly in view are ignored.
`--fit` prints `ConfidenceWeights` fitted to all walks, and their five-fold cross-validation over places.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from calibration import calibration
from colour import EVERY, LEAST_PX, SIZE, colour_only, compare_masks, film_room, memory_masks, true_masks
from discovery import MIN_PX, seeds_of
from discovery_memory import film_of, write_film
from machine import machine, write_json
from numpy.typing import NDArray
from scipy.optimize import minimize

import list3r
from list3r.evaluation.instances import match_boxes
from list3r.evaluation.scene import read_scene
from list3r.frames.source import open_source, require_camera
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.derivation import form
from list3r.memory.library.evidence import EvidenceSettings
from list3r.memory.library.overlap.summaries import chunk_summaries
from list3r.memory.library.rules import ConsolidationSettings, settings_of
from list3r.memory.library.scene import Scene
from list3r.memory.library.uncertainty import OF_COMPUTED_DEPTH, ConfidenceWeights, Signs
from list3r.memory.library.world.world import WORLD
from list3r.memory.store.store import Store
from list3r.pipeline.settings import BuildSettings
from list3r.simulation.dataset import WalkSettings, write_walk
from training.worlds.film import FilmSettings, make_film, varied

KINDS = ("world", "held", "home", "colour", "room")
COMPUTED = {"colour", "room"}
"""Walks without a sensor's depth."""
FRAMES = {"world": 150, "held": 150, "home": 150, "colour": 100, "room": 300}
THRESHOLDS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
FOLDS = 5
SHRINK = 0.003
"""Penalty on the squares of weights of signs of unit variance."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for kind in KINDS:
        parser.add_argument(f"--{kind}", default="", help="seeds, such as 1-3,7")
    parser.add_argument("--walks", type=Path, nargs="*", default=[], help="folders of walks and their learned.l3r")
    parser.add_argument("--measured", type=Path, nargs="*", default=[], help="results that count, too")
    parser.add_argument("--frames", type=int, help="frames of a walk")
    parser.add_argument("--every", type=int, default=1, help="build from every n-th frame of a walk")
    parser.add_argument("--keep", type=Path, required=True, help="folder of walks and memories; existing ones are kept")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = [row for path in args.measured for row in json.loads(path.read_text())["walks"]]
    for kind in KINDS:
        for seed in seeds_of(getattr(args, kind)) if getattr(args, kind) else []:
            frames = args.frames or FRAMES[kind]
            walk = filmed(args.keep / f"{kind}-{seed}-{frames}", kind, seed, frames)
            compared = max(1, EVERY // args.every) * args.every
            found = judged(built(walk, kind, args.every), walk, kind, compared)
            rows.append({"kind": kind, "seed": seed, "place": f"{kind}-{seed}", **found})
            print(kind, seed, len(found["instances"]), "instances,", found["true"], "objects", flush=True)
    for walk in args.walks:
        found = judged(walk / "learned.l3r", walk, "walk", EVERY)
        rows.append({"kind": "walk", "seed": walk.name, "place": "-".join(walk.name.split("-")[:2]), **found})
        print(walk.name, len(found["instances"]), "instances,", found["true"], "objects", flush=True)
    if args.fit and len({r["kind"] in COMPUTED for r in rows}) != 1:
        parser.error("--fit wants walks that all have a sensor's depth, or all none")
    table = {k: summary([r for r in rows if r["kind"] == k]) for k in dict.fromkeys(r["kind"] for r in rows)}
    print(machine())
    for kind, entry in table.items():
        print(kind, json.dumps(entry))
    if args.fit:
        print(fitted(rows))
        print("left out", json.dumps(left_out(rows)))
    write_json(args.json, {"mean": table, "walks": rows})


def filmed(walk: Path, kind: str, seed: int, frames: int) -> Path:
    """The folder of a walk, filmed unless it is there."""
    if (walk / "truth.json").exists():
        return walk
    if kind in ("world", "held"):
        film = film_of(seed, None, frames, fitted=False) if kind == "held" else make_film(_room(seed, frames))
        write_film(walk, film, seed)
    elif kind == "room":
        film_room(walk, seed, frames)
    else:
        write_walk(walk, WalkSettings(seed=seed, size=SIZE, write_ids=True, frames=frames), 0)
    return walk


def built(walk: Path, kind: str, every: int) -> Path:
    """The memory of every n-th frame of a walk, made unless it is there."""
    name = f"-every-{every}" if every > 1 else ""
    memory, done = walk / f"memory{name}.l3r", walk / f"done{name}"
    if done.exists():
        return memory
    settings, options, source = BuildSettings(), list3r.SourceOptions(every=every), walk
    if kind in COMPUTED:
        camera = require_camera(open_source(walk).info)
        source = colour_only(walk.parent / f"{walk.name}-pictures", walk)
        options = replace(options, intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy))
        settings = replace(settings, reconstruction="sfm")
    elif kind != "home":
        settings = replace(settings, poses="given")
    list3r.build(source, memory, options=options, settings=settings, workers=0, force=True).close()
    done.touch()
    return memory


def _room(seed: int, frames: int) -> FilmSettings:
    """A room of the kind that discovery was trained on, every frame of it filmed."""
    usual = varied(FilmSettings(seed, fitted=seed % 3 == 2, odd=0.5 if seed % 2 else 0.0))
    return replace(usual, frames=frames, every=1, sensor=("structured", "lidar")[seed // 2 % 2])


def judged(memory: Path, walk: Path, kind: str, every: int) -> dict[str, Any]:
    """Signs and confidence of each instance that is no structure, and whether it is right by every n-th frame."""
    truth, memory = read_scene(walk / "truth.json"), _with_everything(memory)
    frames = range(0, len(list((walk / "rgb").iterdir())), every)
    overlaps = compare_masks(true_masks(walk, frames), memory_masks(memory, frames))
    free = {e["id"] for e in truth["instances"] if not e["structure"]}
    least = LEAST_PX if kind in ("home", "colour") else MIN_PX
    large = {e["id"] for e in truth["instances"] if not e["structure"] and e["largest_px"] >= least}
    signs = _signs(memory)
    columns = [n for n, k in enumerate(overlaps.ids) if k in signs and overlaps.px[n] > 0]
    rows = [n for n, k in enumerate(overlaps.true_ids) if k in large]
    right = {c for _, c in match_boxes(overlaps.iou()[np.ix_(rows, columns)], 0.5)}
    out = []
    for c, n in enumerate(columns):
        below = overlaps.true_ids[int(overlaps.shared[:, n].argmax())]
        if below not in free or below in large:
            sign, confidence = signs[overlaps.ids[n]]
            out.append({"confidence": confidence, "right": c in right, "signs": asdict(sign)})
    return {"true": len(rows), "instances": out}


def _with_everything(memory: Path) -> Path:
    """A copy of a memory with a library of any confidence."""
    copy = memory.with_suffix(".everything.l3r")
    shutil.copy(memory, copy)
    with Store.open(copy, writable=True) as store, store.transaction():
        consolidate(store, None, ConsolidationSettings(evidence=EvidenceSettings(least_confidence=0.0)))
    return copy


def _signs(memory: Path) -> dict[int, tuple[Signs, float]]:
    """Inputs and value of the confidence of each instance that is no structure."""
    with Store.open(memory) as store:
        settings = settings_of(store, ConsolidationSettings())
        world = store.facts[WORLD]
        assert world is not None
        weighed = form(Scene(store, chunk_summaries(store, settings.shapes), world, settings), ended=True).weighed
        owners = store.observations.owners([key for group in weighed for key in group])
        evidence = {owners[g[0]]: e for g, e in weighed.items() if g[0] in owners}
        listed = [i for i in store.instances.all() if i.structure is None]
        return {i.id: (e.signs, e.confidence) for i in listed if (e := evidence.get(i.id)) and e.signs}


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Calibration, and precision and recall above each confidence."""
    said = np.array([i["confidence"] for r in rows for i in r["instances"]])
    right = np.array([i["right"] for r in rows for i in r["instances"]], bool)
    true = sum(r["true"] for r in rows)
    out: dict[str, Any] = {"walks": len(rows), "things": true, **calibration(said, right)}
    for t in THRESHOLDS:
        kept = right[said >= t]
        out[f"precision_from_{t:g}"] = round(float(kept.mean()), 3) if len(kept) else None
        out[f"recall_from_{t:g}"] = round(float(kept.sum() / max(true, 1)), 3)
    return out


def fitted(rows: Sequence[dict[str, Any]]) -> ConfidenceWeights:
    """Maximum-likelihood weights of these walks."""
    usual = OF_COMPUTED_DEPTH if rows[0]["kind"] in COMPUTED else ConfidenceWeights()
    signs = [Signs(**i["signs"]) for r in rows for i in r["instances"]]
    y = np.array([i["right"] for r in rows for i in r["instances"]], float)
    x = np.array([usual.inputs(s) for s in signs])
    middle, spread = x.mean(axis=0), x.std(axis=0)

    def loss(w: NDArray[np.float64]) -> float:
        odds = (x - middle) / spread @ w[1:] + w[0]
        return float(np.logaddexp(0.0, -odds * (2 * y - 1)).mean() + SHRINK * np.square(w[1:]).sum())

    w = minimize(loss, np.zeros(x.shape[1] + 1)).x
    each = w[1:] / spread
    stability, frames, area, size, found = (round(float(v), 2) for v in each)
    constant = round(float(w[0] - each @ middle), 2)
    return replace(usual, stability=stability, frames=frames, area=area, size=size, found=found, constant=constant)


def left_out(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Calibration of each kind of walk, by five-fold cross-validation over places."""
    places = sorted({r["place"] for r in rows})
    out: list[dict[str, Any]] = []
    for part in range(FOLDS):
        apart = set(places[part::FOLDS])
        weights = fitted([r for r in rows if r["place"] not in apart])
        for r in (r for r in rows if r["place"] in apart):
            report = [weights.probability(Signs(**i["signs"])) for i in r["instances"]]
            said = [i | {"confidence": c} for i, c in zip(r["instances"], report, strict=True)]
            out.append(r | {"instances": said})
    return {k: summary([r for r in out if r["kind"] == k]) for k in dict.fromkeys(r["kind"] for r in rows)}


if __name__ == "__main__":
    main()
