"""The USD stage, opened again and held against the store."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr")
from pxr import Gf, Usd, UsdGeom, UsdUtils

from list3r.exporters.palette import linear_from_srgb
from list3r.exporters.usd.labels import class_token
from list3r.exporters.usd.mesh import set_vertex_colors
from list3r.exporters.usd.stage import UsdSettings, usd_stage, write_usd
from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from tests.conftest import instance
from tests.test_exporters import write_split_memory


@pytest.fixture
def room(make_memory: Callable[..., Path]) -> Store:
    """The small room, open."""
    return Store.open(make_memory())


@pytest.fixture
def stage(room: Store, tmp_path: Path) -> Usd.Stage:
    """Its stage, read from disk."""
    write_usd(room, tmp_path / "room.usdc")
    return Usd.Stage.Open(str(tmp_path / "room.usdc"))


def local_to_world(prim: Usd.Prim, time: float | None = None) -> np.ndarray:
    """Column-vector matrix of a prim. Shape (4, 4)."""
    code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    return np.array(UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(code)).T


def world_points(prim: Usd.Prim) -> np.ndarray:
    """Points of a prim in the world. Shape (N, 3)."""
    points = np.array(UsdGeom.Points(prim).GetPointsAttr().Get())
    T_world_prim = local_to_world(prim)
    return points @ T_world_prim[:3, :3].T + T_world_prim[:3, 3]


def test_the_stage_says_what_it_is(stage: Usd.Stage) -> None:
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert stage.HasAuthoredMetadata("metersPerUnit")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetMetadata("kilogramsPerUnit") == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 19, 30)
    assert dict(stage.GetRootLayer().customLayerData)["list3r"]["units"] == "m"


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd", ".usdz"])
def test_every_suffix_opens_with_the_same_prims(suffix: str, room: Store, tmp_path: Path, stage: Usd.Stage) -> None:
    write_usd(room, tmp_path / f"again{suffix}")
    again = Usd.Stage.Open(str(tmp_path / f"again{suffix}"))
    assert [p.GetPath() for p in again.Traverse()] == [p.GetPath() for p in stage.Traverse()]
    assert (tmp_path / "again.usda").exists() == (suffix == ".usda")


def test_usdas_are_text(room: Store, tmp_path: Path) -> None:
    write_usd(room, tmp_path / "room.usda")
    assert (tmp_path / "room.usda").read_bytes().startswith(b"#usda 1.0")


def test_points_lie_where_the_store_has_them(stage: Usd.Stage, room: Store) -> None:
    for thing in room.instances.all():
        group = "Structure" if thing.structure else "Instances"
        prim = stage.GetPrimAtPath(f"/World/{group}/instance_{thing.id}/points")
        support = room.surfaces.of(thing.id)
        assert np.allclose(world_points(prim), support.points, atol=1e-5)
        primvar = UsdGeom.Points(prim).GetDisplayColorPrimvar()
        colors = np.array(primvar.ComputeFlattened())
        assert len(primvar.Get()) == len(np.unique(support.rgb, axis=0)) and primvar.IsIndexed()
        assert np.allclose(colors, linear_from_srgb(support.rgb), atol=1e-6)


def test_turned_and_scaled_points_and_boxes(tmp_path: Path) -> None:
    with Store.open(write_split_memory(tmp_path / "split.l3r")) as store:
        stage, box, support = usd_stage(store), store.instances.get(2).box, store.surfaces.of(2)
    prim = stage.GetPrimAtPath("/World/Instances/instance_2")
    assert np.allclose(world_points(prim.GetChild("points")), support.points, atol=1e-5)
    unit = np.array([[i, j, k, 1.0] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
    assert np.allclose((unit @ local_to_world(prim.GetChild("box")).T)[:, :3], box.corners(), atol=1e-9)
    assert UsdGeom.Cube(prim.GetChild("box")).GetPurposeAttr().Get() == UsdGeom.Tokens.guide


def test_extents_hold_the_points(stage: Usd.Stage, room: Store) -> None:
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    for id in (2, 3):
        prim = stage.GetPrimAtPath(f"/World/Instances/instance_{id}")
        assert prim.GetChild("points").GetAttribute("extent").HasAuthoredValue()
        width = UsdGeom.Points(prim.GetChild("points")).GetWidthsAttr().Get()[0]
        bound = cache.ComputeWorldBound(prim).ComputeAlignedRange()
        points = room.surfaces.of(id).points
        assert np.allclose(bound.GetMin(), points.min(axis=0) - width / 2, atol=1e-5)
        assert np.allclose(bound.GetMax(), points.max(axis=0) + width / 2, atol=1e-5)
        assert 0.1 < width / np.sqrt(_surface(room.instances.get(id).box.size) / len(points)) < 3.0


def _surface(size: np.ndarray) -> float:
    a, b, c = size
    return float(2 * (a * b + b * c + a * c))


def test_widths_are_those_of_the_points(stage: Usd.Stage) -> None:
    for prim in (p for p in stage.Traverse() if p.IsA(UsdGeom.Points)):
        points = UsdGeom.Points(prim)
        assert points.GetWidthsInterpolation() == UsdGeom.Tokens.vertex
        assert len(points.GetWidthsAttr().Get()) == len(points.GetPointsAttr().Get())


def test_colours_that_do_not_repeat_have_no_indices(tmp_path: Path) -> None:
    shades = np.arange(30, dtype=np.uint8).reshape(10, 3)
    stage = Usd.Stage.CreateInMemory()
    prim = UsdGeom.Points.Define(stage, "/p")
    set_vertex_colors(prim, shades)
    assert not prim.GetDisplayColorPrimvar().IsIndexed()
    assert np.allclose(np.array(prim.GetDisplayColorPrimvar().Get()), linear_from_srgb(shades), atol=1e-6)


def test_things_are_documented_and_known_classes_are_coco(room: Store, tmp_path: Path) -> None:
    named = replace(instance(9, (1.0, 1.0, 1.0), (0.1, 0.1, 0.1), (9, 9, 9)), label="Potted plant")
    with Store.create(tmp_path / "named.l3r") as store, store.transaction():
        store.instances.put([named])
        stage = usd_stage(store)
        plant = stage.GetPrimAtPath("/World/Instances/instance_9")
        assert plant.GetAttribute("semantics:labels:coco").Get() == ["potted plant"]
    stage = usd_stage(room)
    mug = stage.GetPrimAtPath("/World/Instances/instance_3")
    assert mug.GetDocumentation() == "mug" and not mug.GetAttribute("semantics:labels:coco")


def test_points_are_thinned_to_the_cap(room: Store) -> None:
    stage = usd_stage(room, UsdSettings(points_per_instance=100, points_per_structure=0))
    assert len(UsdGeom.Points.Get(stage, "/World/Instances/instance_2/points").GetPointsAttr().Get()) == 100
    assert not stage.GetPrimAtPath("/World/Structure/instance_1/points")
    with pytest.raises(OptionError):
        UsdSettings(points_per_instance=-1)


def test_relations_are_relationships(stage: Usd.Stage) -> None:
    mug = stage.GetPrimAtPath("/World/Instances/instance_3")
    assert mug.GetRelationship("list3r:relation:on").GetTargets() == ["/World/Instances/instance_2"]
    assert list(mug.GetAttribute("list3r:relation:on:confidence").Get()) == [0.95]
    assert list(mug.GetAttribute("list3r:relation:on:margin").Get()) == [0.02]
    table = stage.GetPrimAtPath("/World/Instances/instance_2")
    assert table.GetRelationship("list3r:relation:on").GetTargets() == ["/World/Structure/instance_1"]


def test_facts_and_labels(stage: Usd.Stage, monkeypatch: pytest.MonkeyPatch, room: Store) -> None:
    mug = stage.GetPrimAtPath("/World/Instances/instance_3")
    assert mug.GetAttribute("list3r:id").Get() == 3
    assert mug.GetAttribute("list3r:confidence").Get() == 0.9
    assert mug.GetAttribute("list3r:description").Get() == "mug"
    assert list(mug.GetAttribute("semantics:labels:class").Get()) == ["mug"]
    assert "SemanticsLabelsAPI:class" in mug.GetAppliedSchemas()
    monkeypatch.setitem(sys.modules, "pxr.UsdSemantics", None)
    monkeypatch.delattr("pxr.UsdSemantics", raising=False)
    old_build = usd_stage(room)
    by_hand = old_build.GetPrimAtPath("/World/Instances/instance_3")
    assert list(by_hand.GetAttribute("semantics:labels:class").Get()) == ["mug"]
    assert "SemanticsLabelsAPI:class" in str(by_hand.GetMetadata("apiSchemas"))


def test_every_thing_to_render_has_a_label(stage: Usd.Stage) -> None:
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Gprim):
            assert "SemanticsLabelsAPI:class" in prim.GetParent().GetAppliedSchemas()


@pytest.mark.parametrize(
    ("label", "description", "structure", "token"),
    [
        ("Coffee mug", "x", None, "coffee_mug"),
        (None, "small white cylinder, 9 cm", None, "small_white_cylinder"),
        (None, "large plane", "wall", "wall"),
        (None, "", None, "unknown"),
    ],
)
def test_class_token(label: str | None, description: str, structure: str | None, token: str) -> None:
    made = instance(1, (0, 0, 0), (1, 1, 1), (0, 0, 0), label=label, description=description, structure=structure)
    assert class_token(made) == token


def test_the_camera_goes_where_the_frames_went(stage: Usd.Stage, room: Store) -> None:
    prim = stage.GetPrimAtPath("/World/Camera")
    for frame, S_world_cam in room.trajectory.poses():
        T_world_usdcam = S_world_cam.as_matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])
        assert np.allclose(local_to_world(prim, frame.frame_index), T_world_usdcam, atol=1e-9)
        assert prim.GetAttribute("list3r:time").Get(frame.frame_index) == pytest.approx(frame.time_s)
    looking = local_to_world(prim, 0)[:3, :3] @ [0.0, 0.0, -1.0]
    assert np.allclose(looking, [1.0, 0.0, 0.0])


def test_the_lens_sees_what_the_pinhole_sees(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as store:
        stage = usd_stage(store)
        (chunk,) = store.chunks.all()
    fx, fy, cx, cy = chunk.intrinsics
    height, width = chunk.image_size
    frustum = UsdGeom.Camera.Get(stage, "/World/Camera").GetCamera(Usd.TimeCode(0)).frustum
    frustum = Gf.Frustum(Gf.Vec3d(0), Gf.Rotation(), frustum.window, frustum.nearFar, frustum.projectionType)
    for x, y, z in ((0.1, -0.2, 1.0), (-0.5, 0.3, 2.0)):
        ndc = frustum.ComputeProjectionMatrix().Transform(Gf.Vec3d(x, -y, -z))
        pixel = (ndc[0] + 1) / 2 * width - 0.5, (1 - ndc[1]) / 2 * height - 0.5
        assert np.allclose(pixel, (fx * x / z + cx, fy * y / z + cy), atol=1e-4)


def test_another_component_is_apart_and_invisible(tmp_path: Path) -> None:
    with Store.open(write_split_memory(tmp_path / "split.l3r")) as store:
        stage = usd_stage(store)
    apart = stage.GetPrimAtPath("/World/component_1")
    assert UsdGeom.Imageable(apart).ComputeVisibility() == UsdGeom.Tokens.invisible
    assert stage.GetPrimAtPath("/World/component_1/Instances/instance_1/points")
    assert stage.GetPrimAtPath("/World/component_1/Camera")
    assert "not placed" in apart.GetCustomDataByKey("list3r")["note"]
    facts = stage.GetPrimAtPath("/World").GetCustomDataByKey("list3r")
    assert "not metres" in facts["note"]
    assert facts["gravity"] == "unknown"
    lonely = stage.GetPrimAtPath("/World/Instances/instance_3")
    assert [p.GetName() for p in lonely.GetChildren()] == ["box"]
    assert lonely.GetRelationship("list3r:relation:next_to_").GetTargets() == ["/World/Instances/instance_2"]


def test_the_validators_of_usd_find_nothing(tmp_path: Path, make_memory: Callable[..., Path]) -> None:
    paths = [make_memory(), write_split_memory(tmp_path / "split.l3r")]
    for path in paths:
        with Store.open(path) as store:
            write_usd(store, path.with_suffix(".usdc"))
        stage = Usd.Stage.Open(str(path.with_suffix(".usdc")))
        assert _complaints(stage, path.with_suffix(".usdc")) == []


def _complaints(stage: Usd.Stage, path: Path) -> list[str]:
    try:
        from pxr import UsdValidation
    except ImportError:
        checker = UsdUtils.ComplianceChecker()
        checker.CheckCompliance(str(path))
        return [*checker.GetErrors(), *checker.GetFailedChecks()]
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return [e.GetMessage() for e in UsdValidation.ValidationContext(validators).Validate(stage)]
