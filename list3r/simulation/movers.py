"""What moves while it is filmed: a person who walks about before the camera, and a thing that is carried away."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from list3r.simulation import furniture as f
from list3r.simulation.buildings import Building
from list3r.simulation.layout import Placer
from list3r.simulation.materials import Material
from list3r.simulation.routes import FreeMap
from list3r.simulation.things import Thing

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mover:
    """A thing with a pose of its own in every frame."""

    thing: Thing
    """At the origin."""
    T_world_object: Array
    """Upright poses. Shape (F, 4, 4)."""


def make_movers(
    building: Building, free: FreeMap, T_world_cam: Array, fps: float, rng: np.random.Generator
) -> tuple[Mover, ...]:
    """A walking person and a carton that the person carries away in the middle of the video."""
    first = max(t.id for t in building.world.things) + 1
    p = Placer(rng)
    xy, yaw = _stroll(free, T_world_cam, fps, rng)
    person = Mover(Thing(first, "person", _person(p), (0.0, 0.0, 0.0)), upright_poses(xy, np.zeros(len(xy)), yaw))
    size = (float(rng.uniform(0.36, 0.46)), float(rng.uniform(0.28, 0.36)), float(rng.uniform(0.26, 0.36)))
    carton = f.carton(size, p.bright("stripes", 0.4), p.bright("plain", 0.3))
    return person, Mover(Thing(first + 1, "carton", carton, (0.0, 0.0, 0.0)), _carried(xy, yaw, fps, rng))


def upright_poses(xy: Array, z: Array, yaw: Array) -> Array:
    """T_world_object from places (F, 2), heights (F,) and turns about z (F,). Shape (F, 4, 4)."""
    out = np.tile(np.eye(4), (len(yaw), 1, 1))
    c, s = np.cos(yaw), np.sin(yaw)
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = c, -s, s, c
    out[:, :2, 3], out[:, 2, 3] = xy, z
    return out


def _person(p: Placer) -> f.Parts:
    """Legs, body, arms and head, 1.75 m, front towards +y."""
    cloth, trousers = p.bright("stripes", 0.5), p.fabric()
    skin = Material("plain", (214, 170, 140), (232, 196, 170), 0.3)
    hair = Material("plain", (60, 44, 34), (92, 70, 52), 0.2)
    return (
        *(f.pillar(0.085, 0.84, (s * 0.1, 0.0, 0.0), trousers) for s in (-1, 1)),
        f.block((0.42, 0.24, 0.60), (0, 0, 1.13), cloth),
        *(f.pillar(0.05, 0.58, (s * 0.27, 0.02, 0.84), cloth) for s in (-1, 1)),
        f.pillar(0.055, 0.1, (0, 0, 1.43), skin),
        f.globe(0.115, (0, 0.01, 1.62), skin),
        f.globe(0.117, (0, -0.02, 1.65), hair),
    )


def _slow(rng: np.random.Generator, frames: int, period: float) -> Array:
    """Slow noise of unit deviation. Shape (frames,)."""
    noise = gaussian_filter1d(rng.standard_normal(frames + 200), period / 2, mode="wrap")[:frames]
    return np.asarray((noise - noise.mean()) / max(noise.std(), 1e-9))


def _stroll(free: FreeMap, T_world_cam: Array, fps: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Place and turn of a person who keeps before the camera most of the time. Shapes (F, 2) and (F,)."""
    frames = len(T_world_cam)
    forward = T_world_cam[:, :2, 2]
    heading = gaussian_filter1d(np.unwrap(np.arctan2(forward[:, 1], forward[:, 0])), 0.8 * fps, mode="nearest")
    bearing = heading + np.deg2rad(20) * _slow(rng, frames, 3 * fps)
    away = np.clip(1.9 + 0.45 * _slow(rng, frames, 4 * fps), 1.15, 3.2)
    wish = T_world_cam[:, :2, 3] + away[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    xy = free.snap(gaussian_filter1d(wish, 0.5 * fps, axis=0, mode="nearest"))
    xy = gaussian_filter1d(xy, 0.4 * fps, axis=0, mode="nearest")
    step = np.gradient(gaussian_filter1d(xy, 0.5 * fps, axis=0, mode="nearest"), axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0])) - np.pi / 2
    return np.asarray(xy), gaussian_filter1d(yaw, 0.4 * fps, mode="nearest")


def _carried(xy: Array, yaw: Array, fps: float, rng: np.random.Generator) -> Array:
    """A carton that stands on the floor until the person lifts it, and is then carried before the body."""
    frames = len(xy)
    lift = int(frames * rng.uniform(0.35, 0.55))
    reach = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * 0.34
    held = xy + reach
    share = np.clip((np.arange(frames) - lift) / (0.8 * fps), 0, 1)
    share = share * share * (3 - 2 * share)
    place = held[lift] + share[:, None] * (held - held[lift])
    return upright_poses(place, 0.95 * share, np.where(share > 0, yaw, yaw[lift]))


def moved_thing(mover: Mover, frame: int) -> Thing:
    """The thing where it is in a frame."""
    T = mover.T_world_object[frame]
    x, y, z = (float(v) for v in T[:3, 3])
    return replace(mover.thing, position=(x, y, z), yaw=float(np.arctan2(T[1, 0], T[0, 0])))
