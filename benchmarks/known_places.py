"""The most that a camera of repeated visits can know of the places of objects.

An object that was taken away is not missed before a frame sees through where it was, so a change is due at the first
visit that could see it, not at the first after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sessions import MIN_PX, Due, is_elsewhere

from list3r.evaluation.scene import read_scene
from list3r.evaluation.trajectory import read_tum

_LEAST_FRAMES, _LEAST_SHARE, _BEHIND_M = 3, 0.6, 0.05
"""Frames that must see a place empty; the share of it that they must see through, to a surface this much farther."""
_INSIDE = 0.3
"""Search radius round an object's centre, as a share of its size."""
_GRID = np.array(list(product((-_INSIDE, 0.0, _INSIDE), repeat=3)))

Entry = dict[str, Any]
Changes = set[tuple[str, int]]


class KnownPlaces:
    """Where the camera last saw objects, visit by visit."""

    def __init__(self, walks: Sequence[Path]) -> None:
        self.scenes = [_entries(walk) for walk in walks]
        self._visits = [_Visit(walk) for walk in walks]
        self.known: list[dict[int, Entry]] = []
        """By visit: the objects by id where they were last seen, without those with places seen empty since."""
        self.changes: list[Changes] = []
        """By visit: kind and id of changes that it could be the first to see."""
        for n, scene in enumerate(self.scenes):
            seen = {t: e for t, e in scene.items() if e["largest_px"] >= MIN_PX}
            before = self.known[-1] if self.known else {}
            kept = {t: e for t, e in before.items() if t not in seen and not self._empty(n, e)}
            self.known.append({**kept, **seen})
            self.changes.append(self._changes(n, before, self.known[-1]))

    def due(self, n: int) -> Due:
        """Changes that a memory could report of a visit, counted from 0."""
        return Due(
            self.changes[n],
            self._besides(n),
            [{"instances": [*s.values()]} for s in (self.known[n - 1], self.scenes[n])],
        )

    def _besides(self, n: int) -> Changes:
        """Changes without a penalty at a visit: of objects that the camera saw too little of."""
        now = self.scenes[n]
        out = _differences(self.known[n - 1], now) | _differences(self.scenes[n - 1], now)
        out |= {("added", t) for t in now if t not in self.known[n - 1]}
        out |= {(kind, t) for k, t in out if k == "moved" for kind in ("removed", "added")}
        return out - self.changes[n]

    def _changes(self, n: int, before: dict[int, Entry], now: dict[int, Entry]) -> Changes:
        found = _differences(before, now) if n else set()
        known = {t for places in self.known[:n] for t in places}
        came = {t for k, t in found if k == "added" and t not in known}
        return found - {("added", t) for t in came if not any(v.sees_empty(now[t]) for v in self._visits[:n])}

    def _empty(self, n: int, obj: Entry) -> bool:
        """Whether a visit sees that an object is not where it was: the place is empty, or something else has it."""
        if self._visits[n].sees_empty(obj):
            return True
        at, half = (np.array(obj["box"][k]) for k in ("center", "size"))
        others = [e for t, e in self.scenes[n].items() if t != obj["id"] and e["largest_px"] >= MIN_PX]
        gone = is_elsewhere(obj, self.scenes[n].get(obj["id"]))
        return gone and any((np.abs(np.array(e["box"]["center"]) - at) < half / 2).all() for e in others)


class _Visit:
    def __init__(self, walk: Path) -> None:
        path = read_tum(walk / "groundtruth.txt")
        names = [line.split()[1] for line in (walk / "depth.txt").read_text().splitlines() if line[:1] != "#"]
        self._frames = [
            (np.linalg.inv(T), cv2.imread(str(walk / name), cv2.IMREAD_UNCHANGED) / np.float32(5000.0))
            for T, name in list(zip(path.T_world_cam, names, strict=True))[::2]
        ]
        self._camera = np.loadtxt(walk / "calibration.txt").reshape(-1)[:4]

    def sees_empty(self, obj: Entry) -> bool:
        """Whether frames see through the place of an object."""
        seen = sum(self._sees_through(obj, T, depth) for T, depth in self._frames)
        return seen >= _LEAST_FRAMES

    def _sees_through(self, obj: Entry, T_cam_world: NDArray[np.float64], depth: NDArray[np.float32]) -> bool:
        fx, fy, cx, cy = self._camera
        center, size = (np.array(obj["box"][k]) for k in ("center", "size"))
        turned = Rotation.from_quat(obj["box"]["quat_wxyz"], scalar_first=True)
        p = (center + turned.apply(_GRID * size)) @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        if (p[:, 2] < 0.3).any():
            return False
        u, v = np.rint(p[:, 0] / p[:, 2] * fx + cx).astype(int), np.rint(p[:, 1] / p[:, 2] * fy + cy).astype(int)
        height, width = depth.shape
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        if not inside.all() or np.ptp(u) * np.ptp(v) < MIN_PX * (2 * _INSIDE) ** 2:
            return False
        return float(np.mean(depth[v, u] > p[:, 2] + _BEHIND_M)) >= _LEAST_SHARE


def _entries(walk: Path) -> dict[int, Entry]:
    return {e["id"]: e for e in read_scene(walk / "truth.json")["instances"] if not e["structure"]}


def _differences(before: dict[int, Entry], now: dict[int, Entry]) -> Changes:
    moved = {("moved", t) for t in before.keys() & now.keys() if is_elsewhere(before[t], now[t])}
    return (
        moved
        | {("removed", t) for t in before.keys() - now.keys()}
        | {("added", t) for t in now.keys() - before.keys()}
    )
