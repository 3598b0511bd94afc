"""Poses in a text file, one in a row: TUM, EuRoC, KITTI, bare quaternions, 4x4 matrices and the logs of Redwood."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.layout import MAX_LENGTH_M, pose_matrix, read_lines
from list3r.frames.recordings.stamps import as_seconds
from list3r.memory.core.errors import SourceError

_TUM = "time_s tx ty tz qx qy qz qw"
_MOST_OFF = 0.05
"""Of a quaternion's length from 1; columns in another order are off by more."""
_NANOSECONDS = 1e15
"""A stamp in commas that is larger begins a row of EuRoC's: nanoseconds, then the quaternion with w first."""


@dataclass(frozen=True)
class PoseList:
    """Poses in the file's order."""

    T: NDArray[np.float64]
    """NaN in a row that states none. Shape (N, 4, 4)."""
    time_s: NDArray[np.float64] | None
    """Seconds, None where rows have no stamp. Shape (N,)."""
    layout: str
    """How the rows are written, for people."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Rows that state a pose. Shape (N,)."""
        return np.asarray(np.isfinite(self.T).all(axis=(1, 2)))


@dataclass(frozen=True)
class _Row:
    numbers: list[float]
    where: str
    commas: bool


def read_pose_list(path: Path, *, timed: bool = False) -> PoseList:
    """Return the poses of a file; with `timed` positions and quaternions need a time.

    Rows are `time_s tx ty tz qx qy qz qw` (TUM, a ninth number is not read), the same without a time, with commas and
    nanoseconds `time tx ty tz qw qx qy qz` (EuRoC), 12 or 16 numbers of a matrix (KITTI), or matrices of four rows,
    each with a line of numbers before it (the logs of Redwood) or without. Raises `SourceError`, which names the line,
    for anything else.
    """
    header, rows = "", list[_Row]()
    for line, words, commas in _worded(path):
        if not isinstance(line, int):
            header = header or line
            continue
        try:
            rows.append(_Row([float(w) for w in words], f"{path} line {line}", commas))
        except ValueError as error:
            if not rows and not header and all(not w[:1].isdigit() for w in words):
                header = " ".join(words)
                continue
            raise SourceError(f"{path} line {line} is not a pose ({error}); expected: {_TUM}") from error
    if not rows:
        raise SourceError(f"{path} holds no poses; expected lines of: {_TUM}")
    return _of_blocks(path, rows) or _of_rows(rows, header, _COLUMNS[timed:])


def _worded(path: Path) -> Iterator[tuple[int | str, list[str], bool]]:
    """Number and words of each line; a comment comes as its text."""
    for number, line in enumerate(read_lines(path), start=1):
        text, _, comment = line.partition("#")
        if comment:
            yield comment, [], False
        if words := text.replace(",", " ").split():
            yield number, words, "," in text


def _of_blocks(path: Path, rows: list[_Row]) -> PoseList | None:
    """Poses of matrices that are written over four lines, None where they are not."""
    sizes = {len(row.numbers) for row in rows}
    if not sizes <= {1, 2, 3, 4} or 4 not in sizes:
        return None
    lines = [row for row in rows if len(row.numbers) == 4]
    if len(lines) % 4 or len(rows) not in (len(lines), len(lines) * 5 // 4):
        raise SourceError(f"{path} has {len(lines)} lines of a matrix, which are not four for each pose; fix it")
    blocks = [lines[k : k + 4] for k in range(0, len(lines), 4)]
    T = np.stack([_matrix([v for row in block for v in row.numbers], block[0].where) for block in blocks])
    return PoseList(T, None, "matrices of four lines")


def _of_rows(rows: list[_Row], header: str, columns: tuple[int, ...]) -> PoseList:
    first = rows[0]
    count = len(first.numbers)
    wrong = next((r for r in rows if len(r.numbers) != count), None) or (None if count in columns else first)
    if wrong is not None:
        raise SourceError(f"{wrong.where} has {len(wrong.numbers)} numbers; expected 8 finite ones: {_TUM}")
    if count in (12, 16):
        return PoseList(np.stack([_matrix(r.numbers, r.where) for r in rows]), None, "matrices row by row (KITTI)")
    table = np.array([r.numbers for r in rows])
    if count == 7:
        return PoseList(_poses(rows, table), None, "positions and quaternions")
    euroc = first.commas and (float(np.nanmax(table[:, 0])) > _NANOSECONDS or count > 9) and not _w_is_last(header)
    poses = _poses(rows, table[:, [1, 2, 3, 5, 6, 7, 4] if euroc else slice(1, 8)])
    return PoseList(poses, as_seconds(table[:, 0]), "EuRoC" if euroc else "TUM")


_COLUMNS = (7, 8, 9, 11, 12, 16, 17)
"""Numbers in a row that are known."""


def _w_is_last(header: str) -> bool:
    """Whether a header names the quaternion's w behind its x."""
    text = header.lower()
    w, x = (max(text.find(f"q{c}"), text.find(f"q_{c}"), text.find(f"q_rs_{c}")) for c in "wx")
    return 0 <= x < w


def _poses(rows: list[_Row], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses of tx ty tz qx qy qz qw. Shape (N, 7) -> (N, 4, 4). Raises `SourceError` for what is no quaternion."""
    known = np.isfinite(table).all(axis=1)
    length = np.linalg.norm(table[:, 3:], axis=1)
    for k in np.flatnonzero(known & ~(np.abs(length - 1) <= _MOST_OFF))[:1].tolist():
        if length[k] < 1e-6:
            raise SourceError(f"{rows[k].where} has a quaternion of length zero; expected qx qy qz qw of a rotation")
        raise SourceError(
            f"{rows[k].where}: the quaternion has length {length[k]:.3g}, not 1; are the columns in another order than "
            f"{_TUM}?"
        )
    for k in np.flatnonzero(known & (np.abs(table[:, :3]).max(axis=1) > MAX_LENGTH_M))[:1].tolist():
        raise SourceError(f"{rows[k].where} lies {np.abs(table[k, :3]).max():.3g} m away; fix or remove it")
    out = np.full((len(table), 4, 4), np.nan)
    out[known] = np.eye(4)
    out[known, :3, :3] = Rotation.from_quat(table[known, 3:]).as_matrix()
    out[known, :3, 3] = table[known, :3]
    return out


def _matrix(numbers: list[float], where: str) -> NDArray[np.float64]:
    """A pose of 12 or 16 numbers, NaN for one that is not finite. Raises `SourceError` for no rigid motion."""
    if not np.isfinite(numbers).all():
        return np.full((4, 4), np.nan)
    T = pose_matrix(numbers)
    if T is None:
        raise SourceError(f"{where} is not a rigid motion (12 or 16 numbers, row by row); fix or remove it")
    return T
