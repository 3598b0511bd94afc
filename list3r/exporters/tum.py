"""Write the camera trajectory in the format of the TUM RGB-D benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from list3r.exporters.components import read_components
from list3r.exporters.output import part_path, units, write_together
from list3r.memory.core.geometry import Sim3, quat_wxyz_from_rotation
from list3r.memory.core.records import FrameRow
from list3r.memory.store.store import Store

Pose = tuple[FrameRow, Sim3]


def write_tum(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write `T_world_cam` of every posed frame (colour camera) as `time_s tx ty tz qx qy qz qw`, in the order of time.

    Sessions have clocks of their own and components frames of reference of their own, so each pair of them is one
    trajectory: the longest goes to `path`, the others next to it. Returns the files written.
    """
    unit = "metres" if units(store) == "m" else "arbitrary units (relative scale)"

    def write(poses: list[Pose], to: Path) -> None:
        header = [f"# T_world_cam, colour camera, OpenCV axes, {unit}, {len(poses)} frames", f"# {_COLUMNS}"]
        to.write_text("\n".join([*header, *_lines(poses)]) + "\n", encoding="utf-8")

    return write_together(((part_path(Path(path), name), poses) for name, poses in _trajectories(store)), write)


_COLUMNS = "time_s tx ty tz qx qy qz qw"


def _trajectories(store: Store) -> list[tuple[str, list[Pose]]]:
    """Return (name of the part, its poses), the longest first and nameless; at least one."""
    parts: dict[tuple[int, int], list[Pose]] = {}
    for component in read_components(store):
        for pose in component.poses:
            parts.setdefault((pose[0].session_id, component.id), []).append(pose)
    order = sorted(parts, key=lambda k: (-len(parts[k]), k))
    named = [(f"session_{k[0]}.component_{k[1]}" if n else "", parts[k]) for n, k in enumerate(order)]
    return named or [("", [])]


def _lines(poses: list[Pose]) -> list[str]:
    if not poses:
        return []
    time_s = np.array([frame.time_s for frame, _ in poses])
    translation = np.stack([S_world_cam.translation for _, S_world_cam in poses])
    quat_wxyz = quat_wxyz_from_rotation(np.stack([S_world_cam.rotation for _, S_world_cam in poses]))
    rows = np.column_stack([time_s, translation, np.roll(quat_wxyz, -1, axis=1)])
    rows = rows[np.argsort(time_s, kind="stable")] + 0.0
    return [" ".join([f"{row[0]:.6f}", *(f"{v:.9f}" for v in row[1:])]) for row in rows.tolist()]
