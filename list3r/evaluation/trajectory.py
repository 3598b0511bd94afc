"""Trajectory errors: ATE after SE(3) and Sim(3) alignment, RPE at a stated delta, and coverage.

The conventions are those of evo and of the TUM RGB-D benchmark (Sturm et al., "A benchmark for the evaluation of RGB-D
SLAM systems", 2012): poses are associated by time, the alignment is Umeyama's over all associated positions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.recordings.pose_lists import read_pose_list
from list3r.frames.recordings.stamps import nearest_rows
from list3r.memory.core.errors import DegenerateError, OptionError, SourceError
from list3r.memory.core.geometry import Sim3, quat_wxyz_from_rotation, rotation_log, umeyama
from list3r.memory.core.records import JsonFields

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """Poses of a camera over time."""

    time_s: Array
    """Seconds, ascending. Shape (F,)."""
    T_world_cam: Array
    """Shape (F, 4, 4)."""
    counted: bool = False
    """The file states no times: these are the numbers of its rows."""
    notes: tuple[str, ...] = ()
    """What was left out when it was read."""

    def __post_init__(self) -> None:
        if self.T_world_cam.shape != (len(self.time_s), 4, 4):
            raise OptionError(
                f"{len(self.time_s)} times with poses of shape {self.T_world_cam.shape}: expected (F, 4, 4)"
            )

    def positions(self) -> Array:
        """Return the camera centres in the world. Shape (F, 3)."""
        return self.T_world_cam[:, :3, 3]

    def at(self, rows: NDArray[np.int64]) -> Trajectory:
        """Return the poses of some rows."""
        return Trajectory(self.time_s[rows], self.T_world_cam[rows])


@dataclass(frozen=True)
class Statistics:
    """Summary of the sizes of errors."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


@dataclass(frozen=True)
class Delta:
    """How far apart the poses are that RPE relates."""

    value: float = 1.0
    unit: str = "frames"
    """frames (associated poses), m (along the true path), s."""

    def __post_init__(self) -> None:
        whole = self.unit != "frames" or float(self.value).is_integer()
        if self.unit not in _DELTA_UNITS or not (np.isfinite(self.value) and self.value > 0) or not whole:
            raise OptionError(f"delta {self.value:g} {self.unit}: give at least 1 frame, or metres or seconds above 0")

    @staticmethod
    def parse(text: str) -> Delta:
        """`10` or `10f` is frames, `0.5m` metres, `2s` seconds. Raises `OptionError` for anything else."""
        found = re.fullmatch(r"\s*([0-9.]+(?:e-?[0-9]+)?)\s*(f|m|s)?\s*", text)
        try:
            value = float(found.group(1)) if found else float("nan")
        except ValueError:
            value = float("nan")
        if found is None or not np.isfinite(value):
            raise OptionError(f"delta {text!r}: give frames, metres or seconds, such as 10, 0.5m or 2s")
        return Delta(value, {"m": "m", "s": "s"}.get(found.group(2) or "f", "frames"))

    def __str__(self) -> str:
        return f"{self.value:g} {'frame' if self == Delta() else self.unit}"


_DELTA_UNITS = ("frames", "m", "s")
_DELTA_TOLERANCE = 0.1
"""Greatest deviation from the wanted distance in metres or seconds, as a share of it (as in evo)."""


@dataclass(frozen=True)
class Coverage:
    """Share of the truth for which the estimate has poses."""

    truth: float
    """Share of the time that the truth lasts in which the estimate has poses."""
    gaps: int
    """Stretches inside the estimate without poses: over three times its usual step."""
    longest_gap_s: float
    """Of gaps, also at the beginning and the end; 0 where nothing is missing."""


@dataclass(frozen=True)
class TrajectoryErrors(JsonFields):
    """How far an estimated trajectory is from the truth."""

    pairs: int
    """Associated poses."""
    coverage: float
    """Associated share of the estimated poses."""
    covered: Coverage
    ate_se3_m: Statistics
    """Distance of positions after rigid alignment, units of the truth."""
    ate_sim3_m: Statistics
    """The same with the scale free."""
    scale: float
    """Factor of the Sim(3) alignment from the estimate to the truth; 1 for a perfect metric estimate."""
    delta: Delta
    """Distance of the poses that RPE relates."""
    rpe_translation_m: Statistics
    """Length of the translation of the relative error, no alignment."""
    rpe_translation_sim3_m: Statistics
    """The same after the estimate was brought to the scale of the Sim(3) alignment."""
    rpe_rotation_deg: Statistics
    """Angle of the relative error."""


def read_tum(path: str | Path) -> Trajectory:
    """Read `time_s tx ty tz qx qy qz qw` lines (TUM), EuRoC's tables with nanoseconds, or KITTI's 12 numbers.

    Raises `SourceError` for a file that is absent or has a line that is no pose. Rows are sorted by time; those that
    are not finite are left out, with a note.
    """
    path = Path(path)
    try:
        found = read_pose_list(path, timed=True)
    except SourceError as error:
        if path.is_file():
            raise
        raise SourceError(f"cannot read the trajectory {path}: {error}") from error
    time_s = np.arange(len(found.T), dtype=np.float64) if found.time_s is None else found.time_s
    rows = np.flatnonzero(found.known & np.isfinite(time_s))
    rows, left = rows[np.argsort(time_s[rows], kind="stable")], len(time_s) - len(rows)
    if not len(rows):
        raise SourceError(f"{path} holds no poses: none of its {left} rows is finite")
    notes = (f"{left} of {len(time_s)} rows of {path.name} are not finite and are skipped",) if left else ()
    return Trajectory(time_s[rows], found.T[rows], found.time_s is None, notes)


def on_one_clock(truth: Trajectory, estimate: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return both with times, where one has rows without any: row n of it belongs to row n of the other.

    Raises `OptionError` where their numbers of rows differ.
    """
    if truth.counted == estimate.counted:
        return truth, estimate
    timed, other = (estimate, truth) if truth.counted else (truth, estimate)
    matched = len(other.time_s) == len(timed.time_s) or other.notes
    if timed.notes or not matched or other.time_s[-1] >= len(timed.time_s):
        raise OptionError(
            f"one trajectory has {len(other.time_s)} rows without times, the other {len(timed.time_s)} with times; "
            "give both with times (TUM), or as many rows"
        )
    placed = replace(other, time_s=timed.time_s[other.time_s.astype(np.int64)], counted=False)
    return (placed, estimate) if truth.counted else (truth, placed)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write `time_s tx ty tz qx qy qz qw` lines."""
    wxyz = quat_wxyz_from_rotation(trajectory.T_world_cam[:, :3, :3])
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for t, p, q in zip(trajectory.time_s, trajectory.positions(), np.roll(wxyz, -1, axis=1), strict=True):
        lines.append(f"{t:.6f} " + " ".join(f"{v:.9f}" for v in (*p, *q)))
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def associate(truth_time_s: Array, time_s: Array, tolerance_s: float = 0.01) -> tuple[NDArray[np.int64], ...]:
    """Return rows of truth and estimate that belong to one moment.

    Each time of the shorter list takes the nearest one of the longer list, if it is within the tolerance, as evo does;
    times are ascending. Returns the row numbers of both, (P,) each.
    """
    swap = len(truth_time_s) >= len(time_s)
    short, long = (time_s, truth_time_s) if swap else (truth_time_s, time_s)
    nearest = nearest_rows(long, short)
    rows = np.flatnonzero(np.abs(long[nearest] - short) <= tolerance_s)
    pair = rows.astype(np.int64), nearest[rows].astype(np.int64)
    return (pair[1], pair[0]) if swap else pair


def evaluate_trajectory(
    truth: Trajectory,
    estimate: Trajectory,
    tolerance_s: float = 0.01,
    delta_frames: int = 1,
    delta: Delta | None = None,
) -> TrajectoryErrors:
    """Measure the errors of an estimate against the truth.

    RPE relates associated poses that are `delta` apart (None: `delta_frames` frames), all of them, overlapping. Raises
    `OptionError` when the two share too few moments, `DegenerateError` when the positions do not determine an
    alignment.
    """
    apart = delta or Delta(delta_frames)
    truth, estimate = on_one_clock(truth, estimate)
    a, b = associated(truth, estimate, tolerance_s)
    rigid = align(a, b, with_scale=False)
    similar = align(a, b, with_scale=True)
    start, end = delta_pairs(a, apart)
    translation, rotation_deg = relative_errors(a, b, start, end)
    scaled, _ = relative_errors(a, scaled_by(b, float(similar.scale)), start, end)
    return TrajectoryErrors(
        pairs=len(a.time_s),
        coverage=len(a.time_s) / len(estimate.time_s),
        covered=coverage(truth, estimate),
        ate_se3_m=statistics(position_errors(a, b, rigid)),
        ate_sim3_m=statistics(position_errors(a, b, similar)),
        scale=float(similar.scale),
        delta=apart,
        rpe_translation_m=statistics(translation),
        rpe_translation_sim3_m=statistics(scaled),
        rpe_rotation_deg=statistics(rotation_deg),
    )


def associated(truth: Trajectory, estimate: Trajectory, tolerance_s: float = 0.01) -> tuple[Trajectory, Trajectory]:
    """Return truth and estimate at the moments that both have. Raises `OptionError` when these are fewer than three."""
    truth, estimate = on_one_clock(truth, estimate)
    rows_truth, rows = associate(truth.time_s, estimate.time_s, tolerance_s)
    if len(rows) < 3:
        raise OptionError(
            f"{len(rows)} poses within {tolerance_s} s of each other: the truth covers {_span(truth)}, the estimate "
            f"{_span(estimate)}; use one clock or a greater tolerance"
        )
    return truth.at(rows_truth), estimate.at(rows)


def coverage(truth: Trajectory, estimate: Trajectory) -> Coverage:
    """Return how much of the truth's time the estimate has poses for."""
    start, end = float(truth.time_s[0]), float(truth.time_s[-1])
    inside = estimate.time_s[(estimate.time_s >= start) & (estimate.time_s <= end)]
    if len(inside) < 2 or end <= start:
        return Coverage(0.0, 0, end - start)
    steps = np.diff(inside)
    usual = float(np.median(np.diff(estimate.time_s)))
    ends = np.array([inside[0] - start, end - inside[-1]])
    missing, gaps = ends[ends > 3 * usual], steps[steps > 3 * usual]
    lost = float(missing.sum() + gaps.sum())
    longest = float(max([*missing, *gaps], default=0.0))
    return Coverage(1.0 - lost / (end - start), len(gaps), longest)


def position_errors(truth: Trajectory, estimate: Trajectory, S_truth_estimate: Sim3) -> Array:
    """Return distances of aligned positions of two associated trajectories. Shape (P,)."""
    return np.asarray(np.linalg.norm(S_truth_estimate.apply(estimate.positions()) - truth.positions(), axis=1))


def scaled_by(trajectory: Trajectory, scale: float) -> Trajectory:
    """Return the same views from positions that are this many times further apart."""
    poses = trajectory.T_world_cam.copy()
    poses[:, :3, 3] *= scale
    return Trajectory(trajectory.time_s, poses)


def align(truth: Trajectory, estimate: Trajectory, *, with_scale: bool) -> Sim3:
    """Return S_truth_estimate from the positions of two trajectories of equal length (Umeyama 1991)."""
    try:
        return umeyama(estimate.positions(), truth.positions(), with_scale=with_scale)
    except DegenerateError as error:
        raise DegenerateError(f"the trajectories cannot be aligned: {error}") from error


def delta_pairs(truth: Trajectory, delta: Delta) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows of the poses that are `delta` apart, two of shape (P,). Raises `OptionError` when there are none.

    Metres count along the true path and seconds on the clock: each pose is paired with the later one at the distance
    nearest to `delta`, if within a tenth of it (evo's all pairs, with pairs from the reference).
    """
    count = len(truth.time_s)
    if delta.unit == "frames":
        start = np.arange(max(count - int(delta.value), 0))
        end = start + int(delta.value)
    else:
        steps = np.linalg.norm(np.diff(truth.positions(), axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)]) if delta.unit == "m" else truth.time_s
        start, wanted = np.arange(count - 1), along[:-1] + delta.value
        end = np.maximum(nearest_rows(along, wanted), start + 1)
        near = np.abs(along[end] - wanted) <= _DELTA_TOLERANCE * delta.value
        start, end = start[near], end[near]
    if len(start) == 0:
        raise OptionError(f"no two of {count} associated poses are {delta} apart: give a smaller delta")
    return start.astype(np.int64), end.astype(np.int64)


def relative_errors(
    truth: Trajectory, estimate: Trajectory, start: NDArray[np.int64], end: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return E = (A_i^-1 A_j)^-1 (B_i^-1 B_j) for truth A, estimate B, rows i, j: translation and angle in degrees,
    (P,)."""
    a, b = (_steps(t, start, end) for t in (truth, estimate))
    error = (a.inverse() @ b).as_matrix()
    angle = np.linalg.norm(rotation_log(error[:, :3, :3]), axis=1)
    return np.linalg.norm(error[:, :3, 3], axis=1), np.rad2deg(angle)


def _steps(trajectory: Trajectory, start: NDArray[np.int64], end: NDArray[np.int64]) -> Sim3:
    poses, ones = Sim3.from_matrix(trajectory.T_world_cam), np.ones(len(start))
    before = Sim3(ones, poses.rotation[start], poses.translation[start])
    return before.inverse() @ Sim3(ones, poses.rotation[end], poses.translation[end])


def statistics(errors: Array) -> Statistics:
    """Return the summary of non-negative errors. Shape (N,)."""
    return Statistics(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(np.mean(errors)),
        median=float(np.median(errors)),
        std=float(np.std(errors)),
        min=float(np.min(errors)),
        max=float(np.max(errors)),
    )


def _span(trajectory: Trajectory) -> str:
    return f"{trajectory.time_s[0]:.3f} to {trajectory.time_s[-1]:.3f} s"
