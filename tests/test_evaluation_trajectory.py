"""Trajectory errors: laws of alignment, the TUM format, and agreement with evo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from list3r.evaluation.trajectory import (
    Delta,
    Trajectory,
    associate,
    coverage,
    evaluate_trajectory,
    read_tum,
    write_tum,
)
from list3r.memory.core.errors import DegenerateError, OptionError, SourceError
from list3r.memory.core.geometry import Sim3


def random_walk(seed: int, count: int = 80) -> Trajectory:
    """A smooth path with turning views at 30 Hz."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.cumsum(rng.normal(0, 0.02, (count, 3)), axis=0)
    poses[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.03, (count, 3)), axis=0)).as_matrix()
    return Trajectory(np.arange(count) / 30.0 + 1.3e9, poses)


def disturbed(truth: Trajectory, seed: int, sigma: float = 0.01) -> Trajectory:
    """The truth with noise of position and view."""
    rng = np.random.default_rng([seed, 1])
    poses = truth.T_world_cam.copy()
    poses[:, :3, 3] += rng.normal(0, sigma, (len(poses), 3))
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, sigma, (len(poses), 3))).as_matrix()
    return Trajectory(truth.time_s, poses)


def moved(trajectory: Trajectory, transform: Sim3) -> Trajectory:
    """The same path in another frame of reference and scale."""
    poses = trajectory.T_world_cam.copy()
    poses[:, :3, 3] = transform.apply(trajectory.positions())
    poses[:, :3, :3] = transform.rotation @ poses[:, :3, :3]
    return Trajectory(trajectory.time_s, poses)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.2, 5.0))
def test_a_similar_copy_is_perfect_after_sim3_and_tells_its_scale(seed: int, scale: float) -> None:
    truth = random_walk(seed)
    tangent = np.random.default_rng(seed).normal(0, 0.8, 7)
    tangent[6] = np.log(scale)
    errors = evaluate_trajectory(truth, moved(truth, Sim3.exp(tangent)))
    assert errors.ate_sim3_m.rmse < 1e-9
    assert errors.scale * scale == pytest.approx(1.0, rel=1e-9)
    assert errors.rpe_rotation_deg.max < 1e-5


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_errors_do_not_depend_on_the_frame_of_the_estimate(seed: int) -> None:
    truth = random_walk(seed)
    estimate = disturbed(truth, seed)
    tangent = np.append(np.random.default_rng(seed).normal(0, 1, 6), 0.0)
    one, two = evaluate_trajectory(truth, estimate), evaluate_trajectory(truth, moved(estimate, Sim3.exp(tangent)))
    assert two.ate_se3_m.rmse == pytest.approx(one.ate_se3_m.rmse, rel=1e-7)
    assert two.rpe_translation_m.rmse == pytest.approx(one.rpe_translation_m.rmse, rel=1e-7)
    assert one.ate_sim3_m.rmse <= one.ate_se3_m.rmse + 1e-12


def test_a_constant_drift_is_the_rpe() -> None:
    truth = random_walk(3)
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec([0, 0, np.deg2rad(0.5)]).as_matrix()
    relative = np.linalg.inv(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    poses = [truth.T_world_cam[0]]
    for move in relative:
        poses.append(poses[-1] @ move @ step)
    errors = evaluate_trajectory(truth, Trajectory(truth.time_s, np.array(poses)))
    assert errors.rpe_rotation_deg.min == pytest.approx(0.5, abs=1e-5)
    assert errors.rpe_rotation_deg.max == pytest.approx(0.5, abs=1e-5)
    assert errors.rpe_translation_m.max < 1e-7


def test_tum_files_come_back(tmp_path: Path) -> None:
    trajectory = random_walk(5)
    write_tum(tmp_path / "a.txt", trajectory)
    back = read_tum(tmp_path / "a.txt")
    assert np.allclose(back.time_s, trajectory.time_s, atol=1e-6)
    assert np.allclose(back.T_world_cam, trajectory.T_world_cam, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no poses"),
        ("# only a comment\n", "no poses"),
        ("0 1 2 3 0 0 0\n", "7 numbers"),
        ("0 1 2 3 0 0 0 nan\n", "none of its 1 rows is finite"),
        ("0 1 2 3 0 0 0 1\n1 0.5 0.5 0.5 -0.5 1 2 3\n", "line 2: the quaternion has length"),
        ("0 1 2 3 0 0 0 1\n0 1 2 3 0 0 1\n", "line 2 has 7 numbers"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n", "line 1 is not a rigid motion"),
        ("0 1 2 3 0 0 0 0\n", "quaternion"),
        ("0 1 2 x 0 0 0 1\n", "line 1"),
    ],
)
def test_a_file_that_is_no_trajectory_is_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(SourceError, match=words):
        read_tum(path)


def test_rows_that_are_not_finite_are_skipped_and_said(tmp_path: Path) -> None:
    trajectory = random_walk(5)
    write_tum(tmp_path / "a.txt", trajectory)
    lines = (tmp_path / "a.txt").read_text().splitlines()
    lines[7] = lines[7].split()[0] + " nan nan nan nan nan nan nan"
    (tmp_path / "a.txt").write_text("\n".join(lines))
    back = read_tum(tmp_path / "a.txt")
    assert len(back.time_s) == 79 and back.notes == ("1 of 80 rows of a.txt are not finite and are skipped",)


def test_the_same_path_is_read_from_euroc_and_kitti(tmp_path: Path) -> None:
    truth = random_walk(5)
    write_tum(tmp_path / "a.txt", truth)
    rows = [line.split() for line in (tmp_path / "a.txt").read_text().splitlines()[1:]]
    head = "#timestamp [ns], p_RS_R_x [m], p_y, p_z, q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    stamps = [f"{round(float(r[0]) * 1e6)}000" for r in rows]
    more = ",0,0,0,0,0,0,0,0,0"
    euroc = [f"{t},{','.join(r[1:4])},{r[7]},{','.join(r[4:7])}" for t, r in zip(stamps, rows, strict=True)]
    (tmp_path / "data.csv").write_text(head + "\n".join(row + more for row in euroc))
    (tmp_path / "short.csv").write_text("\n".join(euroc))
    (tmp_path / "kitti.txt").write_text("\n".join(" ".join(map(str, T[:3].ravel())) for T in truth.T_world_cam))
    for name in ("data.csv", "short.csv", "kitti.txt"):
        found = read_tum(tmp_path / name)
        assert np.allclose(found.T_world_cam, truth.T_world_cam, atol=1e-6), name
        errors = evaluate_trajectory(truth, found)
        assert errors.pairs == 80 and errors.ate_se3_m.rmse < 1e-6, name
    (tmp_path / "kitti.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 9)
    with pytest.raises(OptionError, match="9 rows without times, the other 80 with times"):
        evaluate_trajectory(truth, read_tum(tmp_path / "kitti.txt"))


def test_columns_in_another_order_are_refused(shared_data: Path) -> None:
    path = shared_data / "cases/eval_quaternion_not_unit/est.txt"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    with pytest.raises(SourceError, match="line 1: the quaternion has length"):
        read_tum(path)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="nowhere"):
        read_tum(tmp_path / "nowhere.txt")


def test_association_is_by_time_and_within_tolerance() -> None:
    truth = np.arange(0, 10, 0.01)
    times = np.array([0.004, 1.0, 5.5049, 11.0])
    rows_truth, rows = associate(truth, times, 0.01)
    assert rows.tolist() == [0, 1, 2]
    assert np.abs(truth[rows_truth] - times[rows]).max() < 0.0051
    there, back = associate(truth, times), associate(times, truth)
    assert np.array_equal(there[0], back[1])
    assert np.array_equal(there[1], back[0])


def test_too_few_common_moments_and_lines_are_errors() -> None:
    truth = random_walk(0)
    late = Trajectory(truth.time_s + 500, truth.T_world_cam)
    with pytest.raises(OptionError, match="0 poses within"):
        evaluate_trajectory(truth, late)
    line = truth.T_world_cam.copy()
    line[:, :3, 3] = np.arange(len(line))[:, None] * np.array([0.01, 0.02, 0.0])
    with pytest.raises(DegenerateError, match="line"):
        evaluate_trajectory(truth, Trajectory(truth.time_s, line))
    with pytest.raises(OptionError, match="delta"):
        evaluate_trajectory(truth, truth, delta_frames=0)


@pytest.mark.parametrize(
    ("text", "delta"),
    [
        ("1", Delta()),
        ("10f", Delta(10)),
        ("0.5m", Delta(0.5, "m")),
        (" 2 s ", Delta(2, "s")),
        ("1e-1m", Delta(0.1, "m")),
    ],
)
def test_deltas_are_read(text: str, delta: Delta) -> None:
    assert Delta.parse(text) == delta


@pytest.mark.parametrize("text", ["", "m", "-1", "0", "1.5", "0m", "1km", "nan", "1.2.3s", "inf"])
def test_deltas_that_are_none_are_named(text: str) -> None:
    with pytest.raises(OptionError, match="delta"):
        Delta.parse(text)


def test_a_delta_in_seconds_relates_poses_that_far_apart() -> None:
    truth = random_walk(4, 61)
    estimate = disturbed(truth, 4)
    one = evaluate_trajectory(truth, estimate, delta=Delta(0.1, "s"))
    assert one.rpe_translation_m.rmse == pytest.approx(
        evaluate_trajectory(truth, estimate, delta_frames=3).rpe_translation_m.rmse
    )
    assert str(one.delta) == "0.1 s"
    with pytest.raises(OptionError, match="apart"):
        evaluate_trajectory(truth, estimate, delta=Delta(50, "s"))
    with pytest.raises(OptionError, match="apart"):
        evaluate_trajectory(truth, estimate, delta=Delta(61))


def test_rpe_of_a_scaled_estimate_is_told_both_ways() -> None:
    truth = random_walk(6)
    errors = evaluate_trajectory(truth, moved(truth, Sim3.exp(np.array([0, 0, 0, 0, 0, 0, np.log(2)]))))
    assert errors.rpe_translation_sim3_m.max < 1e-9
    assert errors.rpe_translation_m.rmse > 0.01


def test_frames_that_are_missing_are_told() -> None:
    truth = random_walk(7, 301)
    rows = np.array([k for k in range(301) if not (100 <= k < 160 or 200 <= k < 209 or k >= 270)])
    found = coverage(truth, truth.at(rows))
    assert found.gaps == 2
    assert found.longest_gap_s == pytest.approx(61 / 30)
    assert found.truth == pytest.approx(1 - (61 + 10 + 31) / 300)
    whole = coverage(truth, truth.at(np.arange(0, 301, 4)))
    assert (whole.truth, whole.gaps, whole.longest_gap_s) == (1.0, 0, 0.0)
    assert coverage(truth, truth.at(np.array([5]))).truth == 0.0


# ----------------------------------------------------------------------------------------------- against evo


def evo_figures(truth: Path, estimate: Path, delta: int) -> dict[str, float]:
    """The same figures by evo."""
    from evo.core import metrics, sync
    from evo.core.units import Unit
    from evo.tools import file_interface

    a, b = file_interface.read_tum_trajectory_file(truth), file_interface.read_tum_trajectory_file(estimate)
    a, b = sync.associate_trajectories(a, b, max_diff=0.01)
    out = {"pairs": float(b.num_poses)}
    for name, relation in (
        ("rpe_translation", metrics.PoseRelation.translation_part),
        ("rpe_rotation", metrics.PoseRelation.rotation_angle_deg),
    ):
        rpe = metrics.RPE(relation, delta, Unit.frames, all_pairs=True)
        rpe.process_data((a, b))
        out[name] = rpe.get_statistic(metrics.StatisticsType.rmse)
    for name, free in (("ate_se3", False), ("ate_sim3", True)):
        copy = file_interface.read_tum_trajectory_file(estimate)
        ref, copy = sync.associate_trajectories(file_interface.read_tum_trajectory_file(truth), copy, max_diff=0.01)
        _, _, scale = copy.align(ref, correct_scale=free)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((ref, copy))
        out[name] = ape.get_statistic(metrics.StatisticsType.rmse)
        if free:
            out["scale"] = float(scale)
    return out


def assert_like_evo(truth: Path, estimate: Path, delta: int) -> None:
    pytest.importorskip("evo")
    theirs = evo_figures(truth, estimate, delta)
    ours = evaluate_trajectory(read_tum(truth), read_tum(estimate), delta_frames=delta)
    figures = {
        "pairs": float(ours.pairs),
        "ate_se3": ours.ate_se3_m.rmse,
        "ate_sim3": ours.ate_sim3_m.rmse,
        "scale": ours.scale,
        "rpe_translation": ours.rpe_translation_m.rmse,
        "rpe_rotation": ours.rpe_rotation_deg.rmse,
    }
    assert figures == pytest.approx(theirs, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("delta", [1, 7])
def test_random_trajectories_agree_with_evo(tmp_path: Path, seed: int, delta: int) -> None:
    truth = random_walk(seed, 150)
    estimate = moved(disturbed(truth, seed), Sim3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.8, 1.1, 0.4])))
    keep = np.flatnonzero(np.random.default_rng(seed).uniform(size=150) < 0.7)
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "estimate.txt", estimate.at(keep))
    assert_like_evo(tmp_path / "truth.txt", tmp_path / "estimate.txt", delta)


@pytest.mark.parametrize("length", [0.1, 0.5])
def test_rpe_over_metres_agrees_with_evo(tmp_path: Path, length: float) -> None:
    pytest.importorskip("evo")
    from evo.core import metrics
    from evo.core.units import Unit
    from evo.tools import file_interface

    truth = random_walk(8, 200)
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "estimate.txt", disturbed(truth, 8))
    both = tuple(file_interface.read_tum_trajectory_file(tmp_path / f"{n}.txt") for n in ("truth", "estimate"))
    rpe = metrics.RPE(
        metrics.PoseRelation.translation_part, length, Unit.meters, all_pairs=True, pairs_from_reference=True
    )
    rpe.process_data(both)
    ours = evaluate_trajectory(
        read_tum(tmp_path / "truth.txt"), read_tum(tmp_path / "estimate.txt"), delta=Delta(length, "m")
    )
    assert ours.rpe_translation_m.rmse == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    ("truth", "estimate"),
    [
        ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt"),
        ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam_drift.txt"),
        ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-ORB_kf_mono.txt"),
        ("fr2_desk_groundtruth.txt", "fr2_desk_ORB.txt"),
        ("fr2_desk_groundtruth.txt", "fr2_desk_ORB_kf_mono.txt"),
    ],
)
def test_real_trajectories_agree_with_evo(shared_data: Path, truth: str, estimate: str) -> None:
    folder = shared_data / "trajectories"
    assert_like_evo(folder / truth, folder / estimate, delta=1)
