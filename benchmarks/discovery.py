"""Instance discovery, against the truth of left-out worlds.

PYTHONPATH=. python benchmarks/discovery.py --seeds 6001-6010 --json benchmarks/results/discovery.json
PYTHONPATH=. python benchmarks/discovery.py --house FOLDER/aws-robomaker-small-house-world --seeds 1-3
PYTHONPATH=. python benchmarks/discovery.py --seeds 6001-6010 --colour grey
PYTHONPATH=. python benchmarks/discovery.py --seeds 6001-6010 --swept

Worlds come from `training/worlds` with families, textures and a sensor that training never shows; the house is one that
others furnished (MIT-0), given by its folder. Each walk is one chunk with poses that drift by some millimetres; the
truth is aligned with it by all its cameras, as scenes are. An object counts from 150 pixels in a view; its true box is
that of its visible surface. With `--swept` depth comes from our plane sweep over the pictures instead of a sensor;
walks with too little depth are left out. Estimates mostly on an object of fewer pixels are ignored.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from calibration import calibration
from machine import machine, write_json
from numpy.typing import NDArray

from list3r.evaluation.instances import evaluate_instances, match_boxes
from list3r.evaluation.scene import alignment_of
from list3r.evaluation.trajectory import Trajectory
from list3r.instances.base import Discoverer, Proposals
from list3r.instances.geometric.fusion import View
from list3r.instances.geometric.support import thin, without_fliers, without_rims
from list3r.instances.geometric.views import ChunkViews, chunk_views, forget_views
from list3r.instances.library import select_prompts
from list3r.instances.settings import InstanceSettings, MaskTrackSettings
from list3r.memory.core.geometry import OrientedBox, Sim3, upright_box
from list3r.memory.library.relations.instance_geometry import fit_box, without_strays
from list3r.reconstruction.base import Reconstruction, backproject
from training.samples import chunk_settings
from training.swept import swept
from training.worlds.catalogue import LABELS
from training.worlds.film import Film, FilmSettings, frames_of, make_film, reconstruction_of

MIN_PX = 150
"""Pixels of its largest view from which a true object counts."""
SMALL_M = 0.3
"""Longest edge up to which an object is small."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="6001-6010", help="such as 6001-6010 or 3,5,8")
    parser.add_argument("--methods", default="learned,true", help="of learned, true")
    parser.add_argument("--sensor", help="structured, tof, lidar or computed; without it each world draws one")
    parser.add_argument("--fitted", action="store_true", help="rooms with built-in parts")
    parser.add_argument("--recessed", action="store_true", help="windows and doors behind the walls; a third built in")
    parser.add_argument("--house", type=Path, help="folder of a Gazebo world, or a labelled scan (PCD); walks there")
    parser.add_argument("--colour", choices=("grey", "none"), help="pictures without hue, or without anything to see")
    parser.add_argument("--swept", action="store_true", help="depth that the plane sweep computes from the pictures")
    parser.add_argument("--weights", type=Path, help="weights of the learned discoverer instead of the shipped ones")
    parser.add_argument("--also", action="append", default=[], metavar="NAME=FILE", help="other weights of it next to")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    weights = {"learned": args.weights} | {n: Path(f) for n, _, f in (text.partition("=") for text in args.also)}
    methods = [*filter(None, args.methods.split(",")), *(n for n in weights if n != "learned")]
    for seed in seeds_of(args.seeds):
        film = film_of(seed, args.sensor, args.house, fitted=args.fitted, recessed=args.recessed)
        if args.colour:
            film = replace(film[0], color=without_colour(film[0].color, args.colour)), film[1]
        reconstruction = swept(film[0], seed) if args.swept else reconstruction_of(film[0], seed=seed)
        if reconstruction is None:
            print(f"{seed}: too little depth", flush=True)
            continue
        for method in methods:
            said = judge(film, reconstruction, method, weights.get(method))
            sensor = "swept" if args.swept else film[0].sensor
            rows.append({"method": method, "seed": seed, "sensor": sensor, **said})
            print(json.dumps(rows[-1]), flush=True)
    if not rows:
        raise SystemExit("no walk has enough depth to be judged")
    table = {m: summary([r for r in rows if r["method"] == m]) for m in methods}
    print(machine())
    for method, entry in table.items():
        print(method, json.dumps(entry))
    kind = "recessed worlds" if args.recessed else "worlds"
    source = "house" if args.house else f"fitted {kind}" if args.fitted else kind
    source += f", colour: {args.colour}" if args.colour else ""
    source += ", depth by plane sweep" if args.swept else ""
    write_json(args.json, {"source": source, "least_px": MIN_PX, "mean": table, "walks": rows})


def seeds_of(text: str) -> list[int]:
    """The numbers of a list such as 1-3,7."""
    out: list[int] = []
    for word in text.split(","):
        low, _, high = word.partition("-")
        out += range(int(low), int(high or low) + 1)
    return out


def film_of(
    seed: int, sensor: str | None, house: Path | None, *, fitted: bool = False, recessed: bool = False
) -> tuple[Film, int]:
    """A walk, and of how many frames one is filmed."""
    if house is not None:
        from training.worlds.gazebo import film_house

        return film_house(house, seed, sensor or ("structured", "lidar", "tof")[seed % 3]), 2
    built_in = fitted or (recessed and seed % 3 == 2)
    settings = FilmSettings(seed, held_out=True, sensor=sensor, fitted=built_in, recessed=recessed)
    return make_film(settings), settings.every


def without_colour(color: NDArray[np.uint8], left: str) -> NDArray[np.uint8]:
    """Pictures (F, H, W, 3) reduced to brightness ("grey") or to one shade ("none")."""
    if left == "none":
        return np.full_like(color, 150)
    return np.stack([np.repeat(cv2.cvtColor(c, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2) for c in color])


def judge(film: tuple[Film, int], reconstruction: Reconstruction, method: str, weights: Path | None) -> dict[str, Any]:
    """The figures of one method on one walk."""
    shown, every = film
    settings, frames = chunk_settings(every), frames_of(shown)
    views = chunk_views(frames, reconstruction, settings)
    discoverer = make(method, settings, shown, weights)
    started = time.process_time()
    found = [select_prompts(discoverer(frames, reconstruction, p), settings) for p in views.anchors]
    spent = time.process_time() - started
    forget_views()
    return {**figures(shown, views, found), "cpu_s": round(spent, 2), "frames": len(shown.time_s) * every}


def make(method: str, settings: InstanceSettings, film: Film, weights: Path | None) -> Discoverer:
    """The discoverer of a name."""
    if method == "true":
        return TrueDiscoverer(film)
    from list3r.instances.learned.discovery import LearnedDiscoverer

    return LearnedDiscoverer(settings, weights)


class TrueDiscoverer:
    """Proposes the true masks: the upper bound of discovery in these views."""

    feature_space = "true@1/1"

    def __init__(self, film: Film) -> None:
        self._film = film
        self._structure = {t.id: t.structure for t in film.things}

    def __call__(self, frames: Any, reconstruction: Any, position: int) -> Proposals:
        """The true masks of a frame."""
        ids = np.unique(self._film.ids[position])
        ids = ids[ids > 0].astype(np.int64)
        table = np.zeros(int(self._film.ids[position].max()) + 1, np.int32)
        table[ids] = np.arange(1, len(ids) + 1)
        count = len(ids)
        structure = np.array([self._structure[i] for i in ids.tolist()], bool)
        plane = np.full((count, 4), np.nan)
        ones = np.ones((count, 1), np.float32)
        return Proposals(position, table[self._film.ids[position]], ones[:, 0], ones, plane, ids, structure)


def figures(film: Film, views: ChunkViews, found: Sequence[Proposals]) -> dict[str, Any]:
    """Instances by boxes at IoU 0.25 and 0.5, and structure by pixels."""
    T_chunk_world = _laid_by_cameras(film, views)
    frame = _upright(T_chunk_world.rotation @ np.array([0.0, 0.0, 1.0]))
    stride, structural = views.stride, {t.id for t in film.things if t.structure}
    true, report, pairs = _Gathered(), _Gathered(), []
    said: dict[int, tuple[float, str, float]] = {}
    right = claimed = there = 0
    for proposals in found:
        view = views.view(proposals.position)
        ids = film.ids[proposals.position][::stride, ::stride].astype(np.int64)
        labels = proposals.labels[::stride, ::stride]
        said |= _said(proposals)
        identity = np.append(-1, proposals.identity if proposals.identity is not None else [])[labels]
        flat = np.append(False, proposals.structure if proposals.structure is not None else [])[labels].astype(bool)
        bound = np.isin(ids, list(structural)) & view.confirmed
        there, claimed, right = (
            there + bound.sum(),
            claimed + (flat & view.confirmed).sum(),
            right + (bound & flat).sum(),
        )
        points = view.points @ frame.T
        mine, theirs = np.where(np.isin(ids, list(structural)), -1, ids - 1), np.where(flat, -1, identity)
        true.add(
            _true_points(film, views, proposals.position, T_chunk_world) @ frame.T,
            mine,
            views.small_depth(proposals.position) > 0,
        )
        report.add(points, _without_skirts(theirs, views, view), view.confirmed)
        pairs.append(np.stack([mine[view.confirmed], theirs[view.confirmed]], axis=1))
    pixels, large = np.concatenate(pairs), true.large(MIN_PX)
    wanted = list(true.boxes(MIN_PX).values())
    faint = [box for value, box in true.boxes().items() if value not in large]
    of_faint = _of_faint(pixels, large)
    boxes = [box for value, box in report.boxes_of_supports().items() if value not in of_faint]
    out: dict[str, Any] = {"true": len(wanted), "structure": [int(right), int(claimed), int(there)]}
    for threshold in (0.25, 0.5):
        kept = _without_faint(wanted, faint, boxes, threshold)
        errors = evaluate_instances(wanted, kept, threshold)
        tag = f"{threshold:g}"
        out |= {f"found_{tag}": errors.matched, f"listed_{tag}": errors.estimated_count}
        if threshold == 0.25:
            small = [k for k, b in enumerate(wanted) if max(b.size) < SMALL_M]
            hit = {t for t, _, _ in errors.matches}
            out |= {"duplicates": errors.duplicates, "merged": errors.merged_pairs}
            out |= {"small": len(small), "small_found": sum(k in hit for k in small)}
    return out | _by_masks(pixels, large) | _as_sure_as_right(pixels, large, said, {t.id: t.label for t in film.things})


def _without_skirts(labels: NDArray[np.int64], views: ChunkViews, view: View) -> NDArray[np.int64]:
    """Objects of a view's pixels, -1 for none, without pixels that memories leave out, see `collect_supports`."""
    if views.reconstruction.depth_noise is None:
        return labels
    image = (labels + 1).astype(np.int32)
    return without_rims(image, view.depth, int(image.max())).astype(np.int64) - 1


def _laid_by_cameras(film: Film, views: ChunkViews) -> Sim3:
    """The alignment of the truth with the chunk."""
    truth, chunk = (Trajectory(film.time_s, T) for T in (film.T_world_cam, views.reconstruction.T_chunk_cam))
    return alignment_of(chunk, truth, with_scale=False)


def _true_points(film: Film, views: ChunkViews, position: int, T_chunk_world: Sim3) -> NDArray[np.float32]:
    """The true surface in a view, in the chunk's frame; readings that fly at outlines stretch boxes. (h, w, 3)."""
    T = T_chunk_world.as_matrix() @ film.T_world_cam[position]
    depth = np.ascontiguousarray(film.true_depth[position][:: views.stride, :: views.stride])
    points = backproject(depth, views.camera) @ T[:3, :3].T + T[:3, 3]
    return np.asarray(points, np.float32)


def _by_masks(pairs: NDArray[np.int64], large: set[int]) -> dict[str, int]:
    """Objects found and listed by IoU of their pixels over all views, of those that are `large` enough to count."""
    true, _, iou = _mask_ious(pairs)
    wanted = np.array([t in large for t in true.tolist()], bool)
    out = {}
    for threshold in (0.25, 0.5):
        matches = match_boxes(iou, threshold)
        faint = sum(not wanted[t] for t, _ in matches)
        tag = f"{threshold:g}"
        out |= {f"mask_found_{tag}": len(matches) - faint, f"mask_listed_{tag}": iou.shape[1] - faint}
    return out


def _mask_ious(pairs: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """True objects (T,), found ones (E,), and the IoU of their pixels over all views (T, E)."""
    true, at = np.unique(pairs[:, 0], return_inverse=True)
    report, to = np.unique(pairs[:, 1], return_inverse=True)
    shared = np.zeros((len(true), len(report)))
    np.add.at(shared, (at, to), 1)
    union = shared.sum(axis=1, keepdims=True) + shared.sum(axis=0, keepdims=True) - shared
    return true[true >= 0], report[report >= 0], (shared / union)[true >= 0][:, report >= 0]


class _Gathered:
    """Points of objects over the views."""

    def __init__(self) -> None:
        self._points: dict[int, list[NDArray[np.float32]]] = {}
        self._most: dict[int, int] = {}

    def add(self, points: NDArray[np.float32], labels: NDArray[np.int64], confirmed: NDArray[np.bool_]) -> None:
        rows = np.flatnonzero(labels.ravel() >= 0)
        order = rows[np.argsort(labels.ravel()[rows], kind="stable")]
        values, start = np.unique(labels.ravel()[order], return_index=True)
        for value, mine in zip(values.tolist(), np.split(order, start[1:]) if len(order) else [], strict=True):
            self._most[value] = max(self._most.get(value, 0), len(mine))
            sure = mine[confirmed.ravel()[mine]]
            self._points.setdefault(value, []).append(points.reshape(-1, 3)[sure])

    def large(self, least_px: int) -> set[int]:
        """Objects with so many pixels in a view and a box."""
        return {value for value in self._joined() if self._most[value] >= least_px}

    def boxes(self, least_px: int = 0) -> dict[int, OrientedBox]:
        """Boxes of objects with so many pixels in a view, of their true surfaces."""
        return {
            value: _wide(upright_box(points[:: max(1, len(points) // 4000)], trim=0.005))
            for value, points in self._joined().items()
            if self._most[value] >= least_px
        }

    def boxes_of_supports(self) -> dict[int, OrientedBox]:
        """Boxes as a memory draws them: of points without fliers, thinned, without strays."""
        out = {}
        for value, points in self._joined().items():
            kept = points[without_fliers(points, 1.0)]
            none = np.zeros((len(kept), 3), np.uint8)
            support = thin(kept, none, np.ones(len(kept), np.float32), 1.0, MaskTrackSettings().support_points).points
            out[value] = _wide(fit_box(support[without_strays(support)].astype(np.float64), upright=True))
        return out

    def _joined(self) -> dict[int, NDArray[np.float32]]:
        every = {value: np.concatenate(parts) for value, parts in sorted(self._points.items())}
        return {value: points for value, points in every.items() if len(points) >= 10}


def gathered_boxes(
    points: Sequence[NDArray[np.float32]], labels: Sequence[NDArray[np.int64]]
) -> dict[int, OrientedBox]:
    """Boxes of true surfaces from points (h, w, 3) and the object of each, -1 for none, of several views."""
    every = _Gathered()
    for p, own in zip(points, labels, strict=True):
        every.add(p, own, np.ones(own.shape, bool))
    return every.boxes()


def _wide(box: OrientedBox) -> OrientedBox:
    """The box with edges of at least 1 cm."""
    return replace(box, size=np.maximum(box.size, 0.01))


def _said(proposals: Proposals) -> dict[int, tuple[float, str, float]]:
    """Confidence, likeliest name and its probability of each object, where the discoverer has them."""
    if proposals.named is None or proposals.identity is None:
        return {}
    rows = zip(proposals.identity.tolist(), proposals.score.tolist(), proposals.named, strict=True)
    return {k: (round(score, 4), *names[0]) for k, score, names in rows if names}


def _as_sure_as_right(
    pairs: NDArray[np.int64], large: set[int], said: dict[int, tuple[float, str, float]], labels: dict[int, str]
) -> dict[str, Any]:
    """Of each object that is named: [confidence, whether it is one object by masks at IoU 0.5], and of those that match
    a true object at 0.25: [probability of its name, whether it is right]; the house's makers use other names.
    """
    best: dict[int, tuple[float, int]] = {}
    true, report, iou = _mask_ious(pairs)
    for column, number in enumerate(report.tolist()):
        row = int(iou[:, column].argmax()) if len(true) else 0
        best[number] = (float(iou[row, column]), int(true[row])) if len(true) else (0.0, -1)
    whole, names = [], []
    for number, (score, name, probability) in sorted(said.items()):
        share, obj = best.get(number, (0.0, -1))
        if share >= 0.25 and obj not in large:
            continue
        whole.append([score, int(share >= 0.5)])
        if share >= 0.25 and labels[obj + 1] in LABELS:
            names.append([probability, int(labels[obj + 1] == name)])
    return {"whole": whole, "names": names}


def _of_faint(pairs: NDArray[np.int64], large: set[int]) -> set[int]:
    """Ignored estimates: mostly on one object that was hardly in view."""
    codes, count = np.unique(pairs[pairs[:, 1] >= 0], axis=0, return_counts=True)
    best = {int(report): int(true) for true, report in codes[np.argsort(count, kind="stable")].tolist()}
    return {report for report, true in best.items() if true >= 0 and true not in large}


def _without_faint(
    wanted: list[OrientedBox], faint: list[OrientedBox], boxes: list[OrientedBox], threshold: float
) -> list[OrientedBox]:
    """Estimates without matches of true objects that were hardly in view."""
    matches = evaluate_instances([*wanted, *faint], boxes, threshold).matches
    ignored = {e for t, e, _ in matches if t >= len(wanted)}
    return [b for k, b in enumerate(boxes) if k not in ignored]


def _upright(up: NDArray[np.float64]) -> NDArray[np.float64]:
    from list3r.instances.learned.graph import upright_frame

    return upright_frame(up / np.linalg.norm(up))


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures over all walks, each object counting the same."""
    total: Callable[[str], int] = lambda key: sum(int(r[key]) for r in rows)  # noqa: E731
    out: dict[str, Any] = {"walks": len(rows), "things": total("true")}
    for tag in ("0.25", "0.5"):
        out[f"recall_{tag}"] = round(total(f"found_{tag}") / max(total("true"), 1), 3)
        out[f"precision_{tag}"] = round(total(f"found_{tag}") / max(total(f"listed_{tag}"), 1), 3)
        out[f"mask_recall_{tag}"] = round(total(f"mask_found_{tag}") / max(total("true"), 1), 3)
        out[f"mask_precision_{tag}"] = round(total(f"mask_found_{tag}") / max(total(f"mask_listed_{tag}"), 1), 3)
    out["duplicates_per_thing"] = round(total("duplicates") / max(total("true"), 1), 3)
    out["merged_pairs_per_thing"] = round(total("merged") / max(total("true"), 1), 3)
    out["small_recall_0.25"] = round(total("small_found") / max(total("small"), 1), 3)
    right, claimed, there = (sum(r["structure"][k] for r in rows) for k in range(3))
    out["structure_f1"] = round(2 * right / max(claimed + there, 1), 3)
    out["cpu_ms_per_frame"] = round(1000 * sum(r["cpu_s"] for r in rows) / max(total("frames"), 1), 1)
    for key, word in (("whole", "confidence"), ("names", "names")):
        pairs = np.array([p for r in rows for p in r[key]], float).reshape(-1, 2)
        if len(pairs):
            out[word] = calibration(pairs[:, 0], pairs[:, 1] > 0.5)
    return out


if __name__ == "__main__":
    main()
