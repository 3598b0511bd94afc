"""Precision of the names of objects in one chunk, also in places that others furnished, and fitting of their
confidence.

PYTHONPATH=. python benchmarks/names.py --left-out 6001-6010 --left-out-fitted 6101-6106 --keep FOLDER
PYTHONPATH=. python benchmarks/names.py --place .../worlds/office_small.world=1-24 --keep FOLDER
PYTHONPATH=. python benchmarks/names.py --left-out 5000-5011 --left-out-fitted 5500-5511 --room 8000-8005 \\
    --fitted 8300-8302 --odd 8600-8605 --keep FOLDER --fit

Rooms are those of `training/worlds`; `--left-out` ones have kinds, textures and a sensor that training never shows,
`--odd` ones objects without a name. A place is a file of a Gazebo world, or the folder of one. All listed instances
without structure are scored: a name is right if the best matching true object by voxels, with an IoU of 0.25, has it;
any name of an instance without a match, or of an object without a known name, is wrong. A branch ("seat") is right if
the true name is in it. `--fit` prints the `NameConfidence` fitted to the given rooms, all kinds with equal weight, and
from which probability on names and branches are right often enough there.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from calibration import calibration
from discovery import seeds_of
from machine import machine, write_json
from numpy.typing import NDArray
from scipy.optimize import minimize

from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import CutSettings, join_parts
from list3r.instances.learned.discovery import LearnedSettings, named
from list3r.instances.learned.graph import chunk_surface
from list3r.instances.learned.name_confidence import NameConfidence, NameSigns, name_signs, with_confidence
from list3r.instances.learned.pieces import cut_pieces
from list3r.instances.learned.verdicts import SegmentVerdicts, first_verdicts, names_of, segment_features
from list3r.instances.learned.weights import load_weights
from list3r.instances.settings import SegmentSettings
from list3r.memory.core.description.nouns import is_a
from list3r.memory.core.records import Votes
from list3r.memory.library.labels import (
    OWN_NAMES,
    LabelSettings,
    decide_by_rank,
    decide_kind,
    votes_of_probabilities,
)
from training.graphs import surroundings_of
from training.samples import Sample, sample_of
from training.worlds.catalogue import LABELS
from training.worlds.film import FilmSettings, make_film, varied

IOU = 0.25
LEAST = (0.5, 0.6, 0.65, 0.7, 0.8)
SHRINK = 0.003
"""Penalty on the squares of weights of signs of unit variance."""
DRAWERS = "chest of drawers|cupboard|nightstand|wardrobe"
CALLED = {
    r"(office_|kitchen_)?chair|Chair[A-Z]": "chair|armchair",
    r"chair_set": "chair|armchair|sofa",
    r"sofa_set|Sofa.?": "sofa|armchair",
    r"(side|coffee)_table(_set)?|cafe_table|CoffeeTable|BalconyTable": "table|nightstand|stool",
    r"table_\w+|desk_brown|desk_yellow|ReadingDesk|KitchenTable": "table|desk",
    r"desk_drawer": "desk|table|chest of drawers|nightstand",
    r"file_cabinet_\w+|drawer_white": DRAWERS,
    r"NightStand|TVCabinet": DRAWERS + "|table",
    r"KitchenCabinet|CookingBench": "cupboard|counter|chest of drawers",
    r"Wardrobe": "wardrobe|cupboard",
    r"ShoeRack": "shelf|cupboard",
    r"bookshelf\w*": "shelf",
    r"Refrigerator": "fridge",
    r"Rangehood": "hood",
    r"Airconditioner[AB]": "air conditioner",
    r"Bed": "bed",
    r"Quilt": "duvet|blanket|cloth",
    r"Pillow": "pillow|cushion",
    r"Carpet": "rug",
    r"Curtain": "curtain|blind",
    r"Ball": "ball",
    r"Board": "board|picture",
    r"picture_frame_\w+|Portrait[A-Z]|DeskPortrait[A-Z]": "picture",
    r"monitor|TV": "monitor|television",
    r"computer_case": "computer",
    r"la[pb]top_\w+": "laptop",
    r"keyboard": "keyboard",
    r"mouse": "mouse",
    r"lamp_\w+|LightC|Chandelier": "lamp",
    r"book|book_\w+|file": "book",
    r"newspaper": "paper|book",
    r"file_box": "box|basket",
    r"(tissue|tea|coffee|biscuit)_box|SeasoningBox": "box",
    r"cup_\w+": "mug|glass|can",
    r"mug_beer": "mug|glass|jug",
    r"can_\w+": "can",
    r"bottle_\w+|glue_bottle": "bottle",
    r"plate": "plate|bowl",
    r"bowl": "bowl",
    r"tray": "tray",
    r"figurine": "ornament|toy",
    r"vase\w*|Vase": "vase",
    r"pot_flower|plant\w*": "plant|vase",
    r"clock_\w+": "clock",
    r"door\w*|(Folding)?Door": "door",
    r"window\w*|RoomWindow": "window",
}
"""Names of models of places that others furnished; the first match counts."""


@dataclass(frozen=True)
class Named:
    """The T listed objects of a chunk."""

    signs: NameSigns
    before: NDArray[np.float64]
    """Probability of the likeliest name as the judge gives it. Shape (T,)."""
    right: NDArray[np.bool_]
    """Whether the likeliest name is right. Shape (T,)."""
    nameable: NDArray[np.bool_]
    """Whether it fits an object that one of the names goes with. Shape (T,)."""
    votes: list[Votes]
    """What the discoverer says of each object in a build."""
    calls: list[frozenset[str]]
    """The names that each may truly have."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for kind in ("left-out", "left-out-fitted", "room", "fitted", "odd"):
        parser.add_argument(f"--{kind}", default="", help="seeds, such as 1-3,7")
    parser.add_argument("--place", action="append", default=[], metavar="PATH=SEEDS", help="walks in a Gazebo world")
    parser.add_argument("--keep", type=Path, required=True, help="folder of results; existing ones are kept")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--json", type=Path)
    words = vars(parser.parse_args())
    found: dict[str, list[Named]] = {}
    for group, name, make in _samples(words):
        found.setdefault(group, []).append(_kept(words["keep"] / f"{name}.npz", make))
        print(name, len(found[group][-1].right), "objects", flush=True)
    table = {group: summary(rows) for group, rows in found.items()}
    print(machine())
    for group, entry in table.items():
        print(group, json.dumps(entry))
    if words["fit"]:
        print(fitted(list(found.values())))
        print(sure_enough([r for rows in found.values() for r in rows]))
    write_json(words["json"], {"mean": table})


def _samples(words: Mapping[str, Any]) -> Iterator[tuple[str, str, Callable[[], Sample]]]:
    """Yield the group, the name and the maker of each chunk."""
    for kind in ("left_out", "left_out_fitted", "room", "fitted", "odd"):
        for seed in seeds_of(words[kind]) if words[kind] else []:
            yield kind.partition("_fitted")[0] if kind[0] == "l" else "rooms", f"{kind}-{seed}", _room(kind, seed)
    for text in words["place"]:
        path, _, seeds = text.rpartition("=")
        for seed in seeds_of(seeds):
            yield Path(path).stem, f"{Path(path).stem}-{seed}", _walk(Path(path), seed)


def _room(kind: str, seed: int) -> Callable[[], Sample]:
    held = kind.startswith("left_out")
    fitted = kind.endswith("fitted") or (kind == "odd" and (seed - 8600) % 3 == 2)
    s = FilmSettings(seed, held_out=held, fitted=fitted, odd=0.5 if kind == "odd" else 0.0)
    s = s if held else varied(s)
    return lambda: sample_of(make_film(s), seed, s.every)


def _walk(place: Path, seed: int) -> Callable[[], Sample]:
    from training.worlds.gazebo import film_house

    return lambda: sample_of(film_house(place, seed, ("structured", "lidar", "tof")[seed % 3]), seed, 2)


def _kept(path: Path, make: Callable[[], Sample]) -> Named:
    """The objects of a chunk, judged unless they are there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **listed(make()))  # type: ignore[arg-type]
    with np.load(path) as data:
        a = {name: data[name] for name in data.files}
    whole, structure = a["whole"], a["structure"]
    names = a["names"]
    signs = name_signs(names, whole, structure)
    rows = np.flatnonzero((whole >= LearnedSettings().least_confidence) & (structure <= 0.5))
    calls = [_calls(label) if iou >= IOU else frozenset() for label, iou in zip(a["label"], a["iou"], strict=True)]
    right = np.array([LABELS[k] in c for k, c in zip(names.argmax(axis=1), calls, strict=True)])
    nameable = np.array([bool(c) for c in calls])
    kept = NameSigns(signs.odds[rows], signs.whole[rows], signs.others)
    believed = with_confidence(names, NameConfidence().probability(signs))[rows]
    likely = named(SegmentVerdicts(structure[rows], whole[rows], believed), LABELS)
    votes = [votes_of_probabilities(said) for said in likely]
    return Named(kept, names.max(axis=1)[rows], right[rows], nameable[rows], votes, [calls[k] for k in rows])


def _calls(label: str) -> frozenset[str]:
    """The names that a true object may have."""
    if label in LABELS:
        return frozenset([label])
    return frozenset(next((n for p, n in CALLED.items() if re.fullmatch(p, label)), "").split("|")) - {""}


def listed(sample: Sample) -> dict[str, NDArray[Any]]:
    """Features and verdicts of the objects of a chunk, and the best match of each by voxels, with its IoU."""
    weights = load_weights(sensed=not sample.computed)
    cloud = sample.cloud(SegmentSettings().grain_m(sensed=not sample.computed))
    truth = sample.truth_of(cloud).astype(np.int64)
    surface = chunk_surface(cloud, sample.views, surroundings_of(sample))
    parts, graph, scores = join_parts(surface, cut_pieces(surface), weights, CutSettings())
    own = agglomerate(len(graph.nodes), graph.left, graph.right, scores.affinity, graph.weight, CutSettings().enough)
    structure, x = segment_features(own, graph, scores)
    whole, names = first_verdicts(weights, x)
    cluster = np.append(own, -1)[parts]
    shared = np.zeros((len(x), int(truth.max()) + 1))
    np.add.at(shared, (cluster[cluster >= 0], truth[cluster >= 0]), 1)
    iou = shared / (shared.sum(axis=1)[:, None] + np.bincount(truth) - shared)
    iou[:, 0] = 0.0
    labels = {t.id: "" if t.structure else t.label for t in sample.things}
    label = np.array([labels.get(k, "") for k in iou.argmax(axis=1).tolist()], str)
    assert names_of(weights) == LABELS
    return {"x": x, "structure": structure, "whole": whole, "names": names, "label": label, "iou": iou.max(axis=1)}


def summary(rows: Sequence[Named]) -> dict[str, Any]:
    """Coverage and precision of names from several probabilities on, with calibrated and raw confidence."""
    belief = NameConfidence()
    nameable = np.concatenate([r.nameable for r in rows])
    out: dict[str, Any] = {"walks": len(rows), "things": len(nameable), "nameable": int(nameable.sum())}
    right = np.concatenate([r.right for r in rows])
    for word, said in (("before", [r.before for r in rows]), ("now", [belief.probability(r.signs) for r in rows])):
        p = np.concatenate(said)
        entry: dict[str, Any] = {**calibration(p, right)}
        for t in LEAST:
            shown = p >= t
            share = round(float(shown[nameable].mean()), 3)
            entry[f"from_{t:g}"] = {"named": int(shown.sum()), "wrong": int((shown & ~right).sum()), "coverage": share}
        out[word] = entry
    return {**out, "told": told(rows, LabelSettings())}


def told(rows: Sequence[Named], settings: LabelSettings) -> dict[str, Any]:
    """Return how many objects get a name, a branch or a description, and the shares of the first two that are right."""
    count, right = {"leaf": 0, "branch": 0, "description": 0}, {"leaf": 0, "branch": 0}
    for votes, calls in ((v, c) for r in rows for v, c in zip(r.votes, r.calls, strict=True)):
        leaf, kind = (f({OWN_NAMES: votes}, None, settings) for f in (decide_by_rank, decide_kind))
        level = "leaf" if leaf else "branch" if kind else "description"
        count[level] += 1
        if leaf:
            right["leaf"] += leaf[0] in calls
        elif kind:
            right["branch"] += any(is_a(c, kind[0]) for c in calls)
    return {**count, **{f"{k}_right": round(n / max(count[k], 1), 3) for k, n in right.items()}}


def sure_enough(rows: Sequence[Named]) -> LabelSettings:
    """Return the least probabilities from which on names are right in 0.9 and branches in 0.95 of the cases."""
    chosen = LabelSettings(min_own=0.99, min_branch=0.99)
    for name, level, wanted in (("min_own", "leaf", 0.9), ("min_branch", "branch", 0.95)):
        for least in np.arange(0.5, 0.96, 0.01).round(2).tolist():
            tried = replace(chosen, **{name: least})
            said = told(rows, tried)
            if said[level] and said[f"{level}_right"] >= wanted:
                chosen = tried
                break
    return chosen


def fitted(groups: Sequence[Sequence[Named]]) -> NameConfidence:
    """Maximum-likelihood weights, each group with equal weight."""
    signs = [r.signs for rows in groups for r in rows]
    x = np.concatenate([np.column_stack([s.odds, s.whole, np.full(len(s.odds), s.others)]) for s in signs])
    y = np.concatenate([r.right for rows in groups for r in rows]).astype(float)
    counts = [sum(len(r.right) for r in rows) for rows in groups]
    weight = np.concatenate([np.full(n, 1.0 / n / len(counts)) for n in counts])
    middle, spread = x.mean(axis=0), x.std(axis=0)

    def loss(w: NDArray[np.float64]) -> float:
        odds = (x - middle) / spread @ w[1:] + w[0]
        return float((weight * np.logaddexp(0.0, -odds * (2 * y - 1))).sum() + SHRINK * np.square(w[1:]).sum())

    w = minimize(loss, np.zeros(x.shape[1] + 1)).x
    each = w[1:] / spread
    odds, whole, others = (round(float(v), 3) for v in each)
    return NameConfidence(odds, whole, others, round(float(w[0] - each @ middle), 2))


if __name__ == "__main__":
    main()
