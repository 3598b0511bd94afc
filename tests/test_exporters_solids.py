"""Solids of instances: open where sight went through, closed where nothing says otherwise; their physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.exporters.meshes.closed import ClosedSurface, net
from list3r.exporters.solids.completion import completed
from list3r.exporters.solids.convex import convex_parts
from list3r.exporters.solids.evidence import gather
from list3r.exporters.solids.solid import Solid, Surroundings, solid_of
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import Support
from list3r.memory.library.overlap.visibility import DepthView
from list3r.memory.store.store import Store
from list3r.simulation.walk import viewing_poses
from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.objects import SimulatedObject
from tests.conftest import box_points, instance, write_small_room
from tests.test_exporters_meshes import is_closed

casting = pytest.importorskip("benchmarks.simulation.casting", reason="the checkout's benchmarks are not here")
from list3r.frames.base import Camera  # noqa: E402

PLAIN = Material("plain", (180, 170, 160), (180, 170, 160), 1.0)
CAMERA = Camera(160, 120, 131.0, 131.0, 79.5, 59.5)
FLOOR = f.flat((6.0, 6.0, 0.1), (0, 0, -0.05), PLAIN)


def seen_thing(
    parts: f.Parts, *, around: float = 360.0, away: float = 1.6, eye: float = 1.5
) -> tuple[Solid, SimulatedObject]:
    """The solid of a thing on a floor, which a person filmed from so many degrees of a circle round it."""
    thing = SimulatedObject(2, "thing", parts, (0.0, 0.0, 0.0))
    caster = casting.Caster((SimulatedObject(1, "floor", FLOOR, (0, 0, 0), structure="floor"), thing), CAMERA)
    yaw = np.deg2rad(np.linspace(-around / 2, around / 2, 16, endpoint=False))
    box = thing.box()
    position = np.stack([-away * np.cos(yaw), -away * np.sin(yaw), np.full(16, eye)], axis=1)
    pitch = np.full(16, np.arctan2(box.center[2] - eye, away))
    views, clouds = [], []
    for n, T in enumerate(viewing_poses(position, yaw, pitch, np.zeros(16))):
        depth, ids = caster.cast(T)
        views.append(DepthView(1, n, Sim3.from_matrix(T).inverse(), 1.0, depth, (131.0, 131.0, 79.5, 59.5)))
        v, u = np.nonzero(ids == 2)
        z = depth[v, u].astype(float)
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], axis=1)
        clouds.append((rays * z[:, None]) @ T[:3, :3].T + T[:3, 3])
    points = np.concatenate(clouds).astype(np.float32)
    support = Support(points, np.ones(len(points), np.float32), np.full((len(points), 3), 120, np.uint8))
    record = instance(2, tuple(box.center), tuple(box.size), (120, 120, 120))
    solid = solid_of(record, Surroundings(support, np.zeros((0, 3)), views, 0.0, 1.0))
    assert solid is not None
    return solid, thing


def holds(parts: Sequence[ClosedSurface], points: Array) -> np.ndarray:
    """Which points lie in one of several convex parts."""
    out = np.zeros(len(points), bool)
    for part in parts:
        a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        out |= ((points[:, None] - a) * normal).sum(axis=2).max(axis=1) < 1e-12
    return out


def places(low: Sequence[float], high: Sequence[float], count: int = 400) -> Array:
    return np.random.default_rng(0).uniform(low, high, (count, 3))


def is_marked(solid: Solid) -> bool:
    """Whether each face of a closed mesh says if it was seen, and there are some of either kind."""
    faces = solid.mesh.surface.faces
    return is_closed(solid.mesh.surface) and solid.seen.shape == (len(faces),) and 0 < solid.seen.mean() < 1


def test_a_table_is_a_top_and_legs_with_free_space_under_it() -> None:
    solid, _ = seen_thing(f.table((1.2, 0.8, 0.74), PLAIN))
    assert is_marked(solid) and len(solid.parts) <= 32
    assert not holds(solid.parts, places((-0.45, -0.25, 0.02), (0.45, 0.25, 0.6))).any()
    assert holds(solid.parts, places((-0.55, -0.35, 0.72), (0.55, 0.35, 0.73))).mean() > 0.95
    legs = [holds(solid.parts, places((x, y, 0.1), (x, y, 0.6))).mean() for x in (-0.54, 0.54) for y in (-0.34, 0.34)]
    assert min(legs) > 0.9
    top = solid.mesh.surface.vertices[solid.mesh.surface.faces][solid.seen].mean(axis=1)
    assert (top[:, 2] > 0.01).all(), "nobody saw what stands on the floor"


def test_the_unseen_half_of_a_table_is_that_of_its_mirror() -> None:
    solid, _ = seen_thing(f.table((1.2, 0.8, 0.74), PLAIN), around=60.0)
    assert not holds(solid.parts, places((-0.35, -0.25, 0.02), (0.35, 0.25, 0.5))).any()
    assert holds(solid.parts, places((0.5, 0.3, 0.2), (0.56, 0.36, 0.5))).any(), "the far leg"


def test_an_open_basket_stays_open_and_a_box_is_full() -> None:
    basket, _ = seen_thing(f.basket(0.2, 0.26, PLAIN), away=1.0)
    assert is_marked(basket)
    assert not holds(basket.parts, places((-0.1, -0.1, 0.08), (0.1, 0.1, 0.3))).any()
    angle = np.linspace(0, 2 * np.pi, 60)
    ring = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), np.full(60, 0.15)], axis=1)
    assert holds(basket.parts, ring).mean() > 0.8, "its wall is there"
    carton, thing = seen_thing(f.carton((0.4, 0.3, 0.3), PLAIN, PLAIN), around=90.0)
    assert is_marked(carton)
    size = thing.box().size / 2 - 0.04
    assert holds(carton.parts, places((-size[0], -size[1], 0.02), (size[0], size[1], 0.26))).mean() > 0.9, (
        "nothing says that it is hollow"
    )


def test_a_chair_has_a_seat_and_nothing_before_its_back() -> None:
    solid, _ = seen_thing(f.chair(PLAIN, PLAIN))
    assert not holds(solid.parts, places((-0.15, -0.1, 0.52), (0.15, 0.2, 0.85))).any()
    assert holds(solid.parts, places((-0.15, -0.1, 0.43), (0.15, 0.15, 0.445))).mean() > 0.9


def test_nothing_fills_what_was_seen_through() -> None:
    solid, _ = seen_thing(f.shelf((0.8, 0.32, 1.3), PLAIN), away=2.0)
    assert not holds(solid.parts, places((-0.3, 0.0, 0.6), (0.3, 0.14, 0.7))).any()
    points = solid.mesh.surface.vertices
    evidence = gather(points, np.zeros((0, 3)), (), np.eye(3), 0.0, 1.0)
    evidence.free[:] = True
    assert not completed(evidence).any()


def test_a_net_around_cells_is_closed_and_near_them() -> None:
    cells = np.random.default_rng(1).random((9, 8, 7)) < 0.5
    surface, corners = net(cells)
    assert is_closed(surface) and len(corners) == len(surface.vertices)
    block, _ = net(np.ones((6, 5, 4), bool))
    assert block.volume() == pytest.approx(120, rel=0.12)
    assert np.abs(surface.vertices - (corners - 0.5)).max() <= 0.5


def test_a_model_for_mujoco_has_bodies_with_mass_on_fixed_structure(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    path = tmp_path / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
        store.connection.execute("DELETE FROM keyframes")  # their depth is of another room
    done: list[tuple[int, ...]] = []
    for density in (None, 400.0):
        with list3r.open(path) as memory:
            files = memory.export("mjcf", tmp_path / "sim", density=density, progress=lambda *n: done.append(n))
            boxes = {i.id: i.aabb for i in memory.instances()}
        model = mujoco.MjModel.from_xml_path(str(files[0]))
        things = {
            n: model.body(n) for n in range(1, model.nbody) if model.body(n).name.startswith(("mug", "chair", "table"))
        }
        assert done[-4:] == [(n + 1, 4) for n in range(4)]
        assert len(things) == 4 and model.njnt == (0 if density is None else 4)
    for n, body in things.items():
        size = np.ptp(boxes[int(body.name.rpartition("_")[2])], axis=0)
        assert body.mass[0] == pytest.approx(400 * np.prod(size), rel=0.5)
        assert (model.geom_contype[model.geom_bodyid == n] == 1).sum() <= 32
    data = mujoco.MjData(model)
    start = None
    for _ in range(1500):
        mujoco.mj_step(model, data)
        start = data.xpos.copy() if start is None else start
    assert np.linalg.norm(data.xpos - start, axis=1).max() < 0.2, "nothing explodes in 3 s"


def test_what_a_simulator_cannot_take_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
        store.facts.scale_kind = "relative"
    words = ["export", str(path), "--to", "mjcf", "--out", str(tmp_path / "sim")]
    for more, told in (([], "no metric scale"), (["--density", "-1"], "kilograms per cubic metre")):
        assert run([*words, *more]) == 2 and told in capsys.readouterr().err
    assert not (tmp_path / "sim").exists()


def test_a_skin_that_is_laid_flat_is_no_part_and_nothing_fails() -> None:
    solid = np.zeros((12, 12, 6), bool)
    solid[:, :, :3], solid[2:5, 2:5, 3:5] = True, True
    parts = convex_parts(solid, lambda cells: np.minimum(cells, [99, 99, 3]).astype(float))
    assert len(parts) == 1 and parts[0].volume() == pytest.approx(12 * 12 * 3)


def test_what_no_view_tells_about_is_closed_all_the_same() -> None:
    points = box_points((0, 0, 0.2), (0.3, 0.3, 0.4), 500, 1).astype(np.float32)
    support = Support(points, np.ones(500, np.float32), np.full((500, 3), 120, np.uint8))
    record = instance(2, (0, 0, 0.2), (0.3, 0.3, 0.4), (120, 120, 120))
    for tilt in (np.eye(3), np.array([[1, 0, 0], [0, 0, -1.0], [0, 1, 0]])):
        turned = replace(record, box=replace(record.box, rotation=tilt))
        for views in (
            (),
            (DepthView(1, 0, Sim3.identity(), 1.0, np.ones((12, 16), np.float32), (9.0, 9.0, 8.0, 6.0)),),
        ):
            solid = solid_of(turned, Surroundings(support, points.astype(float), views, 0.0, 1.0))
            assert solid is not None and solid.parts and is_closed(solid.mesh.surface)
