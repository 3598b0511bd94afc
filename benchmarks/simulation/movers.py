"""Moving objects: a person who walks before the camera, and an object that is carried away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.simulation.buildings import Building
from benchmarks.simulation.routes import FreeMap
from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.layout import Placer
from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.objects import MovingObject, SimulatedObject

Array = NDArray[np.float64]

_DECIDE_S = 0.4
_HASTE_M_S = 1.3
"""Speed above which a person does not like to walk."""


def make_movers(
    building: Building, free: FreeMap, T_world_cam: Array, fps: float, rng: np.random.Generator
) -> tuple[MovingObject, ...]:
    """A walking person and a carton that the person carries away in the middle of the video."""
    first = max(t.id for t in building.world.objects) + 1
    p = Placer(rng)
    xy, yaw = _stroll(free, T_world_cam, fps, rng)
    person = MovingObject(
        SimulatedObject(first, "person", _person(p), (0.0, 0.0, 0.0)), upright_poses(xy, np.zeros(len(xy)), yaw)
    )
    size = (float(rng.uniform(0.36, 0.46)), float(rng.uniform(0.28, 0.36)), float(rng.uniform(0.26, 0.36)))
    carton = f.carton(size, p.bright("stripes", 0.4), p.bright("plain", 0.3))
    return person, MovingObject(
        SimulatedObject(first + 1, "carton", carton, (0.0, 0.0, 0.0)), _carried(free, T_world_cam, xy, yaw, fps, rng)
    )


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
    """Place and turn of a person who keeps before the camera most of the time. Shapes (F, 2) and (F,).

    Every 0.4 s the person can be at places of some bearings and distances before the camera; the way through them
    that strays least from a slowly changing wish, without haste and not through walls, is found by Viterbi's method.
    """
    frames = len(T_world_cam)
    every = max(1, round(_DECIDE_S * fps))
    keys = np.unique(np.append(np.arange(0, frames, every), frames - 1))
    eye, forward = T_world_cam[keys, :2, 3], T_world_cam[keys, :2, 2]
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    wish = np.stack([np.deg2rad(16) * _slow(rng, len(keys), 8), 1.55 + 0.4 * _slow(rng, len(keys), 10)], axis=1)
    bearing, away = np.meshgrid(np.deg2rad(np.arange(-60, 61, 12)), np.arange(1.0, 3.3, 0.25))
    bearing, away = bearing.ravel(), away.ravel()
    angle = heading[:, None] + bearing
    places = eye[:, None] + away[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    strays = ((bearing - wish[:, :1]) / 0.25) ** 2 + ((away - wish[:, 1:]) / 0.4) ** 2
    blocked = free.crosses_wall(eye[:, None], places)
    tight = np.maximum(0.3 - free.clearance(places), 0) / 0.1
    chosen = _viterbi(free, places, strays + 60.0 * blocked + 4 * tight**2, np.diff(keys) / fps)
    xy = np.stack([np.interp(np.arange(frames), keys, chosen[:, k]) for k in range(2)], axis=1)
    xy = gaussian_filter1d(xy, 0.35 * fps, axis=0, mode="nearest")
    step = np.gradient(gaussian_filter1d(xy, 0.4 * fps, axis=0, mode="nearest"), axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0])) - np.pi / 2
    return np.asarray(xy), gaussian_filter1d(yaw, 0.4 * fps, mode="nearest")


def _viterbi(free: FreeMap, places: Array, cost: Array, seconds: Array) -> Array:
    """The cheapest way through one place of each row. `places` (K, S, 2), `cost` (K, S), `seconds` (K - 1,)."""
    total, back = cost[0], []
    for k in range(1, len(places)):
        a, b = places[k - 1][:, None], places[k][None]
        haste = np.linalg.norm(b - a, axis=2) / seconds[k - 1]
        move = 2.0 * haste**2 + 40.0 * np.maximum(haste - _HASTE_M_S, 0)
        near = np.nonzero(haste < 2 * _HASTE_M_S)
        move[near] += 200.0 * free.crosses_wall(places[k - 1][near[0]], places[k][near[1]])
        through = total[:, None] + move
        back.append(through.argmin(axis=0))
        total = through.min(axis=0) + cost[k]
    state = [int(total.argmin())]
    for choice in reversed(back):
        state.append(int(choice[state[-1]]))
    return np.asarray(places[np.arange(len(places)), state[::-1]])


def _carried(free: FreeMap, T_world_cam: Array, xy: Array, yaw: Array, fps: float, rng: np.random.Generator) -> Array:
    """A carton that is on the floor, is lifted by the person before the camera, carried, and set down elsewhere."""
    frames = len(xy)
    held = xy + np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * 0.34
    lifts = np.arange(int(0.25 * frames), int(0.6 * frames), 10)
    shown = [_views(free, T_world_cam[max(0, k - 200) : k + 1 : 4], held[k]) for k in lifts]
    best = np.argsort(-np.array(shown), kind="stable")[:5]
    lift = int(lifts[best[rng.integers(len(best))]])
    put = min(lift + int(rng.integers(16, 30) * fps), frames - 1)
    share = np.clip((np.arange(frames) - lift) / (0.8 * fps), 0, 1)
    share = share * np.clip((put - np.arange(frames)) / (0.8 * fps), 0, 1)
    share = share * share * (3 - 2 * share)
    moment = np.clip(np.arange(frames), lift, put)
    return upright_poses(held[moment], 0.95 * share, yaw[moment])


def _views(free: FreeMap, T_world_cam: Array, xy: Array) -> int:
    """How many of the cameras see a place on the floor, limited by walls."""
    offset = xy - T_world_cam[:, :2, 3]
    away = np.linalg.norm(offset, axis=1)
    along = np.einsum("nk,nk->n", offset, T_world_cam[:, :2, 2])
    across = np.abs(offset[:, 0] * T_world_cam[:, 1, 2] - offset[:, 1] * T_world_cam[:, 0, 2])
    ahead = (along > 1.6) & (across < 0.45 * along) & (away < 4.5)
    return int((ahead & ~free.crosses_wall(T_world_cam[:, :2, 3], xy[None])).sum())
