"""How right the confidence of instances is in whole memories, and the weights that make it so.

PYTHONPATH=. python benchmarks/confidence.py --keep FOLDER --world 9200-9202 --held 5101-5103 --home 61 --colour 46
PYTHONPATH=. python benchmarks/confidence.py --keep FOLDER --world 9100-9116 --home 51-54,57 --colour 43,44 --fit

Walks of 150 frames (`--colour`: 100) are built with nothing left out for want of confidence: `--world` rooms of the
kind that discovery was trained on, `--held` left-out ones, both with given poses, `--home` the simulator's homes with
a sensor's depth, `--colour` the same by colour alone. An instance is right if it is matched with a true thing by masks
at IoU 0.5; those of things hardly in view do not count. `--fit` prints `ConfidenceWeights` fitted to all walks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from calibration import calibration
from colour import EVERY, LEAST_PX, SIZE, colour_only, compare_masks, memory_masks, true_masks
from discovery import MIN_PX, seeds_of
from discovery_memory import film_of, write_film
from machine import machine, write_json
from numpy.typing import NDArray
from scipy.optimize import minimize

import list3r
from list3r.evaluation.instances import match_boxes
from list3r.evaluation.scene import read_scene
from list3r.memory.library.evidence import EvidenceSettings
from list3r.memory.library.rules import ConsolidationSettings
from list3r.memory.library.uncertainty import ConfidenceWeights, Signs, signs_of
from list3r.memory.overlap.summaries import chunk_summaries
from list3r.memory.store.store import Store
from list3r.pipeline.settings import BuildSettings
from list3r.simulation.dataset import WalkSettings, write_walk
from training.worlds.film import FilmSettings, make_film, varied

KINDS = ("world", "held", "home", "colour")
FRAMES = {"world": 150, "held": 150, "home": 150, "colour": 100}
THRESHOLDS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
SHRINK = 0.003
"""Penalty on the squares of weights of signs of unit variance."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for kind in KINDS:
        parser.add_argument(f"--{kind}", default="", help="seeds, such as 1-3,7")
    parser.add_argument("--keep", type=Path, required=True, help="folder of walks and memories; what is there is kept")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for kind in KINDS:
        for seed in seeds_of(getattr(args, kind)) if getattr(args, kind) else []:
            walk = args.keep / f"{kind}-{seed}"
            found = judged(built(walk, kind, seed), walk, kind)
            rows.append({"kind": kind, "seed": seed, **found})
            print(kind, seed, len(found["instances"]), "instances,", found["true"], "things", flush=True)
    table = {k: summary([r for r in rows if r["kind"] == k]) for k in dict.fromkeys(r["kind"] for r in rows)}
    print(machine())
    for kind, entry in table.items():
        print(kind, json.dumps(entry))
    if args.fit:
        print(fitted(rows))
    write_json(args.json, {"mean": table, "walks": rows})


def built(walk: Path, kind: str, seed: int) -> Path:
    """The memory of a walk, made unless it is there."""
    memory = walk / "memory.l3r"
    if (walk / "done").exists():
        return memory
    if kind in ("world", "held"):
        film = film_of(seed, None, FRAMES[kind], fitted=False) if kind == "held" else make_film(_room(seed))
        write_film(walk, film, seed)
    elif not (walk / "truth.json").exists():
        write_walk(walk, WalkSettings(seed=seed, size=SIZE, write_ids=True, frames=FRAMES[kind]), 0)
    everything = BuildSettings(library=ConsolidationSettings(evidence=EvidenceSettings(least_confidence=0.0)))
    options, source = list3r.SourceOptions(), walk
    if kind == "colour":
        camera = WalkSettings(seed=seed, size=SIZE).camera()
        source = colour_only(walk.parent / f"{walk.name}-pictures", walk)
        options = replace(options, intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy))
        everything = replace(everything, reconstruction="sfm")
    elif kind != "home":
        everything = replace(everything, poses="given")
    list3r.build(source, memory, options=options, settings=everything, workers=0, force=True).close()
    (walk / "done").touch()
    return memory


def _room(seed: int) -> FilmSettings:
    """A room of the kind that discovery was trained on, every frame of it filmed."""
    usual = varied(FilmSettings(seed, fitted=seed % 3 == 2, odd=0.5 if seed % 2 else 0.0))
    return replace(usual, frames=FRAMES["world"], every=1, sensor=("structured", "lidar")[seed // 2 % 2])


def judged(memory: Path, walk: Path, kind: str) -> dict[str, Any]:
    """Signs and confidence of each instance that is no structure, and whether it is right."""
    truth = read_scene(walk / "truth.json")
    frames = range(0, len(list((walk / "rgb").iterdir())), EVERY)
    overlaps = compare_masks(true_masks(walk, frames), memory_masks(memory, frames))
    free = {e["id"] for e in truth["instances"] if not e["structure"]}
    least = MIN_PX if kind in ("world", "held") else LEAST_PX
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


def _signs(memory: Path) -> dict[int, tuple[Signs, float]]:
    """What tells how sure each instance is that is no structure, and how sure it is."""
    with Store.open(memory) as store:
        chunks = {k: s.shapes for k, s in chunk_summaries(store, ConsolidationSettings().shapes).items()}
        groups: dict[int, list[tuple[int, int]]] = {}
        for seen in store.observations.all():
            groups.setdefault(seen.instance_id, []).append((seen.chunk_id, seen.local_id))
        return {
            i.id: (signs_of(groups[i.id], chunks, i.observations), i.confidence)
            for i in store.instances.all()
            if i.structure is None and i.id in groups
        }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How right confidence is, and precision and recall of what is at least so sure."""
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
    """The weights under which what is right of these walks is likeliest."""
    usual = ConfidenceWeights()
    signs = [Signs(**i["signs"]) for r in rows for i in r["instances"]]
    y = np.array([i["right"] for r in rows for i in r["instances"]], float)
    x = np.array([usual.inputs(s) for s in signs])
    middle, spread = x.mean(axis=0), x.std(axis=0)

    def loss(w: NDArray[np.float64]) -> float:
        odds = (x - middle) / spread @ w[1:] + w[0]
        return float(np.logaddexp(0.0, -odds * (2 * y - 1)).mean() + SHRINK * np.square(w[1:]).sum())

    w = minimize(loss, np.zeros(x.shape[1] + 1)).x
    each = w[1:] / spread
    stability, frames, area, size = (round(float(v), 2) for v in each)
    constant = round(float(w[0] - each @ middle), 2)
    return replace(usual, stability=stability, frames=frames, area=area, size=size, constant=constant)


if __name__ == "__main__":
    main()
