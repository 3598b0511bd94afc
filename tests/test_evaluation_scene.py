"""Clouds, boxes, instances, relations and whole scenes against known truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from list3r.evaluation.boxes import box_overlaps, intersection_volume, transform_box, upright
from list3r.evaluation.cloud import evaluate_cloud
from list3r.evaluation.instances import evaluate_instances, match_boxes
from list3r.evaluation.relations import evaluate_relations
from list3r.evaluation.scene import alignment_of, evaluate_scene, read_scene
from list3r.evaluation.trajectory import Trajectory
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.core.geometry import OrientedBox, Sim3, quat_wxyz_from_rotation, rotation_exp


def box(x: float, y: float, z: float, size: tuple[float, float, float], yaw_deg: float = 0.0) -> OrientedBox:
    return OrientedBox(np.array([x, y, z]), np.array(size), rotation_exp(np.array([0, 0, np.deg2rad(yaw_deg)])))


# ----------------------------------------------------------------------------------------------- clouds


def plane(offset: float, step: float = 0.02) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, 1, step), np.arange(0, 1, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, offset)], axis=1)


def test_two_parallel_planes_are_their_distance_apart() -> None:
    normals = np.tile([0.0, 0.0, 1.0], (2500, 1))
    errors = evaluate_cloud(plane(0.0), plane(0.03), (normals, -normals))
    assert errors.accuracy_cm == pytest.approx(3.0)
    assert errors.completeness_cm == pytest.approx(3.0)
    assert errors.chamfer_cm == pytest.approx(3.0)
    assert errors.normal_consistency == pytest.approx(1.0)
    assert errors.f_score == 1.0
    assert evaluate_cloud(plane(0.0), plane(0.06)).f_score == 0.0


def test_half_a_plane_is_accurate_but_not_complete() -> None:
    half = plane(0.0)[plane(0.0)[:, 0] < 0.5]
    errors = evaluate_cloud(plane(0.0), half)
    assert errors.accuracy_cm == 0.0
    assert errors.precision == 1.0
    assert errors.recall == pytest.approx(0.5 + 0.05, abs=0.02)
    assert errors.completeness_cm == pytest.approx(100 * 0.5 * 0.25, abs=1.0)
    assert evaluate_cloud(plane(0.0), half, truncate_m=0.1).completeness_cm < errors.completeness_cm


def test_normals_across_each_other_do_not_agree() -> None:
    up, side = np.tile([0.0, 0.0, 1.0], (2500, 1)), np.tile([1.0, 0.0, 0.0], (2500, 1))
    assert evaluate_cloud(plane(0), plane(0), (up, side)).normal_consistency == pytest.approx(0.0)


def test_clouds_that_cannot_be_compared_are_named() -> None:
    with pytest.raises(OptionError, match="estimate cloud"):
        evaluate_cloud(plane(0), np.zeros((0, 3)))
    with pytest.raises(OptionError, match="not finite"):
        evaluate_cloud(plane(0), np.full((2, 3), np.nan))
    with pytest.raises(OptionError, match="normals"):
        evaluate_cloud(plane(0), plane(0), (np.ones((3, 3)), np.ones((2500, 3))))


# ----------------------------------------------------------------------------------------------- boxes


def test_a_square_turned_by_45_degrees_shares_an_octagon() -> None:
    shared = intersection_volume(box(0, 0, 0, (1, 1, 2)), box(0, 0, 0.5, (1, 1, 2), 45))
    assert shared == pytest.approx(1.5 * 2 * (np.sqrt(2) - 1))


sizes = st.tuples(*[st.floats(0.05, 2.0)] * 3)
places = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
angles = st.floats(-180, 180)


@settings(max_examples=60, deadline=None)
@given(places, sizes, angles, places, sizes, angles, angles)
def test_overlap_is_symmetric_bounded_and_moves_along(p, s, a, q, t, b, turn) -> None:  # type: ignore[no-untyped-def]
    one, two = box(*p, s, a), box(*q, t, b)
    shared = intersection_volume(one, two)
    assert shared == pytest.approx(intersection_volume(two, one), abs=1e-9)
    assert -1e-12 <= shared <= min(np.prod(s), np.prod(t)) + 1e-9
    move = Sim3(np.array(2.0), rotation_exp(np.array([0, 0, np.deg2rad(turn)])), np.array([1.0, 2.0, 3.0]))
    moved = intersection_volume(transform_box(move, one), transform_box(move, two))
    assert moved == pytest.approx(8 * shared, abs=1e-7)
    assert box_overlaps([one], [one])[0][0, 0] == pytest.approx(1.0)


def test_overlap_agrees_with_counted_points() -> None:
    rng = np.random.default_rng(4)
    one, two = box(0.1, 0, 0, (1.2, 0.6, 0.8), 20), box(-0.1, 0.2, 0.1, (0.7, 1.1, 0.5), -35)
    points = rng.uniform(-1, 1, (400_000, 3))
    inside = [np.all(np.abs((points - b.center) @ b.rotation) <= b.size / 2, axis=1) for b in (one, two)]
    assert intersection_volume(one, two) == pytest.approx(8 * np.mean(inside[0] & inside[1]), rel=0.02)


def test_axes_in_another_order_are_the_same_upright_box() -> None:
    plain = box(1, 2, 3, (0.4, 0.6, 0.8), 30)
    turned = OrientedBox(plain.center, plain.size[[2, 0, 1]], plain.rotation[:, [2, 0, 1]])
    iou, _ = box_overlaps([plain], [upright(turned)])
    assert iou[0, 0] == pytest.approx(1.0)
    tilted = OrientedBox(plain.center, plain.size, plain.rotation @ rotation_exp(np.array([0.5, 0, 0])))
    around = upright(tilted)
    assert np.all(np.abs((tilted.corners() - around.center) @ around.rotation) <= around.size / 2 + 1e-9)


# ----------------------------------------------------------------------------------------------- instances

TRUTH = [box(0, 0, 0.05, (0.1, 0.1, 0.1)), box(0.2, 0, 0.05, (0.1, 0.1, 0.1)), box(0, 0, -0.4, (1.4, 0.8, 0.75))]


def test_a_perfect_scene_is_perfect_in_any_order() -> None:
    errors = evaluate_instances(TRUTH, TRUTH[::-1], 0.5)
    assert (errors.recall, errors.precision, errors.duplicates, errors.merged_pairs) == (1.0, 1.0, 0, 0)
    assert [(t, e) for t, e, _ in errors.matches] == [(0, 2), (1, 1), (2, 0)]
    assert errors.mean_center_error_m == 0.0


def test_a_second_copy_is_a_duplicate_and_a_stray_box_is_not() -> None:
    copy, stray = box(0.005, 0, 0.05, (0.09, 0.1, 0.1)), box(3, 3, 0, (0.3, 0.3, 0.3))
    errors = evaluate_instances(TRUTH, [*TRUTH, copy, stray])
    assert (errors.matched, errors.duplicates) == (3, 1)
    assert errors.precision == pytest.approx(3 / 5)


def test_a_box_round_two_things_merges_them() -> None:
    both = box(0.1, 0, 0.05, (0.32, 0.12, 0.12))
    errors = evaluate_instances(TRUTH, [both, TRUTH[2]])
    assert errors.merged_pairs == 1
    assert errors.recall < 1.0


def test_a_ball_in_a_bowl_is_not_merged_with_it() -> None:
    bowl, ball = box(0, 0, 0.06, (0.26, 0.26, 0.12)), box(0, 0, 0.07, (0.1, 0.1, 0.1))
    assert evaluate_instances([bowl, ball], [bowl]).merged_pairs == 0


def test_the_yaw_of_a_round_thing_does_not_count() -> None:
    ball, turned = box(0, 0, 0, (0.2, 0.2, 0.2)), box(0, 0, 0, (0.2, 0.2, 0.2), 45)
    assert evaluate_instances([ball], [turned]).mean_iou == pytest.approx(1 / np.sqrt(2))
    assert evaluate_instances([ball], [turned], is_round=[True]).mean_iou == pytest.approx(1.0)


def test_nothing_against_something_counts_without_failing() -> None:
    assert evaluate_instances([], TRUTH).precision == 0.0
    assert evaluate_instances(TRUTH, []).recall == 0.0
    assert evaluate_instances([], []).matched == 0


def test_matching_takes_most_pairs_first() -> None:
    iou = np.array([[0.6, 0.3], [0.55, 0.0]])
    assert match_boxes(iou, 0.25) == [(0, 1), (1, 0)]
    assert match_boxes(iou, 0.5) == [(0, 0)]


# ----------------------------------------------------------------------------------------------- relations


def test_relations_count_over_matched_objects_only() -> None:
    truth = [(1, "on", 2), (3, "on", 2), (4, "on", 2), (1, "next_to", 3), (1, "attached_to", 9)]
    claims = [(10, "on", 20), (30, "on", 10), (10, "next_to", 30), (77, "on", 20), (10, "near", 30)]
    errors = evaluate_relations(truth, claims, {10: 1, 20: 2, 30: 3})
    on, beside = errors.by_predicate["on"], errors.by_predicate["next_to"]
    assert (on.true_count, on.estimated_count, on.correct) == (2, 2, 1)
    assert (beside.precision, beside.recall) == (1.0, 1.0)
    assert errors.by_predicate["in"].precision is None
    assert errors.total.recall == pytest.approx(2 / 3)
    assert errors.wrong == ((3, "on", 1),)
    assert errors.missed == ((3, "on", 2),)


# ----------------------------------------------------------------------------------------------- scenes


def scene_of(boxes: dict[int, OrientedBox], relations: list[tuple[int, str, int]]) -> dict[str, Any]:
    entries = [
        {
            "id": k,
            "label": f"thing {k}",
            "structure": False,
            "box": {
                "center": b.center.tolist(),
                "size": b.size.tolist(),
                "quat_wxyz": quat_wxyz_from_rotation(b.rotation).tolist(),
            },
        }
        for k, b in boxes.items()
    ]
    return {
        "format": "list3r-scene-graph",
        "instances": entries,
        "relations": [{"subject": s, "predicate": p, "object": o} for s, p, o in relations],
    }


def test_a_scene_in_another_frame_is_brought_back() -> None:
    truth = scene_of({1: TRUTH[0], 2: TRUTH[1], 3: TRUTH[2]}, [(1, "on", 3), (2, "on", 3), (1, "next_to", 2)])
    S_truth_scene = Sim3.exp(np.array([1.0, 2.0, -0.5, 0.0, 0.0, 2.0, np.log(1.7)]))
    back = S_truth_scene.inverse()
    scene = scene_of(
        {7: transform_box(back, TRUTH[2]), 8: transform_box(back, TRUTH[0]), 9: transform_box(back, TRUTH[1])},
        [(8, "on", 7), (9, "on", 7), (8, "next_to", 9)],
    )
    result = evaluate_scene(json.loads(json.dumps(scene)), truth, S_truth_scene)
    assert result["instances_0.50"]["recall"] == 1.0
    assert result["relations"]["total"]["precision"] == 1.0
    assert [m[:2] for m in result["matched_ids"]] == [(1, 8), (2, 9), (3, 7)]
    json.dumps(result)


def test_structure_and_removed_things_do_not_count() -> None:
    truth = scene_of({1: TRUTH[0], 2: TRUTH[1]}, [])
    scene = scene_of({1: TRUTH[0], 2: TRUTH[1], 3: TRUTH[2]}, [])
    scene["instances"][1]["state"] = "removed"
    scene["instances"][2]["structure"] = True
    result = evaluate_scene(scene, truth)["instances_0.25"]
    assert (result["estimated_count"], result["matched"]) == (1, 1)


@pytest.mark.parametrize("text", ["{", "[]", '{"instances": 3}'])
def test_a_file_that_is_no_scene_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.json"
    path.write_text(text)
    with pytest.raises(SourceError, match=r"scene\.json"):
        read_scene(path)


# ----------------------------------------------------------------------------------------------- alignment


def short_path(turn_of_axes: float = 0.0, scale: float = 1.0) -> tuple[Trajectory, Trajectory]:
    """A way of 0.6 m and an estimate of it, off by a centimetre and 0.1 degrees a frame, in a frame of its own."""
    rng = np.random.default_rng(4)
    count = 60
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.stack([np.linspace(0, 0.6, count), 0.1 * np.sin(np.arange(count) / 9), np.ones(count)], 1)
    poses[:, :3, :3] = rotation_exp(rng.normal(0, 0.5, (count, 3)))
    seen = poses.copy()
    seen[:, :3, 3] += rng.normal(0, 0.01, (count, 3))
    seen[:, :3, :3] = seen[:, :3, :3] @ rotation_exp(np.deg2rad(0.1) * rng.normal(size=(count, 3)))
    seen[:, :3, :3] = seen[:, :3, :3] @ rotation_exp(np.array([0.0, turn_of_axes, 0.0]))
    world = Sim3.exp(np.array([0.3, 2.0, -1.0, 0.4, 0.2, 1.0, 0.0]))
    moved = np.array([(world.inverse() @ Sim3(np.asarray(1.0), T[:3, :3], T[:3, 3])).as_matrix() for T in seen])
    moved[:, :3, 3] /= scale
    return Trajectory(np.arange(count) / 10, poses), Trajectory(np.arange(count) / 10, moved)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_short_path_is_laid_on_the_truth_by_where_its_cameras_look(scale: float) -> None:
    truth, estimate = short_path(scale=scale)
    S = alignment_of(truth, estimate, with_scale=scale != 1.0)
    ahead = np.array([0.0, 0.0, 3.0])
    seen = S.apply(estimate.T_world_cam[:, :3, :3] @ (ahead / scale) + estimate.positions())
    true = truth.T_world_cam[:, :3, :3] @ ahead + truth.positions()
    assert np.linalg.norm((seen - true).mean(axis=0)) < 0.01 * scale  # a short path knows its scale less well
    by_path = alignment_of(*short_path(turn_of_axes=1.0, scale=scale), with_scale=scale != 1.0)
    assert np.linalg.norm(by_path.rotation - S.rotation) > np.deg2rad(0.5)


def test_axes_that_mean_something_else_leave_the_path_to_decide() -> None:
    truth, turned = short_path(turn_of_axes=1.0)
    same, plain = short_path()
    S = alignment_of(truth, turned, with_scale=False)
    assert (
        np.degrees(
            np.linalg.norm(
                rotation_exp(np.zeros(3)) - S.rotation.T @ alignment_of(same, plain, with_scale=False).rotation
            )
        )
        < 5
    )
