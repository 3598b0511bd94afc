"""A walk through the rooms of a home with a phone that sinks where its holder opens a door.

Chosen before any build, as typical of people who film a home: at a door the hand with the phone goes down while the
other one opens it. For a second or two the picture shows the floor, and then another room. Half of the doors are open,
and nothing happens there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.blind import LOWERED, TURN, WALKED, BlindWalk
from benchmarks.simulation.presets import make_shot
from benchmarks.simulation.walks import PresetWalk
from list3r.simulation.walk import viewing_poses

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoweredSettings:
    """How a phone is lowered at a door."""

    share: float = 0.5
    """Share of doorways with a door that must be opened."""
    pitch_deg: float = -70.0
    """Pitch of the lowered camera, at the floor before the feet."""
    sinks_s: float = 0.5
    """Time in which it sinks, and in which it comes up again."""
    before_s: float = 0.8
    """Time before the doorway at which it is down,"""
    after_s: float = 0.4
    """and after it at which it begins to come up."""
    exposure_s: float = 1.0 / 30.0
    """Of pictures while it sinks and comes up, in lamp light."""
    every: int = 2
    """Pictures of the walk that are kept: every n-th."""


def lowered_walk(walk: PresetWalk, lowered: LoweredSettings | None = None) -> BlindWalk:
    """Return the walk with the phone lowered at some doors. Ways and headings stay as they were."""
    s = lowered or LoweredSettings()
    time_s, poses = walk.poses()
    rng = np.random.default_rng([walk.seed, 41])
    down = np.zeros(len(poses))  # 0 held up, 1 down
    for at_s in _doors(walk):
        if rng.uniform() < s.share:
            inner = np.maximum(time_s - (at_s + s.after_s), (at_s - s.before_s) - time_s)
            down = np.maximum(down, np.clip(1.0 - inner / s.sinks_s, 0.0, 1.0))
    share = 3 * down**2 - 2 * down**3
    names = tuple(WALKED if d == 0 else LOWERED if d == 1 else TURN for d in down)
    T = _pitched(poses, share, np.radians(s.pitch_deg))
    return BlindWalk(time_s[:: s.every], T[:: s.every], names[:: s.every], s.exposure_s)


def _doors(walk: PresetWalk) -> list[float]:
    """Times at which the camera passes from one room to another."""
    time_s, poses = walk.poses()
    building = make_shot(walk.preset, walk.seed).building
    rooms = [building.room_at(*pose[:2, 3]) for pose in poses]
    out, last, left = [], rooms[0], 0
    for k, room in enumerate(rooms):
        if room is not None and last is not None and room is not last:
            out.append(float((time_s[left] + time_s[k]) / 2))
        if room is not None:
            last, left = room, k
    return out


def _pitched(T_world_cam: Array, share: Array, pitch: float) -> Array:
    """Return the poses brought to another pitch by a share, headings and rolls kept. Shape (F, 4, 4)."""
    forward, right = T_world_cam[:, :3, 2], T_world_cam[:, :3, 0]
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    held = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
    level = viewing_poses(T_world_cam[:, :3, 3], yaw, held, np.zeros(len(yaw)))
    roll = np.arctan2((right * level[:, :3, 1]).sum(axis=1), (right * level[:, :3, 0]).sum(axis=1))
    return viewing_poses(T_world_cam[:, :3, 3], yaw, held + share * (pitch - held), roll)
