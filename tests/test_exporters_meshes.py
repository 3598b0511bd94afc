"""Meshes of instances: closed, outward, near the points; in USD stages, and as props for simulators."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.exporters.meshes.closed import ClosedSurface, divided, hull, net, slab, zero_level
from list3r.exporters.meshes.instance_mesh import instance_mesh
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Observation
from list3r.memory.store.store import Store
from tests.conftest import box_points, chunk_result, instance, local_instance, write_small_room

pxr = pytest.importorskip("pxr")
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade  # noqa: E402

from list3r.exporters.simready.assembly import SimreadySettings, write_simready  # noqa: E402

TABLE, MUG, WALL = 2, 3, 6


def test_the_zero_level_of_a_ball_is_closed_and_as_large() -> None:
    away = np.sqrt(((np.indices((20, 20, 20)) - 9.5) ** 2).sum(axis=0))
    ball = zero_level(7.0 - away)
    assert is_closed(ball) and ball.volume() == pytest.approx(4 / 3 * np.pi * 343, rel=0.03)
    outward = ball.vertices - 9.5
    assert (np.einsum("ij,ij->i", ball.normals(), outward) > 0.8 * np.linalg.norm(outward, axis=1)).all()
    noise = zero_level(np.pad(np.random.default_rng(1).normal(size=(9, 9, 9)), 1, constant_values=-1.0))
    assert is_closed(noise) and noise.volume() > 0


def test_a_hull_that_is_divided_stays_what_it_is() -> None:
    box = hull(np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], float))
    fine = divided(box, 0.5)
    assert is_closed(box) and is_closed(fine) and len(fine.faces) > 10 * len(box.faces)
    assert box.volume() == pytest.approx(6.0) and fine.volume() == pytest.approx(6.0)
    assert not is_closed(ClosedSurface(box.vertices, box.faces[1:]))


def test_a_slab_with_holes_and_corners_is_closed() -> None:
    cells = np.random.default_rng(2).random((12, 17)) < 0.6
    plate = slab(cells)
    assert is_closed(plate) and cells.sum() <= round(plate.volume()) <= cells.sum() + 60


def memory_of(path: Path, *clouds: np.ndarray, **more: object) -> Path:
    """A memory with an instance for each cloud."""
    with Store.create(path) as store, store.transaction():
        local = tuple(
            local_instance(k, c.astype(np.float32), (200, 80, 40), np.arange(5)) for k, c in enumerate(clouds)
        )
        session = store.sessions.add("walk", "abc", {}, 5)
        chunk = store.chunks.add(session, chunk_result(0, 0, 5, local))
        store.chunks.place({chunk: Sim3.identity()}, {chunk: chunk})
        store.facts.scale_kind, store.facts.gravity = "metric", "known"
        for k, c in enumerate(clouds):
            low, high = c.min(axis=0), c.max(axis=0)
            box = instance(k + 1, tuple((low + high) / 2), tuple(high - low), (200, 80, 40), component=chunk, **more)
            store.instances.put([box])
        store.observations.set([Observation(k + 1, chunk, k) for k in range(len(clouds))])
    return path


def test_the_mesh_follows_what_is_there(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    box = box_points((0, 0, 0.5), (0.6, 0.4, 1.0), 3000, 4)
    seen = box[(box[:, 0] > -0.299) & (box[:, 1] > -0.199) & (box[:, 2] > 0.001)]  # from three sides
    table = np.concatenate(
        [
            rng.uniform((-0.6, -0.4, 0.72), (0.6, 0.4, 0.73), (4000, 3)),
            *(rng.uniform((x, y, 0), (x + 0.04, y + 0.04, 0.72), (400, 3)) for x in (-0.6, 0.56) for y in (-0.4, 0.36)),
        ]
    )
    with list3r.open(memory_of(tmp_path / "m.l3r", seen, table, seen[:5])) as memory:
        whole, legs = (instance_mesh(memory.store, memory.instance(k)) for k in (1, 2))
        assert instance_mesh(memory.store, memory.instance(3)) is None, "five points are no surface"
    assert whole is not None and legs is not None
    assert (whole.kind, legs.kind) == ("hull", "reconstructed")
    assert is_closed(whole.surface) and is_closed(legs.surface)
    assert whole.surface.volume() == pytest.approx(0.24 * 5 / 6, rel=0.1), "nobody saw the corner behind"
    assert legs.surface.volume() < 0.2 * 1.2 * 0.8 * 0.73, "a table is no block"
    np.testing.assert_array_equal(whole.rgb[0], (200, 80, 40))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("meshes") / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    return path


def test_a_stage_with_meshes_is_sound(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        memory.export("usd", tmp_path / "room.usdc", colliders=True)
    stage = Usd.Stage.Open(str(tmp_path / "room.usdc"))
    for path, fixed in (("/World/Instances/instance_2", False), ("/World/Structure/instance_6", True)):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"{path}/mesh"))
        assert UsdGeom.Mesh.ValidateTopology(
            mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), len(mesh.GetPointsAttr().Get())
        )
        assert len(mesh.GetNormalsAttr().Get()) == len(mesh.GetPointsAttr().Get())
        assert mesh.GetPrim().GetAttribute("list3r:surface").Get() == ("slab" if fixed else "solid")
        parts = stage.GetPrimAtPath(f"{path}/colliders").GetChildren() if not fixed else [mesh.GetPrim()]
        shapes = [UsdPhysics.MeshCollisionAPI(p).GetApproximationAttr().Get() for p in parts]
        assert shapes and set(shapes) == {"none" if fixed else "convexHull"}
        assert fixed != UsdGeom.PrimvarsAPI(mesh).HasPrimvar("list3r:seen"), "each face says whether it was seen"
        assert UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
        points = UsdGeom.Imageable(stage.GetPrimAtPath(f"{path}/points"))
        assert points.ComputeVisibility() == UsdGeom.Tokens.invisible
    check = pytest.importorskip("pxr.UsdValidation")
    context = check.ValidationContext(check.ValidationRegistry().GetOrLoadAllValidators())
    assert [e for e in context.Validate(stage) if e.GetType() == check.ValidationErrorType.Error] == []


def test_props_stand_on_their_base_and_the_scene_puts_them_back(room: Path, tmp_path: Path) -> None:
    with list3r.open(room) as memory:
        memory.export("simready", tmp_path / "sim", density=400.0)
        boxes = {i.id: i.aabb for i in memory.instances()}
    props = sorted(p.name for p in (tmp_path / "sim").iterdir() if p.is_dir())
    assert props == ["chair_5", "mug_3", "mug_4", "table_2"]
    for name in props:
        file = tmp_path / "sim" / name / "simready_usd" / f"{name}.usd"
        assert (file.parent / ".thumbs/256x256" / f"{name}.usd.png").is_file()
        stage = Usd.Stage.Open(str(file))
        root = stage.GetDefaultPrim()
        low, high = np.array(UsdGeom.Mesh(root.GetChild("mesh")).GetExtentAttr().Get())
        assert low[2] == pytest.approx(0, abs=1e-6) and low[:2] == pytest.approx(-high[:2], abs=1e-6)
        told = stage.GetRootLayer().customLayerData["SimReady_Metadata"]
        mass = UsdPhysics.MassAPI(root).GetMassAttr().Get()
        assert told["mass"] == pytest.approx(mass) and mass == pytest.approx(400 * np.prod(high - low), rel=0.15)
        assert root.GetAttribute("list3r:mass:estimated").Get() is True
    scene = Usd.Stage.Open(str(tmp_path / "sim/scene.usdc"))
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
    for name in props:
        placed = cache.ComputeWorldBound(scene.GetPrimAtPath(f"/World/Props/{name}")).ComputeAlignedRange()
        np.testing.assert_allclose([placed.GetMin(), placed.GetMax()], boxes[int(name.rsplit("_", 1)[1])], atol=0.03)
    assert scene.GetPrimAtPath("/World/Structure/instance_6/mesh")


def test_nothing_is_made_up(room: Path, tmp_path: Path, make_memory: Callable[..., Path]) -> None:
    with list3r.open(room) as memory:
        memory.export("simready", tmp_path / "sim")
    stage = Usd.Stage.Open(str(tmp_path / "sim/mug_3/simready_usd/mug_3.usd"))
    root = stage.GetDefaultPrim()
    assert not root.HasAPI(UsdPhysics.RigidBodyAPI) and not root.HasAPI(UsdPhysics.MassAPI)
    assert "mass" not in stage.GetRootLayer().customLayerData["SimReady_Metadata"]
    path = make_memory("relative.l3r")
    with Store.open(path, writable=True) as store, store.transaction():
        store.facts.scale_kind = "relative"
    with list3r.open(path) as memory, pytest.raises(OptionError, match="no metric scale"):
        memory.export("simready", tmp_path / "other")
    assert run(["export", str(room), "--to", "simready", "--out", str(tmp_path / "d"), "--density", "-3"]) == 2
    assert not (tmp_path / "d").exists()


def test_only_the_things_that_are_asked_for(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["export", str(room), "--to", "simready", "--out", str(tmp_path / "some")]
    assert run([*words, "--ids", "3, 5"]) == 0
    assert {p.name for p in (tmp_path / "some").iterdir() if p.is_dir()} == {"mug_3", "chair_5"}
    for ids, told in (("1", "#1: structure"), ("99", "99"), ("3;5", "such as 3,7,12")):
        capsys.readouterr()
        assert run([*words[:-1], str(tmp_path / "none"), "--ids", ids]) == 2
        assert told in capsys.readouterr().err and not (tmp_path / "none").exists()


@pytest.mark.slow
def test_many_props_are_told_and_share_folders_and_processes_change_nothing(room: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    with list3r.open(room) as memory:
        write_simready(memory.store, tmp_path / "few", SimreadySettings(density=300.0))
        for workers in (0, 2):
            settings = SimreadySettings(300.0, workers=workers, progress=lambda *n: told.append(n), one_folder=2)
            write_simready(memory.store, tmp_path / str(workers), settings)
    assert told == [(4, 4), (4, 4)]
    few, alone, both = (tmp_path / name for name in ("few", "0", "2"))
    assert {p.name for p in alone.iterdir() if p.is_dir()} == {"from_0"}
    for file in (few / "mug_3").rglob("*.*"):
        if file.is_file():
            beside = "from_0" / file.relative_to(few)
            assert file.read_bytes() == (alone / beside).read_bytes() == (both / beside).read_bytes()
    placed = [Usd.Stage.Open(str(folder / "scene.usdc")).ExportToString() for folder in (few, alone, both)]
    assert placed[0].count('def Mesh "mesh"') == 6
    assert len({text.replace(str(f), "") for text, f in zip(placed[1:], (alone, both), strict=True)}) == 1
    assert run(["export", str(room), "--to", "simready", "--out", str(tmp_path / "d"), "--workers", "-1"]) == 2


def test_names_of_props_are_plain(tmp_path: Path) -> None:
    cloud = box_points((0, 0, 0), (1, 1, 1), 300, 5)
    with list3r.open(memory_of(tmp_path / "m.l3r", cloud, label="Écran plat <3")) as memory:
        memory.export("simready", tmp_path / "sim", density=1.0)
    assert (tmp_path / "sim/ecran_plat_3_1/simready_usd/ecran_plat_3_1.usd").is_file()
    assert json.loads((tmp_path / "sim/list3r-simready.json").read_text())["format"] == "list3r-simready"


def is_closed(surface: ClosedSurface) -> bool:
    """Tell whether each edge has one face on either side, which run through it in opposite directions."""
    edges = np.concatenate([surface.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    if not len(edges) or len(np.unique(edges, axis=0)) != len(edges):
        return False
    key = edges[:, 0] * len(surface.vertices) + edges[:, 1]
    return bool(np.isin(edges[:, 1] * len(surface.vertices) + edges[:, 0], key).all())


def test_cells_that_touch_at_a_corner_have_a_vertex_each_there() -> None:
    cells = np.zeros((2, 2, 2), bool)
    cells[0, 0, 0] = cells[1, 1, 1] = True
    surface, corners = net(cells)
    assert len(surface.vertices) == len(corners) == 16
    assert (corners == (1, 1, 1)).all(axis=1).sum() == 2
    assert np.bincount(surface.faces.ravel()).min() >= 3
