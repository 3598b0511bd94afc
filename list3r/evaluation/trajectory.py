"""Trajectory errors: ATE after SE(3) and Sim(3) alignment, RPE at a stated delta.

The conventions are those of evo and of the TUM RGB-D benchmark (Sturm et al., "A benchmark for the evaluation of RGB-D
SLAM systems", 2012): poses are associated by time, the alignment is Umeyama's over all associated positions.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import DegenerateError, OptionError, SourceError
from list3r.memory.geometry import Sim3, quat_wxyz_from_rotation, rotation_from_quat_wxyz, rotation_log, umeyama

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """Poses of a camera over time."""

    time_s: Array
    """Seconds, ascending. Shape (F,)."""
    T_world_cam: Array
    """Shape (F, 4, 4)."""

    def __post_init__(self) -> None:
        if self.T_world_cam.shape != (len(self.time_s), 4, 4):
            raise OptionError(f"{len(self.time_s)} times with poses of shape {self.T_world_cam.shape}: want (F, 4, 4)")

    def positions(self) -> Array:
        """Camera centres in the world. Shape (F, 3)."""
        return self.T_world_cam[:, :3, 3]

    def at(self, rows: NDArray[np.int64]) -> Trajectory:
        """The poses of some rows."""
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
class TrajectoryErrors:
    """How far an estimated trajectory is from the truth."""

    pairs: int
    """Associated poses."""
    coverage: float
    """Associated share of the estimated poses."""
    ate_se3_m: Statistics
    """Distance of positions after rigid alignment, units of the truth."""
    ate_sim3_m: Statistics
    """The same with the scale free."""
    scale: float
    """Factor of the Sim(3) alignment from the estimate to the truth; 1 for a perfect metric estimate."""
    delta_frames: int
    """Distance of the poses that RPE relates, in associated poses."""
    rpe_translation_m: Statistics
    """Length of the translation of the relative error, no alignment."""
    rpe_rotation_deg: Statistics
    """Angle of the relative error."""

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return asdict(self)


def read_tum(path: str | Path) -> Trajectory:
    """Read `time_s tx ty tz qx qy qz qw` lines; `#` starts a comment; spaces, tabs or commas between numbers.

    Raises `SourceError` for a file that is absent or has a line that is no pose. Rows are sorted by time.
    """
    path = Path(path)
    rows: list[list[float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"cannot read the trajectory {path}: {_reason(error)}") from error
    for number, line in enumerate(lines, 1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if words:
            rows.append(_tum_row(words, f"{path} line {number}"))
    if not rows:
        raise SourceError(f"{path} holds no poses; want lines of: time_s tx ty tz qx qy qz qw")
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = rotation_from_quat_wxyz(table[:, [7, 4, 5, 6]])
    poses[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0], poses)


def _reason(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "it is not a text file"


def _tum_row(words: list[str], where: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise SourceError(f"{where} is not a pose ({error}); want: time_s tx ty tz qx qy qz qw") from error
    if len(numbers) != 8 or not np.isfinite(numbers).all():
        raise SourceError(f"{where} has {len(numbers)} numbers; want 8 finite ones: time_s tx ty tz qx qy qz qw")
    if not np.linalg.norm(numbers[4:]) > 1e-6:
        raise SourceError(f"{where} has a quaternion of length zero; want qx qy qz qw of a rotation")
    return numbers


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write `time_s tx ty tz qx qy qz qw` lines."""
    wxyz = quat_wxyz_from_rotation(trajectory.T_world_cam[:, :3, :3])
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for t, p, q in zip(trajectory.time_s, trajectory.positions(), np.roll(wxyz, -1, axis=1), strict=True):
        lines.append(f"{t:.6f} " + " ".join(f"{v:.9f}" for v in (*p, *q)))
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def associate(truth_time_s: Array, time_s: Array, tolerance_s: float = 0.01) -> tuple[NDArray[np.int64], ...]:
    """Rows of truth and estimate that belong to one moment.

    Each time of the shorter list takes the nearest one of the longer list, if it is within the tolerance, as evo does;
    times are ascending. Returns the row numbers of both, (P,) each.
    """
    swap = len(truth_time_s) >= len(time_s)
    short, long = (time_s, truth_time_s) if swap else (truth_time_s, time_s)
    right = np.clip(np.searchsorted(long, short), 1, max(len(long) - 1, 1))
    right = np.minimum(right, len(long) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(long[left] - short) <= np.abs(long[right] - short), left, right)
    rows = np.flatnonzero(np.abs(long[nearest] - short) <= tolerance_s)
    pair = rows.astype(np.int64), nearest[rows].astype(np.int64)
    return (pair[1], pair[0]) if swap else pair


def evaluate_trajectory(
    truth: Trajectory, estimate: Trajectory, tolerance_s: float = 0.01, delta_frames: int = 1
) -> TrajectoryErrors:
    """Errors of an estimate against the truth.

    RPE relates associated poses that lie `delta_frames` apart, all of them, overlapping. Raises `OptionError` when
    the two share too few moments, `DegenerateError` when the positions do not determine an alignment.
    """
    if delta_frames < 1:
        raise OptionError(f"delta {delta_frames}: RPE needs a distance of at least 1 frame")
    rows_truth, rows = associate(truth.time_s, estimate.time_s, tolerance_s)
    if len(rows) < max(3, delta_frames + 1):
        raise OptionError(
            f"{len(rows)} poses within {tolerance_s} s of each other: the truth covers {_span(truth)}, the estimate "
            f"{_span(estimate)}; use one clock, a greater tolerance, or a smaller delta"
        )
    a, b = truth.at(rows_truth), estimate.at(rows)
    rigid = align(a, b, with_scale=False)
    similar = align(a, b, with_scale=True)
    translation, rotation_deg = relative_errors(a, b, delta_frames)
    return TrajectoryErrors(
        pairs=len(rows),
        coverage=len(rows) / len(estimate.time_s),
        ate_se3_m=statistics(np.linalg.norm(rigid.apply(b.positions()) - a.positions(), axis=1)),
        ate_sim3_m=statistics(np.linalg.norm(similar.apply(b.positions()) - a.positions(), axis=1)),
        scale=float(similar.scale),
        delta_frames=delta_frames,
        rpe_translation_m=statistics(translation),
        rpe_rotation_deg=statistics(rotation_deg),
    )


def align(truth: Trajectory, estimate: Trajectory, *, with_scale: bool) -> Sim3:
    """S_truth_estimate from the positions of two trajectories of equal length (Umeyama 1991)."""
    try:
        return umeyama(estimate.positions(), truth.positions(), with_scale=with_scale)
    except DegenerateError as error:
        raise DegenerateError(f"the trajectories cannot be aligned: {error}") from error


def relative_errors(truth: Trajectory, estimate: Trajectory, delta: int) -> tuple[Array, Array]:
    """E_i = (A_i^-1 A_i+d)^-1 (B_i^-1 B_i+d) for truth A and estimate B: translation (P,) and angle in degrees (P,)."""
    a, b = Sim3.from_matrix(truth.T_world_cam), Sim3.from_matrix(estimate.T_world_cam)
    error = (_step(a, delta).inverse() @ _step(b, delta)).as_matrix()
    angle = np.linalg.norm(rotation_log(error[:, :3, :3]), axis=1)
    return np.linalg.norm(error[:, :3, 3], axis=1), np.rad2deg(angle)


def _step(poses: Sim3, delta: int) -> Sim3:
    ones = np.ones(len(poses.scale) - delta)
    start = Sim3(ones, poses.rotation[:-delta], poses.translation[:-delta])
    return start.inverse() @ Sim3(ones, poses.rotation[delta:], poses.translation[delta:])


def statistics(errors: Array) -> Statistics:
    """Summary of non-negative errors. Shape (N,)."""
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
