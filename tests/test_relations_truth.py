"""Distances between simulated things, against which relations are held: exact where geometry says so."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.gaps import surface_gap
from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.objects import BOX, SPHERE, SimulatedObject
from list3r.simulation.worlds.truth import true_relations
from list3r.simulation.worlds.world import make_world

GREY = Material("plain", (120, 120, 120), (130, 130, 130), 0.3)


def put(id: int, parts: f.Parts, x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0) -> SimulatedObject:
    return SimulatedObject(id, "thing", parts, (x, y, z), float(np.deg2rad(yaw_deg)))


def cube(id: int, x: float, y: float, yaw_deg: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> SimulatedObject:
    return put(id, (f.block((0.2, 0.2, 0.2), (0, 0, 0.1), GREY, yaw),), x, y, z, yaw_deg)


def test_of_boxes_that_face_each_other_with_sides_with_corners_and_above_each_other() -> None:
    assert surface_gap(cube(1, 0, 0), cube(2, 0.5, 0.05)) == pytest.approx(0.3)
    assert surface_gap(cube(1, 0, 0), cube(2, 0.5, 0.6)) == pytest.approx(0.5)
    assert surface_gap(cube(1, 0, 0), cube(2, 0.5, 0.0, 45)) == pytest.approx(0.4 - 0.1 * np.sqrt(2))
    assert surface_gap(cube(1, 0, 0), cube(2, 0.05, 0.0, z=0.3)) == pytest.approx(0.1)
    assert surface_gap(cube(1, 0, 0), cube(2, 0.6, 0.0, z=0.5)) == pytest.approx(0.5)
    assert surface_gap(cube(1, 0, 0), cube(2, 0.15, 0.1, 30)) == 0.0


def test_a_part_turned_within_its_thing_is_measured_where_it_is() -> None:
    assert surface_gap(cube(1, 0, 0, yaw=np.pi / 4), cube(2, 0.5, 0.0)) == pytest.approx(0.4 - 0.1 * np.sqrt(2))


def test_round_things_have_no_corners() -> None:
    ball, box = put(1, f.ball(0.1, GREY), 0, 0), cube(2, 0.3, 0.3)
    assert surface_gap(ball, box) == pytest.approx(np.hypot(0.2, 0.2) - 0.1, abs=1e-3)
    pot = put(3, (f.pillar(0.1, 0.2, (0, 0, 0), GREY),), 0.3, 0.4)
    assert surface_gap(put(4, (f.pillar(0.1, 0.2, (0, 0, 0), GREY),), 0, 0), pot) == pytest.approx(0.3)
    assert surface_gap(ball, put(5, f.ball(0.1, GREY), 0.3, 0.4)) == pytest.approx(0.3, abs=1e-3)
    bowl = put(6, f.bowl(0.1, GREY), 0.0, 0.0)
    assert surface_gap(bowl, cube(7, 0.0, 0.0, z=0.3)) == pytest.approx(0.2, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_is_that_of_the_nearest_of_many_surface_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kinds = [f.chair(GREY, GREY), f.plant(GREY, GREY), f.monitor(0.5, GREY, GREY), f.mug(0.05, 0.11, GREY)]
    for first in kinds:
        for second in kinds:
            a = put(1, first, 0, 0, 0, float(rng.uniform(0, 360)))
            b = put(2, second, *rng.uniform(0.3, 0.7, 2), float(rng.uniform(0, 0.6)), float(rng.uniform(0, 360)))
            sampled = float(cKDTree(surface_of(a, rng)).query(surface_of(b, rng))[0].min())
            gap = surface_gap(a, b)
            assert gap - 1e-3 <= sampled <= gap + 0.03 or gap == 0.0


def surface_of(obj: SimulatedObject, rng: np.random.Generator, count: int = 3000) -> np.ndarray:
    """Points on the surfaces of the parts, world. Shape (N, 3)."""
    out = []
    for part in obj.parts:
        p = rng.uniform(-1, 1, (count, 3))
        if part.kind == BOX:
            face = rng.integers(3, size=count)
            p[np.arange(count), face] = np.sign(p[np.arange(count), face])
            c, s = np.cos(part.yaw), np.sin(part.yaw)
            p = p * part.half @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        elif part.kind == SPHERE:
            p = part.half[0] * p / np.linalg.norm(p, axis=1, keepdims=True)
        else:
            p[:, :2] /= np.linalg.norm(p[:, :2], axis=1, keepdims=True)
            p = p * part.half
        out.append(p + part.center)
    return np.concatenate(out) @ obj.rotation().T + obj.position


def test_next_to_is_told_by_surfaces_and_both_ways() -> None:
    world = make_world(5)
    found = {(s, o) for s, p, o in true_relations(world) if p == "next_to"}
    assert found and all((o, s) in found for s, o in found)
    for s, o in found:
        assert surface_gap(world.object_of(s), world.object_of(o)) <= 0.4
