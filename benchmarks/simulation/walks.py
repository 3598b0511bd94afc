"""Walks that only benchmarks film: presets, and the two rooms after changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.changes import Change, apply_changes
from benchmarks.simulation.presets import make_shot
from benchmarks.simulation.returns import film_return
from benchmarks.simulation.takes import Shot, Take
from list3r.memory.core.errors import OptionError
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.worlds.objects import MovingObject, SimulatedObject
from list3r.simulation.worlds.truth import rounded
from list3r.simulation.worlds.world import SimulatedWorld


@dataclass(frozen=True)
class ChangedWalk(WalkSettings):
    """A walk through the two rooms after something happened there."""

    changes: tuple[Change, ...] = ()

    def world(self) -> SimulatedWorld:
        """The world after its changes."""
        return apply_changes(super().world(), self.changes)


@dataclass(frozen=True)
class PresetWalk(WalkSettings):
    """A building, a way through it and its movers, by name (see `presets`). `seed` decides them; `path` and `walk_seed`
    are unused, and the walk is never slowed.
    """

    preset: str = "calm"

    def world(self) -> SimulatedWorld:
        """The world of the building."""
        return self._shot().building.world

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Seconds (F,) and T_world_cam (F, 4, 4) of the frames to be written."""
        return self._shot().time_s[self._span()], self._shot().T_world_cam[self._span()]

    def movers(self) -> tuple[MovingObject, ...]:
        """The moving objects, with their poses in the frames to be written."""
        return tuple(replace(m, T_world_object=m.T_world_object[self._span()]) for m in self._shot().movers)

    def cuts(self) -> tuple[int, ...]:
        """Frames before which the camera jumps, numbered as they are written."""
        count = len(self.poses()[0])
        return tuple(c - self.start for c in self._shot().cuts if 0 < c - self.start < count)

    def truth(self, seen: dict[int, dict[str, int]]) -> dict[str, Any]:
        """The content of `truth.json`, with the cuts and the movers with their places over time."""
        movers = [_mover_truth(m.obj, m.T_world_object, seen.get(m.obj.id, {})) for m in self.movers()]
        return super().truth(seen) | {"preset": self.preset, "cuts": list(self.cuts()), "movers": movers}

    def _shot(self) -> Shot:
        return _shot(self.preset, self.seed)

    def _span(self) -> slice:
        total = len(self._shot().time_s)
        if total - self.start < 2:
            raise OptionError(f"start {self.start} leaves nothing of a walk of {total} frames")
        return slice(self.start, total if self.frames is None else min(self.start + self.frames, total))


@dataclass(frozen=True)
class SeenAgainWalk(WalkSettings):
    """The end of the first run and the whole second run of `benchmarks.simulation.returns`, where nothing was moved.
    `seed` decides both; `path` and `walk_seed` are unused.
    """

    preset: str = "opposite"
    before: int = 160
    """Frames of the first run."""

    def world(self) -> SimulatedWorld:
        """The world of the building."""
        return _take(self.preset, self.seed).building.world

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Seconds (F,) and T_world_cam (F, 4, 4) of the frames to be written."""
        take = _take(self.preset, self.seed)
        poses = np.concatenate([take.poses[0][-self.before :], take.poses[1]])
        return np.arange(len(poses)) / take.path.fps, poses

    def cut(self) -> int:
        """The frame before which the camera jumps."""
        return min(self.before, len(_take(self.preset, self.seed).poses[0]))


@dataclass(frozen=True)
class HomeSessionWalk(WalkSettings):
    """One of two sessions in a room of a home; half of its movable objects are moved in between (`moved` of `returns`).
    `seed` decides the home and both ways; `path` and `walk_seed` are unused.
    """

    second: bool = False
    """The later session: near the same places, after the change."""
    longest: int = 80
    """The first session is the last so many frames of its run; the second the first so many of its own."""

    def world(self) -> SimulatedWorld:
        """The world of the home as it is in this session."""
        take, later = film_return("moved", self.seed)
        return later if self.second and later is not None else take.building.world

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Seconds (F,) and T_world_cam (F, 4, 4) of the frames to be written."""
        take = _take("moved", self.seed)
        poses = take.poses[1][: self.longest] if self.second else take.poses[0][-self.longest :]
        return np.arange(len(poses)) / take.path.fps, poses


@lru_cache(maxsize=2)
def _take(preset: str, seed: int) -> Take:
    return film_return(preset, seed)[0]


@lru_cache(maxsize=2)
def _shot(preset: str, seed: int) -> Shot:
    return make_shot(preset, seed)


def _mover_truth(obj: SimulatedObject, T_world_object: NDArray[np.float64], seen: dict[str, int]) -> dict[str, Any]:
    """Entry of a moving object in `truth.json`: its size and, for each frame, the middle of its base and its yaw.

    `obj` is at the origin, `T_world_object` (F, 4, 4) upright, metres.
    """
    yaw = np.arctan2(T_world_object[:, 1, 0], T_world_object[:, 0, 0])
    return {
        "id": obj.id,
        "label": obj.label,
        "size": rounded(obj.box().size),
        "position": [rounded(p) for p in T_world_object[:, :3, 3]],
        "yaw": rounded(yaw),
        "frames_seen": seen.get("frames", 0),
        "largest_px": seen.get("largest_px", 0),
    }
