"""The trajectory of an Aria recording as MPS or the Digital Twin writes it: a CSV of up to a thousand rows a second.

Rows have the pose of the device in a world (`..._world_device`, of an open loop `..._odometry_device`), the vector of
gravity in it, and `graph_uid`: poses of two graphs lie in worlds that have nothing to do with each other.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.files import check_ordinary
from list3r.frames.readers.tum import poses_at
from list3r.frames.recordings.axes import pose_of_quaternion
from list3r.memory.core.errors import SourceError

_MOST_BYTES = 2**36
"""Of a trajectory; it is read row by row."""
_LONGEST_ROW = 2**16
_LEAST_GRAVITY = 5.0
"""m/s^2; a shorter vector says nothing."""


@dataclass(frozen=True)
class DeviceTrajectory:
    """Where the device was at given times."""

    T_world_device: Sequence[NDArray[np.float64] | None]
    """In a world with z up where `upright`. Shape (4, 4) each."""
    upright: bool
    """Whether the file says where gravity points."""
    drifts: bool
    """Whether loops were left open."""
    elsewhere: int
    """Times whose pose lies in another world and is left out."""


def read_trajectory(path: Path, times_s: NDArray[np.float64]) -> DeviceTrajectory:
    """Return the poses at ascending times of the device's clock, shape (N,). Raises `SourceError`."""
    worlds: dict[str, list[list[float]]] = {}
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        check_ordinary(path.stat(), path, _MOST_BYTES)
        names = next(csv.reader([file.readline(_LONGEST_ROW)]), [])
        world = "world" if "tx_world_device" in names else "odometry"
        wanted = [f"t{a}_{world}_device" for a in "xyz"] + [f"q{a}_{world}_device" for a in "xyzw"]
        gravity = [f"gravity_{a}_{world}" for a in "xyz"]
        if "tracking_timestamp_us" not in names or not set(wanted) <= set(names):
            raise SourceError(f"{path} is not a trajectory of Aria (tracking_timestamp_us, tx_world_device, ...)")
        columns = [names.index(n) for n in ("tracking_timestamp_us", *wanted, *(g for g in gravity if g in names))]
        graph = names.index("graph_uid") if "graph_uid" in names else None
        for uid, row in _beside(_rows(file, columns, graph, path), times_s):
            worlds.setdefault(uid, []).append(row)
    if not worlds:
        raise SourceError(f"{path} has no pose at the time of any picture; is it of this recording?")
    rows = np.array(max(worlds.values(), key=len))
    poses = poses_at(times_s, rows[:, 0], rows[:, 1:8])
    down = np.median(rows[:, 8:], axis=0) if rows.shape[1] == 11 else np.zeros(3)
    upright = float(np.linalg.norm(down)) > _LEAST_GRAVITY
    T_up_world = np.eye(4)
    if upright:
        T_up_world[:3, :3] = Rotation.align_vectors([[0.0, 0.0, -1.0]], [down / np.linalg.norm(down)])[0].as_matrix()
    others = sum(len(found) for found in worlds.values()) - len(rows)
    return DeviceTrajectory(
        [None if T is None else T_up_world @ T for T in poses], upright, world == "odometry", others // 2
    )


def _rows(file: Iterator[str], columns: list[int], graph: int | None, path: Path) -> Iterator[tuple[str, list[float]]]:
    """Yield the graph and seconds, translation, quaternion and gravity of each row whose pose is one."""
    before = -np.inf
    for number, words in enumerate(csv.reader(file), start=2):
        try:
            values = [float(words[k]) for k in columns]
        except (ValueError, IndexError):
            raise SourceError(f"{path}: line {number} is not a row of a trajectory; is the copy complete?") from None
        values[0] *= 1e-6
        if pose_of_quaternion(values[1:4], values[4:8]) is None or not np.isfinite(values).all():
            continue
        if values[0] < before:
            raise SourceError(f"{path}: line {number} goes back in time; sort the rows")
        before = values[0]
        yield ("" if graph is None else words[graph]), values


def _beside(rows: Iterator[tuple[str, list[float]]], times_s: NDArray[np.float64]) -> Iterator[tuple[str, list[float]]]:
    """Yield the last row before and the first one after each time, once each."""
    at, last, given = 0, None, None
    for row in rows:
        if at < len(times_s) and row[1][0] >= times_s[at]:
            if last is not None and last is not given:
                yield last
            yield row
            given = row
            at = int(np.searchsorted(times_s, row[1][0], side="right"))
        last = row
        if at == len(times_s):
            return
    if last is not None and last is not given:
        yield last
