"""A scene JSON held against the truth of its world: instances and relations in one go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.evaluation.boxes import transform_box, upright
from list3r.evaluation.instances import InstanceErrors, evaluate_instances
from list3r.evaluation.relations import RelationErrors, evaluate_relations
from list3r.evaluation.trajectory import Trajectory, align, associate
from list3r.frames.files import read_file
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.core.geometry import OrientedBox, Sim3, rotation_from_quat_wxyz, rotation_log, umeyama
from list3r.memory.core.unpacking import parse_json

_REACH_M = 2.0
"""How far away objects are from a camera indoors."""
_SAME_AXES_DEG = 10.0
"""Axes differ beyond this angle; a path of half a metre with errors of centimetres stays below it."""


def read_scene(path: str | Path) -> dict[str, Any]:
    """Read a scene JSON or a `truth.json`. Raises `SourceError` for a file that is neither."""
    try:
        scene = parse_json(read_file(Path(path)).decode("utf-8"))
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise SourceError(
            f"{path} is not valid JSON ({error}); give a scene graph of `list3r export --to json`"
        ) from error
    if not isinstance(scene, dict) or not isinstance(scene.get("instances"), list):
        raise SourceError(f"{path} has no list of instances; give a scene graph of `list3r export --to json`")
    return scene


def scene_boxes(scene: Mapping[str, Any], S_truth_scene: Sim3 | None = None) -> dict[int, OrientedBox]:
    """Return the upright boxes by id, of all that is no structure and not gone, moved into the frame of the truth."""
    move = S_truth_scene or Sim3.identity()
    out = {}
    for entry in scene["instances"]:
        if entry.get("structure") or entry.get("state", "present") == "removed":
            continue
        out[int(entry["id"])] = upright(transform_box(move, _box(entry)), tilt_deg=10.0)
    return out


def scene_relations(scene: Mapping[str, Any]) -> list[tuple[int, str, int]]:
    """Return triples (subject, predicate, object) of a scene or truth."""
    return [(int(r["subject"]), str(r["predicate"]), int(r["object"])) for r in scene.get("relations", [])]


def alignment_of(truth: Trajectory, estimate: Trajectory, *, with_scale: bool, tolerance_s: float = 0.01) -> Sim3:
    """Return S_truth_scene from the camera's poses in both frames of reference. Raises as `align` does.

    A path of a metre leaves a rotation uncertain that shifts objects three metres away by centimetres. So the alignment
    uses the camera centres and a point on each optical axis at the objects' distance, where both trajectories use the
    same axes.
    """
    rows_truth, rows = associate(truth.time_s, estimate.time_s, tolerance_s)
    if len(rows) < 3:
        raise OptionError(f"{len(rows)} poses within {tolerance_s} s of each other; both must use one clock")
    goal, from_ = truth.at(rows_truth), estimate.at(rows)
    S = align(goal, from_, with_scale=with_scale)
    turned = S.rotation @ from_.T_world_cam[:, :3, :3]
    off = rotation_log(np.swapaxes(turned, 1, 2) @ goal.T_world_cam[:, :3, :3])
    if np.degrees(np.median(np.linalg.norm(off, axis=1))) > _SAME_AXES_DEG:
        return S
    scale = float(S.scale)
    points = [_with_axes(t, _REACH_M / s) for t, s in ((from_, scale), (goal, 1.0))]
    rigid = umeyama(scale * points[0], points[1], with_scale=False)
    return Sim3(S.scale, rigid.rotation, rigid.translation)


def _with_axes(trajectory: Trajectory, reach: float) -> NDArray[np.float64]:
    """Return the cameras and a point on each of their axes. Shape (4 F, 3)."""
    T = trajectory.T_world_cam
    ends = T[:, None, :3, 3] + reach * np.swapaxes(T[:, :3, :3], 1, 2)
    return np.concatenate([T[:, :3, 3], ends.reshape(-1, 3)])


def evaluate_scene_instances(
    scene: Mapping[str, Any],
    truth: Mapping[str, Any],
    S_truth_scene: Sim3 | None = None,
    iou_threshold: float = 0.25,
    min_px: int = 0,
) -> InstanceErrors:
    """Match the objects of a scene with the true ones that once covered `min_px` pixels of a frame, structure aside.

    Matches of true objects that were hardly in view are ignored. `matches` names ids, not rows.
    """
    true, boxes = scene_boxes(truth), scene_boxes(scene, S_truth_scene)
    faint = set(true) - _seen_ids(truth, min_px)
    round_ids = {int(e["id"]) for e in truth["instances"] if e.get("round")}
    first = _evaluate_by_id(true, boxes, iou_threshold, round_ids)
    ignored = {scene_id for true_id, scene_id, _ in first.matches if true_id in faint}
    true = {k: box for k, box in true.items() if k not in faint}
    boxes = {k: box for k, box in boxes.items() if k not in ignored}
    return _evaluate_by_id(true, boxes, iou_threshold, round_ids)


def _evaluate_by_id(
    true: dict[int, OrientedBox], boxes: dict[int, OrientedBox], threshold: float, round_ids: set[int]
) -> InstanceErrors:
    true_ids, ids = sorted(true), sorted(boxes)
    errors = evaluate_instances(
        [true[k] for k in true_ids], [boxes[k] for k in ids], threshold, [k in round_ids for k in true_ids]
    )
    return replace(errors, matches=tuple((true_ids[t], ids[e], iou) for t, e, iou in errors.matches))


def evaluate_scene(
    scene: Mapping[str, Any], truth: Mapping[str, Any], S_truth_scene: Sim3 | None = None, min_px: int = 150
) -> dict[str, Any]:
    """Evaluate everything at once, as plain numbers: instances at IoU 0.25 and 0.5, relations over objects matched at
    0.25.

    `S_truth_scene` takes the scene's world to that of the truth (see `alignment_of`); None when they are the same.
    `matched_ids` lists (true id, scene id, IoU), `missed` the true objects without a match.
    """
    loose = evaluate_scene_instances(scene, truth, S_truth_scene, 0.25, min_px)
    strict = evaluate_scene_instances(scene, truth, S_truth_scene, 0.50, min_px)
    matched = [(true_id, scene_id, round(iou, 4)) for true_id, scene_id, iou in loose.matches]
    found = {t for t, _, _ in matched}
    labels = {int(e["id"]): e.get("label") for e in truth["instances"]}
    wanted = sorted(_seen_ids(truth, min_px) & set(scene_boxes(truth)))
    return {
        "instances_0.25": _without_rows(loose),
        "instances_0.50": _without_rows(strict),
        "relations": relations_of_matches(scene, truth, matched).as_dict(),
        "matched_ids": matched,
        "missed": [{"id": k, "label": labels[k]} for k in wanted if k not in found],
    }


def relations_of_matches(
    scene: Mapping[str, Any], truth: Mapping[str, Any], matched: list[tuple[int, int, float]]
) -> RelationErrors:
    """Return relations over pairs (true id, scene id, IoU)."""
    truth_of = {scene_id: true_id for true_id, scene_id, _ in matched}
    return evaluate_relations(scene_relations(truth), scene_relations(scene), truth_of)


def _seen_ids(truth: Mapping[str, Any], min_px: int) -> set[int]:
    return {int(e["id"]) for e in truth["instances"] if e.get("largest_px", min_px) >= min_px}


def _without_rows(errors: InstanceErrors) -> dict[str, Any]:
    return {k: v for k, v in errors.as_dict().items() if k != "matches"}


def _box(entry: Mapping[str, Any]) -> OrientedBox:
    try:
        box = entry["box"]
        center, size = np.array(box["center"], dtype=np.float64), np.array(box["size"], dtype=np.float64)
        rotation = rotation_from_quat_wxyz(np.array(box["quat_wxyz"], dtype=np.float64))
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"instance {entry.get('id')} has no box with center, size and quat_wxyz") from error
    if center.shape != (3,) or size.shape != (3,) or rotation.shape != (3, 3):
        raise SourceError(f"instance {entry.get('id')} has a box of wrong length; expected 3 + 3 + 4 numbers")
    return OrientedBox(center, size, rotation)
