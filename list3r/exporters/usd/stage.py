"""Write the memory as an OpenUSD stage: a prim for each instance, relations between prims, the camera path."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from list3r.exporters.components import Component, has_box, point_spacing, read_components, thinned_support
from list3r.exporters.meshes.instance_mesh import InstanceMesh, instance_mesh
from list3r.exporters.output import replacing, units
from list3r.exporters.palette import instance_color, linear_from_srgb
from list3r.exporters.solids.solid import Solids
from list3r.exporters.usd.camera import add_cameras, set_time_range
from list3r.exporters.usd.labels import class_token, set_labels
from list3r.exporters.usd.mesh import add_collider, add_mesh, add_solid, add_vertex_material, bind, set_vertex_colors
from list3r.memory.core.errors import ExportError, OptionError
from list3r.memory.core.geometry import Sim3, quat_wxyz_from_rotation
from list3r.memory.core.records import Instance, Support
from list3r.memory.library.rooms.naming import named_rooms, title
from list3r.memory.store.store import Store
from list3r.queries.views.dense import instance_surface


@dataclass(frozen=True)
class UsdSettings:
    """Content of the stage."""

    points_per_instance: int = 5000
    """At most this many points of an instance."""
    points_per_structure: int = 20000
    """At most this many points of a floor, a wall and the like."""
    mesh: bool = False
    """Whether instances and structure have a mesh too, as it was seen or, to collide, closed; their points are then
    invisible."""
    colliders: bool = False
    """Whether meshes collide, structure as it is and instances by the convex parts of their solids; asks for meshes."""
    progress: Callable[[int, int], None] | None = None
    """Called with how many of the instances are done, and how many there are."""

    def __post_init__(self) -> None:
        if min(self.points_per_instance, self.points_per_structure) < 0:
            raise OptionError("a number of points cannot be negative; 0 leaves the points out")


_OUTLINE_WIDTH = 0.02
"""Of the outlines of rooms."""
_TOGETHER, _SOLIDS_TOGETHER = 200, 8
"""Instances that are added at once; solids take a second each."""


def write_usd(store: Store, path: str | Path, settings: UsdSettings | None = None) -> tuple[Path, ...]:
    """Write `usd_stage` to a .usdc, .usd (the same, binary), .usda (text) or .usdz file (a package of one .usdc).
    Returns the file written.
    """
    path = Path(path)
    with replacing(path) as temporary:
        stage = usd_stage(store, settings)
        with errors_of_disk(path):
            saved = _save(stage, temporary, path.stem)
        if not saved:
            raise ExportError(f"{path} cannot be written; is the disk full?")
    return (path,)


@contextlib.contextmanager
def errors_of_disk(path: Path) -> Iterator[None]:
    """Raise `ExportError` for failures of USD."""
    try:
        yield
    except Tf.ErrorException as error:
        raise ExportError(f"{path} cannot be written; is the disk full?") from error


def _save(stage: Usd.Stage, path: Path, name: str) -> bool:
    if path.suffix.lower() != ".usdz":
        return bool(stage.GetRootLayer().Export(str(path)))
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / f"{Tf.MakeValidIdentifier(name)}.usdc"
        if not stage.GetRootLayer().Export(str(layer)):
            return False
        path.unlink(missing_ok=True)
        return bool(UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(path)))


def usd_stage(store: Store, settings: UsdSettings | None = None) -> Usd.Stage:
    """Build stage in memory: z up, metersPerUnit 1 (arbitrary units in a relative memory, `customLayerData` says so).

    `/World/Instances/instance_12` is the box's own frame (translate, orient), with the points in it and the box as a
    guide; a moving instance has a sample of its translation for each frame that saw it. Floor, walls and the like are
    under `/World/Structure`; time codes are frame numbers of the source. `/World/Building/floor_0/room_3` has the
    outline of a room, and relationships to its instances (`list3r:instances`) and to the rooms that doorways lead to
    (`list3r:doorways`). Another component is under `/World/component_7`, invisible, so that it is not overlaid.
    """
    settings = settings or UsdSettings()
    components = read_components(store)
    stage = Usd.Stage.CreateInMemory()
    world = _prepare(stage, store)
    paths: dict[int, Sdf.Path] = {}
    solids = Solids(store) if settings.colliders else None
    together = _TOGETHER if solids is None else _SOLIDS_TOGETHER
    for component in components:
        scope = world if component.main else _component_scope(stage, component)
        for start in range(0, len(component.instances), together):
            several = component.instances[start : start + together]
            paths |= _add_together(stage, scope.GetPath(), several, store, settings, solids)
            if settings.progress is not None:
                settings.progress(len(paths), sum(len(c.instances) for c in components))
        add_cameras(stage, scope.GetPath(), component)
        if component.id == min(c.id for c in components):
            _add_rooms(stage, scope.GetPath(), store, paths)
    set_time_range(stage, components, store)
    _add_relations(stage, store, paths)
    return stage


def _prepare(stage: Usd.Stage, store: Store) -> Usd.Prim:
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetMetadata("kilogramsPerUnit", 1.0)
    world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
    Usd.ModelAPI(world).SetKind("assembly")
    stage.SetDefaultPrim(world)
    facts = {
        "format": "list3r-usd",
        "version": 1,
        "units": units(store),
        "metric": str(store.facts.scale_kind or "relative"),
        "gravity": store.facts.gravity,
    }
    if facts["units"] != "m":
        kind = facts["metric"]
        facts["note"] = f"the scale of this memory is {kind}: metersPerUnit 1 is nominal, lengths are not metres"
    if facts["gravity"] == "unknown":
        facts["gravityNote"] = "the direction of gravity is unknown: upAxis Z is nominal"
    stage.GetRootLayer().customLayerData = {"list3r": facts}
    world.SetCustomDataByKey("list3r", facts)
    return world


def _add_rooms(stage: Usd.Stage, scope: Sdf.Path, store: Store, paths: dict[int, Sdf.Path]) -> None:
    """Add building, floors and rooms; instances stay where they are and are what a room's relationship points to."""
    rooms, where = named_rooms(store), {}
    for room in rooms:
        building = _group(stage, scope.AppendChild("Building"))
        floor = _group(stage, building.AppendChild(f"floor_{room.floor}"))
        where[room.id] = floor.AppendChild(f"room_{room.id}")
        prim = UsdGeom.Xform.Define(stage, where[room.id]).GetPrim()
        prim.SetDisplayName(title(room))
        facts = {"room": room.id, "name": room.name or "", "reason": room.reason, "area": room.area}
        prim.SetCustomDataByKey("list3r", facts | ({"partial": room.partial} if room.partial else {}))
        inside = prim.CreateRelationship("list3r:instances", custom=True)
        inside.SetTargets([paths[n] for n in room.instances if n in paths])
        curve = UsdGeom.BasisCurves.Define(stage, where[room.id].AppendChild("outline"))
        curve.CreateTypeAttr(UsdGeom.Tokens.linear)
        curve.CreateWrapAttr(UsdGeom.Tokens.periodic)
        corners = np.column_stack([room.outline, np.full(len(room.outline), room.floor_z)]).astype(np.float32)
        curve.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners))
        curve.CreateCurveVertexCountsAttr([len(corners)])
        curve.CreateWidthsAttr([_OUTLINE_WIDTH])
        curve.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        curve.CreateExtentAttr(UsdGeom.Curves.ComputeExtent(curve.GetPointsAttr().Get(), [_OUTLINE_WIDTH]))
        curve.CreatePurposeAttr(UsdGeom.Tokens.guide)
    for n, path in where.items():
        others = sorted({d.b if d.a == n else d.a for d in store.rooms.doorways() if n in (d.a, d.b)})
        doors = stage.GetPrimAtPath(path).CreateRelationship("list3r:doorways", custom=True)
        doors.SetTargets([where[k] for k in others])


def _component_scope(stage: Usd.Stage, component: Component) -> Usd.Prim:
    prim = UsdGeom.Xform.Define(stage, f"/World/{component.name}").GetPrim()
    UsdGeom.Imageable(prim).MakeInvisible()
    note = "not placed against the main component: its coordinates are its own, so it is invisible"
    prim.SetCustomDataByKey("list3r", {"component": component.id, "note": note})
    return prim


# ---------------------------------------------------------------------------------------------- instances


def _add_together(
    stage: Usd.Stage,
    scope: Sdf.Path,
    instances: Sequence[Instance],
    store: Store,
    settings: UsdSettings,
    solids: Solids | None,
) -> dict[int, Sdf.Path]:
    """Add instances through a stage of their own; return their paths. The cost of each edit grows with the size of its
    stage.
    """
    part = Usd.Stage.CreateInMemory()
    UsdGeom.Xform.Define(part, scope)
    paths = {instance.id: _add(part, scope, instance, store, settings, solids) for instance in instances}
    with Sdf.ChangeBlock():
        _take_over(part.GetRootLayer(), stage.GetRootLayer(), Sdf.Path("/World"))
    return paths


def _take_over(part: Sdf.Layer, layer: Sdf.Layer, path: Sdf.Path) -> None:
    """Copy the prims under a path in one layer into another; existing ones stay."""
    for spec in part.GetPrimAtPath(path).nameChildren:
        if layer.GetPrimAtPath(spec.path):
            _take_over(part, layer, spec.path)
        else:
            Sdf.CopySpec(part, spec.path, layer, spec.path)


def _add(
    stage: Usd.Stage,
    scope: Sdf.Path,
    instance: Instance,
    store: Store,
    settings: UsdSettings,
    solids: Solids | None,
) -> Sdf.Path:
    """Add an instance with its points or mesh, and its motion; return its path."""
    limit = settings.points_per_structure if instance.structure else settings.points_per_instance
    path = _add_instance(stage, scope, instance, thinned_support(store, instance, limit))
    if settings.mesh or settings.colliders:
        _add_surface(stage, path, instance, store, solids)
    if instance.dynamic and has_box(instance):
        _animate(stage.GetPrimAtPath(path), instance, store)
    return path


def _add_instance(stage: Usd.Stage, scope: Sdf.Path, instance: Instance, support: Support) -> Sdf.Path:
    group = _group(stage, scope.AppendChild("Structure" if instance.structure else "Instances"))
    path = group.AppendChild(f"instance_{instance.id}")
    xform = UsdGeom.Xform.Define(stage, path)
    prim = xform.GetPrim()
    Usd.ModelAPI(prim).SetKind("component")
    prim.SetDisplayName(f"{instance.label or instance.description or instance.structure or 'object'} #{instance.id}")
    set_labels(prim, instance)
    prim.SetDocumentation(instance.description or class_token(instance))
    _set_facts(prim, instance)
    T_world_object = Sim3.identity()
    if has_box(instance):
        box = instance.box
        T_world_object = Sim3(np.ones(()), box.rotation, box.center)
        xform.AddTranslateOp().Set(Gf.Vec3d(*box.center.tolist()))
        w, x, y, z = quat_wxyz_from_rotation(box.rotation).tolist()
        xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
        _add_box(stage, path, instance)
    if len(support.points):
        _add_points(stage, path, T_world_object.inverse().apply(support.points), support.rgb)
    return path


def _group(stage: Usd.Stage, path: Sdf.Path) -> Sdf.Path:
    """Return the path of a group, made at its first instance: a kind that is set again composes all below it again."""
    if not stage.GetPrimAtPath(path):
        Usd.ModelAPI(UsdGeom.Xform.Define(stage, path).GetPrim()).SetKind("group")
    return path


def _add_surface(stage: Usd.Stage, path: Sdf.Path, instance: Instance, store: Store, solids: Solids | None) -> None:
    """Add the mesh of an instance in place of its points, where its support allows one; with `solids` it collides."""
    box = instance.box
    T_world_object = Sim3(np.ones(()), box.rotation, box.center) if has_box(instance) else Sim3.identity()
    if solids is not None and instance.structure is None:
        solid = solids.of(instance)
        prim = None if solid is None else add_solid(stage, path, solid, T_world_object)
    else:
        seen = instance_surface(store, instance.id) if solids is None else None
        mesh = instance_mesh(store, instance) if seen is None else InstanceMesh.seen(seen)
        prim = None if mesh is None else add_mesh(stage, path.AppendChild("mesh"), mesh, T_world_object)
        if prim is not None and solids is not None:
            add_collider(prim, fixed=True)
    if prim is None:
        return
    looks = UsdGeom.Scope.Define(stage, "/World/Looks").GetPath().AppendChild("seen")
    material = UsdShade.Material.Get(stage, looks) or add_vertex_material(stage, looks)
    bind(prim.GetPrim(), material)
    points = stage.GetPrimAtPath(path.AppendChild("points"))
    if points:
        UsdGeom.Imageable(points).MakeInvisible()


def _animate(prim: Usd.Prim, instance: Instance, store: Store) -> None:
    """Add samples of a moving instance's place, as it is turned where it was last; time codes are frame numbers."""
    keys, _, places = store.tracks.frames(instance.id)
    if not len(keys):
        return
    translate = UsdGeom.Xformable(prim).GetOrderedXformOps()[0]
    for (_, frame), place in zip(keys.tolist(), instance.box.center + places - places[-1], strict=True):
        if np.isfinite(place).all():
            translate.Set(Gf.Vec3d(*place.tolist()), frame)


def _add_box(stage: Usd.Stage, path: Sdf.Path, instance: Instance) -> None:
    cube = UsdGeom.Cube.Define(stage, path.AppendChild("box"))
    cube.CreateSizeAttr(1.0)
    cube.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
    cube.CreatePurposeAttr(UsdGeom.Tokens.guide)
    cube.CreateDisplayColorAttr([Gf.Vec3f(*linear_from_srgb(instance_color(instance.id)).tolist())])
    cube.CreateDisplayOpacityAttr([0.25])
    cube.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*instance.box.size.tolist()))


def _add_points(stage: Usd.Stage, path: Sdf.Path, points_object: NDArray[np.float64], rgb: NDArray[np.uint8]) -> None:
    points = np.ascontiguousarray(points_object, dtype=np.float32)
    width = point_spacing(points)
    prim = UsdGeom.Points.Define(stage, path.AppendChild("points"))
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateWidthsAttr(Vt.FloatArray(len(points), width))
    prim.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    low, high = points.min(axis=0) - width / 2, points.max(axis=0) + width / 2
    prim.CreateExtentAttr([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())])
    set_vertex_colors(prim, rgb)


_FACT_TYPES: dict[type, Any] = {
    int: Sdf.ValueTypeNames.Int,
    float: Sdf.ValueTypeNames.Double,
    str: Sdf.ValueTypeNames.String,
}


def _set_facts(prim: Usd.Prim, instance: Instance) -> None:
    facts: dict[str, int | float | str] = {
        "id": instance.id,
        "label": instance.label or "",
        "description": instance.description,
        "confidence": float(instance.confidence),
        "observations": instance.observations,
        "firstSeen": float(instance.first_seen_s),
        "lastSeen": float(instance.last_seen_s),
        "state": instance.state,
        "dynamic": int(instance.dynamic),
        "structure": instance.structure or "",
        "colorName": instance.color_name,
        "component": instance.component,
    }
    for name, value in facts.items():
        prim.CreateAttribute(f"list3r:{name}", _FACT_TYPES[type(value)], custom=True).Set(value)


# ---------------------------------------------------------------------------------------------- relations


def _add_relations(stage: Usd.Stage, store: Store, paths: dict[int, Sdf.Path]) -> None:
    """Add `list3r:relation:on` to subject, its targets the objects, with confidences and margins in the same order."""
    found: dict[tuple[int, str], list[tuple[Sdf.Path, float, float]]] = {}
    for r in store.relations.all():
        if r.subject in paths and r.object in paths:
            key = (r.subject, Tf.MakeValidIdentifier(r.predicate))
            found.setdefault(key, []).append((paths[r.object], r.confidence, r.margin))
    for (subject, predicate), entries in found.items():
        prim = stage.GetPrimAtPath(paths[subject])
        name = f"list3r:relation:{predicate}"
        prim.CreateRelationship(name, custom=True).SetTargets([target for target, _, _ in entries])
        for column, word in ((1, "confidence"), (2, "margin")):
            attribute = prim.CreateAttribute(f"{name}:{word}", Sdf.ValueTypeNames.DoubleArray, custom=True)
            attribute.Set([float(entry[column]) for entry in entries])
