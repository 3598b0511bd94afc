"""Clouds: the five measures by brute force, files of every kind, thinning, normals, ICP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from list3r.evaluation.cloud import cloud_distances, evaluate_cloud
from list3r.evaluation.icp import IcpSettings, register
from list3r.evaluation.point_clouds import PointCloud, estimate_normals, read_cloud, thinned
from list3r.memory.core.errors import DegenerateError, OptionError, SourceError
from list3r.memory.core.geometry import Sim3


def room(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on floor and two walls of a room with a step, and their normals."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(0, 1, (count, 3)) * [3.0, 2.0, 1.5]
    face = rng.integers(0, 4, count)
    normals = np.eye(3)[[2, 0, 1, 0]][face]
    for k, (axis, value) in enumerate(((2, 0.0), (0, 0.0), (1, 0.0), (0, 1.2))):
        p[face == k, axis] = value
    return p, normals


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 40), st.integers(1, 40))
def test_the_measures_are_what_the_definition_says(seed: int, m: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0, 0.1, (m, 3)), rng.normal(0, 0.1, (n, 3))
    na, nb = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (rng.normal(size=(m, 3)), rng.normal(size=(n, 3))))
    gaps = np.linalg.norm(a[:, None] - b[None], axis=2)
    accuracy, completeness = gaps.min(axis=0), gaps.min(axis=1)
    there = np.abs((na[gaps.argmin(axis=0)] * nb).sum(axis=1)).mean()
    back = np.abs((na * nb[gaps.argmin(axis=1)]).sum(axis=1)).mean()
    precision, recall = (accuracy <= 0.05).mean(), (completeness <= 0.05).mean()
    errors = evaluate_cloud(a, b, (na, nb))
    assert errors.accuracy_cm == pytest.approx(100 * accuracy.mean())
    assert errors.completeness_cm == pytest.approx(100 * completeness.mean())
    assert errors.chamfer_cm == pytest.approx((errors.accuracy_cm + errors.completeness_cm) / 2)
    assert errors.normal_consistency == pytest.approx((there + back) / 2)
    harmonic = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    assert errors.f_score == pytest.approx(harmonic)
    found = cloud_distances(a, b)
    assert np.array_equal(found.nearest_truth, gaps.argmin(axis=0))
    assert np.array_equal(found.nearest_estimate, gaps.argmin(axis=1))


def test_swapping_the_clouds_swaps_accuracy_and_completeness() -> None:
    (a, _), (b, _) = room(500, 1), room(300, 2)
    one, two = evaluate_cloud(a, b), evaluate_cloud(b, a)
    assert one.accuracy_cm == two.completeness_cm
    assert one.f_score == pytest.approx(two.f_score)
    with pytest.raises(OptionError, match="threshold"):
        evaluate_cloud(a, b, threshold_m=0.0)


def test_files_of_every_kind_hold_the_same_points(tmp_path: Path) -> None:
    points, _ = room(200, 3)
    trimesh.PointCloud(points).export(tmp_path / "a.ply")
    np.savetxt(tmp_path / "a.xyz", np.column_stack([points, points]))
    np.savetxt(tmp_path / "a.csv", points, delimiter=",")
    np.save(tmp_path / "a.npy", points)
    for name in ("a.ply", "a.xyz", "a.csv", "a.npy"):
        cloud = read_cloud(tmp_path / name)
        assert np.allclose(cloud.points, points, atol=1e-6), name
        assert cloud.normals is None
        assert "200 points" in cloud.text


def test_normals_of_a_ply_and_faces_of_a_mesh_are_used(tmp_path: Path) -> None:
    points, normals = room(50, 4)
    head = "\n".join(f"property float {n}" for n in ("x", "y", "z", "nx", "ny", "nz"))
    rows = "\n".join(" ".join(f"{v:.6f}" for v in row) for row in np.column_stack([points, 2 * normals]))
    (tmp_path / "n.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 50\n{head}\nend_header\n{rows}\n")
    cloud = read_cloud(tmp_path / "n.ply")
    assert cloud.normals is not None
    assert np.allclose(cloud.normals, normals, atol=1e-6)
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.obj")
    box = read_cloud(tmp_path / "box.obj")
    assert np.allclose(np.abs(box.points).max(axis=1), 0.5)
    assert len(box.points) == 60_000
    assert box.normals is not None
    assert np.array_equal(read_cloud(tmp_path / "box.obj").points, box.points)


def test_points_that_are_not_finite_are_left_out_and_said(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[0, 0, 0], [np.nan, 0, 0], [1, 2, 3.0]]))
    cloud = read_cloud(tmp_path / "a.npy")
    assert len(cloud.points) == 2
    assert "1 that are not finite left out" in cloud.text


@pytest.mark.parametrize("name", ["absent.ply", "a.doc", "text.ply", "empty.xyz", "two.npy", "nan.npy", "words.xyz"])
def test_what_is_no_cloud_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.doc").write_text("hello")
    (tmp_path / "text.ply").write_text("hello")
    (tmp_path / "empty.xyz").touch()
    (tmp_path / "words.xyz").write_text("a b c\n")
    np.save(tmp_path / "two.npy", np.zeros((4, 2)))
    np.save(tmp_path / "nan.npy", np.full((4, 3), np.nan))
    with pytest.raises(SourceError, match=name.split(".")[0]) as error:
        read_cloud(tmp_path / name)
    assert "\n" not in str(error.value)


def test_thinning_leaves_one_mean_point_a_cell() -> None:
    points, normals = room(4000, 5)
    thin = thinned(PointCloud(points, normals), 0.1)
    cells = np.unique(np.floor(points / 0.1).astype(int), axis=0)
    assert len(thin.points) == len(cells)
    assert thin.normals is not None
    assert np.allclose(np.linalg.norm(thin.normals, axis=1), 1)
    assert len(thinned(PointCloud(points, None), 0.0, 100).points) == 100
    assert len(thinned(PointCloud(points, None), 0.0).points) == 4000
    for voxel, most, words in (
        (-1.0, None, "voxel"),
        (np.nan, None, "voxel"),
        (0.1, 0, "at least 1"),
        (1e-9, None, "small"),
    ):
        with pytest.raises(OptionError, match=words):
            thinned(PointCloud(points, None), voxel, most)


def test_normals_are_those_of_the_surfaces() -> None:
    points, normals = room(6000, 6)
    inside = np.sort(np.abs(points - [1.2, 0, 0]), axis=1)[:, 1] > 0.15
    inside &= np.sort(np.abs(points), axis=1)[:, 1] > 0.15
    agreement = np.abs((estimate_normals(points) * normals).sum(axis=1))[inside]
    assert np.quantile(agreement, 0.02) > 0.99
    assert estimate_normals(points[:2]).shape == (2, 3)


@pytest.mark.parametrize("scale", [1.0, 1.04])
def test_icp_brings_a_room_back(scale: float) -> None:
    (truth, normals), (estimate, _) = room(8000, 7), room(5000, 8)
    S = Sim3.exp(np.array([0.06, -0.05, 0.04, 0.03, -0.02, 0.03, np.log(scale)]))
    found = register(truth, normals, S.inverse().apply(estimate), with_scale=scale != 1, settings=IcpSettings())
    assert np.abs((found @ S.inverse()).log()).max() < 2e-3


def test_icp_names_what_it_cannot_align() -> None:
    truth, normals = room(2000, 9)
    with pytest.raises(DegenerateError, match="nearly"):
        register(truth, normals, truth + 50.0, with_scale=False, settings=IcpSettings())
    flat = normals[:, 2] == 1
    with pytest.raises(DegenerateError, match="leave a motion undetermined"):
        register(truth[flat], normals[flat], truth[flat], with_scale=False, settings=IcpSettings())
