"""Which way is up by how a camera was held: people keep a phone level and look a little down, and turn about upright.

What pictures alone tell is a prior: how level each camera was held says as much of up as the cameras were turned to
different sides, and how far down they looked is known to some tens of degrees. Surfaces may say it better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Array, Sim3


@dataclass(frozen=True)
class HeldSettings:
    """How people hold a camera; the medians of RedKitchen (7-Scenes) are 3 degrees of roll and 26 down."""

    level_deg: float = 5.0
    """Deviation of the roll that the cameras of one side share; at least the median roll is."""
    roll_deg: float = 8.0
    """A frame that is rolled by more counts less (Cauchy)."""
    down_deg: float = 15.0
    """How far down people look who film a room,"""
    pitch_deg: float = 20.0
    """and the deviation of that from recording to recording."""
    most_roll_deg: float = 20.0
    """Median roll beyond which nobody held the camera level."""
    wide_deg: float = 27.0
    """Where the x axes are turned by so much (RMS), about 90 degrees in all,"""
    round: float = 4.0
    """and go round an axis, this many times wider across it than along,"""
    askew_deg: float = 15.0
    """people turn about up: an axis further from it tells that they were rolled alike."""
    turned_deg: float = 15.0
    """A camera that turned by so much (RMS), and about its own x axis alone, was held on its side or only nodded."""
    turned_ratio: float = 0.5
    """Of how far the x axes are turned to how far the cameras' up is, below which that is so."""
    risen: float = 2.0
    """A camera that moved up and down by so many times what it moved to the sides was held on its side."""


@dataclass(frozen=True)
class HeldUp:
    """Up by the cameras."""

    up: Array
    """Unit vector. Shape (3,)."""
    deviation_deg: float
    """Of that direction, along the worst axis."""
    rolled: bool = False
    """Whether the cameras were not held level: they do not tell up, and surfaces may."""
    doubt: str | None = None
    """Why the pictures lie on their side, whatever surfaces seem to say; None where nothing speaks for that."""


def parse_up(text: str) -> Array | None:
    """Return the direction (3,) that a user says is up, None for `camera` and `unknown`. Raises `OptionError`."""
    if text in ("camera", "unknown"):
        return None
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    length = math.hypot(*values)
    if values.shape != (3,) or not math.isfinite(length) or length < 1e-9:
        raise OptionError(f"--up {text}: choose camera, unknown, or a direction x,y,z such as 0,-1,0")
    return values / length


def up_as_held(S_graph_cam: Sim3, settings: HeldSettings | None = None) -> HeldUp:
    """Return up by F cameras (F > 0), each with x to its right, y down and z ahead.

    The direction to which the x axes are most orthogonal, by reweighted least squares, with the mean up of the cameras
    as prior: the least eigenvector of mean(w x x^T) / level^2 - m m^T / pitch^2.
    """
    s = settings or HeldSettings()
    x, own_up, ahead = (S_graph_cam.rotation[:, :, 0], -S_graph_cam.rotation[:, :, 1], S_graph_cam.rotation[:, :, 2])
    down, level, pitch = np.radians([s.down_deg, s.level_deg, s.pitch_deg])
    mean = (np.cos(down) * own_up - np.sin(down) * ahead).mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    up = mean
    for _ in range(10):
        weight = 1.0 / (1.0 + (np.arcsin(np.clip(x @ up, -1, 1)) / np.radians(s.roll_deg)) ** 2)
        across = (x * weight[:, None]).T @ x / weight.sum()
        up = np.linalg.eigh(across / level**2 - np.outer(mean, mean) / pitch**2)[1][:, 0]
        up = up if up @ mean >= 0 else -up
    sides = np.linalg.svd(up[None])[2][1:]
    rolled = float(np.median(np.abs(np.arcsin(np.clip(x @ up, -1, 1)))))
    known = sides @ across @ sides.T / max(level, rolled) ** 2 + np.eye(2) / pitch**2
    deviation = float(np.degrees(1.0 / np.sqrt(np.linalg.eigvalsh(known)[0])))
    askew = rolled > np.radians(s.most_roll_deg) or _rolled_alike(x, up, s)
    return HeldUp(up, deviation, askew, _on_side(S_graph_cam, up, s))


def _rolled_alike(x: Array, up: Array, s: HeldSettings) -> bool:
    """Return whether x axes (F, 3) that go round an axis tell that it is another one than up."""
    spread, axes = np.linalg.eigh(np.cov(x.T, bias=True))
    wide = spread.sum() > np.sin(np.radians(s.wide_deg)) ** 2 and spread[1] > s.round * spread[0]
    return bool(wide and abs(axes[:, 0] @ up) < np.cos(np.radians(s.askew_deg)))


def _on_side(S_graph_cam: Sim3, up: Array, s: HeldSettings) -> str | None:
    """Return what tells that the pictures lie on their side."""
    turned, nodded = (_spread(S_graph_cam.rotation[:, :, k]) for k in (0, 1))
    if nodded > np.sin(np.radians(s.turned_deg)) and turned < s.turned_ratio * nodded:
        return "the camera turned about its own x axis alone, as one does that is held on its side"
    moved = S_graph_cam.translation - S_graph_cam.translation.mean(axis=0)
    beside = moved - np.outer(moved @ up, up)
    along, aside = (float(np.sqrt((m**2).sum() / len(m))) for m in (moved - beside, beside))
    if along > s.risen * aside > 0.0:
        return "the camera moved up and down and not to the sides, as one does that is held on its side"
    return None


def _spread(directions: Array) -> float:
    """Return the RMS distance of unit vectors (F, 3) from their mean, 0 to 1."""
    return float(np.sqrt(max(0.0, 1.0 - float(np.linalg.norm(directions.mean(axis=0))) ** 2)))
