"""Gravity: up is found where planes and cameras agree, and is unknown where they do not."""

from __future__ import annotations

import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import list3r.memory.library.world.gravity as world_gravity
from list3r.memory.core.geometry import Array, Sim3, rotation_exp
from list3r.memory.library.overlap.planes import Planes, planar_area
from list3r.memory.library.world.gravity import (
    Gravity,
    estimate_gravity,
    floor_height,
    gravity_from_planes,
    world_from_graph,
)
from list3r.memory.store.store import Store
from tests.conftest import box_points, chunk_result, local_instance

WALLS = np.array([[-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
"""Ahead of a camera that looks along x, and on either side."""


def cameras(pitch_deg: float, yaws_deg: Array, roll_deg: float = 0.0, height: float = 1.4) -> Sim3:
    """Cameras of a z-up world that look down by `pitch_deg`."""
    out = []
    for yaw in np.radians(yaws_deg):
        forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        level = np.stack([right, [0, 0, -1.0], forward], axis=1)
        tilt = rotation_exp(np.array([-np.radians(pitch_deg), 0, 0])) @ rotation_exp(
            np.array([0, 0, np.radians(roll_deg)])
        )
        out.append(level @ tilt)
    count = len(out)
    return Sim3(np.ones(count), np.array(out), np.tile([0.0, 0.0, height], (count, 1)))


def room(noise_deg: float = 1.0, seed: int = 0, table: float = 1.0, floor: float = 2.0, walls: float = 4.0) -> Planes:
    rng = np.random.default_rng(seed)
    normals = np.concatenate([[[0, 0, 1.0]], [[0, 0, 1.0]], WALLS])
    centers = np.array([[0, 0, 0.72], [0, 1, 0.0], [2, 0, 1.2], [0, -2, 1.2], [0, 2, 1.2]])
    areas = np.array([table, floor, walls, walls, walls])
    turned = normals + np.radians(noise_deg) * rng.normal(size=normals.shape)
    points = rng.uniform([-2, -2, 0], [2, 2, 2], (2000, 3))
    keep = areas > 0
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return Planes(turned[keep], centers[keep], areas[keep], points, np.full(len(points), -1))


def seen_from(S_graph_world: Sim3, planes: Planes) -> Planes:
    turned = planes.normal @ S_graph_world.rotation.T
    return Planes(
        turned, S_graph_world.apply(planes.center), planes.area, S_graph_world.apply(planes.points), planes.owner
    )


def error_deg(gravity: Gravity, up: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(gravity.up @ up, -1, 1))))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("pitch", [0.0, 25.0, 45.0])
def test_up_and_floor_are_recovered_in_any_frame(seed: int, pitch: float) -> None:
    rng = np.random.default_rng(seed)
    S_graph_world = Sim3.exp(np.append(rng.normal(0, 1.0, 6), 0.0))
    planes = seen_from(S_graph_world, room(seed=seed))
    gravity = gravity_from_planes(planes, S_graph_world @ cameras(pitch, np.linspace(-40, 50, 20), roll_deg=3.0))
    up = S_graph_world.rotation[:, 2]
    assert gravity.status == "estimated"
    assert error_deg(gravity, up) < 2.0
    assert gravity.floor_height is not None
    T_world_graph = world_from_graph(gravity)
    floor = T_world_graph.apply(S_graph_world.apply(np.array([[0.0, 1.0, 0.0]])))
    assert abs(floor[0, 2]) < 0.08
    assert np.allclose(T_world_graph.rotation @ gravity.up, [0, 0, 1], atol=1e-9)


def test_memory_does_not_grow_with_planes_times_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = [room(seed=n) for n in range(400)]
    whole = Planes(*(np.concatenate([getattr(r, f.name)[:50] for r in rooms]) for f in fields(Planes)))
    held = cameras(25.0, np.linspace(-40, 50, 3000), roll_deg=3.0)
    tracemalloc.start()
    found = gravity_from_planes(whole, held)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30e6  # 48e6 is a single array of all planes by all cameras
    monkeypatch.setattr(world_gravity, "_MOST_NUMBERS", 1 << 30)
    at_once = gravity_from_planes(whole, held)
    assert np.allclose(found.up, at_once.up, atol=1e-9) and found.reason == at_once.reason


def test_a_camera_that_looks_down_at_a_desk_by_45_degrees_does_not_take_the_wall_for_the_floor() -> None:
    planes = room(floor=0.0, table=0.6, walls=6.0)
    gravity = gravity_from_planes(planes, cameras(48.0, np.linspace(-15, 15, 30)))
    assert gravity.status == "estimated"
    assert error_deg(gravity, np.array([0, 0, 1.0])) < 2.0


def test_a_table_is_not_taken_for_the_floor() -> None:
    near = cameras(40.0, np.linspace(-15, 15, 30), height=1.2)
    gravity = gravity_from_planes(room(floor=0.0), near)
    assert gravity.status == "estimated" and gravity.floor_height is None


@pytest.mark.parametrize(
    "planes",
    [
        room(table=0.0, floor=0.0, walls=0.0),
        room(table=0.0, floor=0.0),
        seen_from(Sim3.exp([0, 0, 0, 0.6, 0.3, 0, 0]), room(walls=0.0)),
    ],
    ids=["no planes", "only walls", "planes that disagree with the cameras"],
)
def test_up_is_unknown_without_evidence(planes: Planes) -> None:
    gravity = gravity_from_planes(planes, cameras(10.0, np.linspace(-40, 50, 20)))
    assert gravity.status == "unknown"
    assert np.allclose(world_from_graph(gravity).as_matrix(), np.eye(4))


def test_up_is_unknown_without_cameras() -> None:
    none = Sim3(np.ones(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert gravity_from_planes(room(), none).status == "unknown"


def test_world_from_graph_is_the_smallest_rotation() -> None:
    for up in ([0, 0, 1.0], [0, 0, -1.0], [0, -1.0, 0], [0.6, 0, 0.8]):
        gravity = Gravity("estimated", np.array(up, float), None, "")
        rotation = world_from_graph(gravity).rotation
        angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
        assert np.isclose(angle, np.arccos(up[2]))
        assert np.allclose(rotation @ up, [0, 0, 1])


def test_planar_area_of_a_rectangle() -> None:
    p = np.random.default_rng(0).uniform([-1, -0.5, 0], [1, 0.5, 0], (4000, 3))
    assert abs(planar_area(p, np.array([0, 0, 1.0])) - 2.0) < 0.1


def test_gravity_of_a_store_follows_its_planes_and_cameras(tmp_path: Path) -> None:
    import dataclasses

    frames = np.arange(20)
    table = local_instance(0, box_points((2, 0, -0.6), (1.2, 0.8, 0.005), 900, 0), (150, 110, 70), frames)
    table = dataclasses.replace(table, plane=np.array([0, 0, 1, 0.6]))
    with Store.create(tmp_path / "a.l3r") as store, store.transaction():
        assert estimate_gravity(store).status == "unknown"
        session = store.sessions.add("walk", "abc", {}, 20)
        store.chunks.add(session, chunk_result(0, 0, 20, (table,)))
        gravity = estimate_gravity(store)
        assert gravity.status == "estimated" and error_deg(gravity, np.array([0, 0, 1.0])) < 1.0


def test_a_level_surface_above_much_else_is_no_floor() -> None:
    up, centers = np.array([0.0, 0.0, 1.0]), np.tile([0.0, 0.0, 1.6], (10, 1))
    points = np.random.default_rng(0).uniform([-2, -2, 0], [2, 2, 2], (1000, 3))
    plane = Planes(np.array([up]), np.zeros((1, 3)), np.array([6.0]), points, np.full(1000, -1))
    assert floor_height(up, plane, centers) == pytest.approx(0.0)
    sunk = replace(plane, points=points - [0.0, 0.0, 1.0])
    assert floor_height(up, sunk, centers) is None
