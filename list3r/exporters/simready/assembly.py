"""Write each instance as a SimReady prop and a scene that puts them where they are."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from list3r.exporters.components import has_box, read_components
from list3r.exporters.meshes.instance_mesh import InstanceMesh, instance_mesh
from list3r.exporters.output import check_density, check_metre, replacing_folder
from list3r.exporters.simready.processes import Making, write_props
from list3r.exporters.simready.prop import Prop, PropFacts
from list3r.exporters.usd.labels import set_labels
from list3r.exporters.usd.mesh import add_collider, add_mesh, add_vertex_material, bind
from list3r.exporters.usd.stage import errors_of_disk
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3, quat_wxyz_from_rotation
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store


@dataclass(frozen=True)
class SimreadySettings:
    """Content and making of props."""

    density: float | None = None
    """kg per cubic metre of the convex hull, for an estimate of the mass; None for no mass and no rigid body."""
    ids: tuple[int, ...] | None = None
    """Of the instances that become props; None for all."""
    workers: int | None = None
    """Worker processes; 0 for none, None for none with few props and one per core, at most 4, with many."""
    progress: Callable[[int, int], None] | None = None
    """Called with how many of the things are done, and how many there are."""
    guessed_metre: bool = False
    """Take a guessed metre for one; masses then are off by three times its deviation."""
    one_folder: int = 1000
    """Of more props than this a thousand ids share a folder, `from_12000`."""

    def __post_init__(self) -> None:
        check_density(self.density)
        if self.workers is not None and self.workers < 0:
            raise OptionError(f"workers {self.workers}: give the number of worker processes, 0 for none")


def write_simready(store: Store, folder: str | Path, settings: SimreadySettings | None = None) -> tuple[Path, ...]:
    """Write `NAME/simready_usd/NAME.usd` for each instance of the main component and `scene.usdc`; return the files.

    Props have a closed mesh, a material, labels, a collider, a thumbnail and metadata; with a density a rigid body
    whose mass is an estimate, marked so. Structure is fixed and is in the scene. Moving and removed instances, and
    those with too few points for a mesh, have no prop. Raises `OptionError` for a memory without scale and for ids
    without a prop.
    """
    folder, settings = Path(folder), settings or SimreadySettings()
    check_metre(store, guessed=settings.guessed_metre)
    objects, structure = _chosen(store, settings)
    parts = len(objects) > settings.one_folder
    facts = PropFacts(datetime.date.today().isoformat(), store.path.name, settings.density, parts)
    with replacing_folder(folder, "simready") as temporary, errors_of_disk(folder):
        making = Making(settings.workers, settings.progress)
        props = write_props(store, objects, temporary, facts, making)
        if settings.ids is not None and len(props) < len(objects):
            bare = sorted({i.id for i in objects} - {p.instance_id for p in props})
            raise OptionError(f"{_names_of(bare)}: too few surface points for a mesh; leave it out of the ids")
        fixed = [(i, mesh) for i in structure if (mesh := instance_mesh(store, i)) is not None]
        scene = Sdf.Layer.CreateNew(str(temporary / "scene.usdc"))  # references are found from where it is
        _fill_scene(Usd.Stage.Open(scene), props, fixed)
        with Sdf.ChangeBlock():  # without a stage, which would open the file of every prop
            for prop in props:
                _refer(scene, prop)
        if not scene.Save():
            raise OSError("the scene of the props")
    return tuple(sorted(p for p in folder.rglob("*") if p.is_file()))


def _chosen(store: Store, settings: SimreadySettings) -> tuple[list[Instance], list[Instance]]:
    """Return the instances of the main component that become props where they have a mesh, and its structure."""
    there = [i for i in read_components(store)[0].instances if i.state != "removed" and has_box(i)]
    objects = [i for i in there if i.structure is None and not i.dynamic]
    if settings.ids is not None:
        wanted = {store.instances.get(n).id for n in settings.ids}
        if bare := sorted(wanted - {i.id for i in objects}):
            raise OptionError(f"{_names_of(bare)}: structure, gone, moving or placed apart; leave it out of the ids")
        objects = [i for i in objects if i.id in wanted]
    return objects, [i for i in there if i.structure is not None]


def _names_of(ids: Sequence[int]) -> str:
    return ", ".join(f"#{n}" for n in ids[:10]) + (f" and {len(ids) - 10} more" if len(ids) > 10 else "")


def _fill_scene(stage: Usd.Stage, props: Sequence[Prop], fixed: Sequence[tuple[Instance, InstanceMesh]]) -> None:
    """Write all of a scene but its props."""
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
    stage.SetDefaultPrim(world)
    Usd.ModelAPI(world).SetKind("assembly")
    UsdPhysics.Scene.Define(stage, "/World/PhysicsScene").CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    UsdGeom.Scope.Define(stage, "/World/Looks")
    material = add_vertex_material(stage, Sdf.Path("/World/Looks/seen"))
    for group, members in (("Props", props), ("Structure", fixed)):
        if members:
            Usd.ModelAPI(UsdGeom.Xform.Define(stage, f"/World/{group}").GetPrim()).SetKind("group")
    for i, mesh in fixed:
        xform = UsdGeom.Xform.Define(stage, f"/World/Structure/instance_{i.id}")
        set_labels(xform.GetPrim(), i)
        T_world_prim = Sim3(np.ones(()), i.box.rotation, i.box.center)
        _place(xform, T_world_prim)
        body = add_mesh(stage, xform.GetPath().AppendChild("mesh"), mesh, T_world_prim)
        bind(body.GetPrim(), material)
        add_collider(body, fixed=True)


def _refer(layer: Sdf.Layer, prop: Prop) -> None:
    """Add a prim that references a prop's file at the instance's pose."""
    spec = Sdf.CreatePrimInLayer(layer, f"/World/Props/{prop.name}")
    spec.specifier, spec.typeName = Sdf.SpecifierDef, "Xform"
    spec.referenceList.prependedItems = [Sdf.Reference(f"./{prop.file}")]
    w, x, y, z = quat_wxyz_from_rotation(prop.T_world_prop.rotation).tolist()
    ops = {
        "xformOp:translate": (Sdf.ValueTypeNames.Double3, Gf.Vec3d(*prop.T_world_prop.translation.tolist())),
        "xformOp:orient": (Sdf.ValueTypeNames.Quatd, Gf.Quatd(w, x, y, z)),
    }
    for name, (kind, value) in ops.items():
        Sdf.AttributeSpec(spec, name, kind).default = value
    order = Sdf.AttributeSpec(spec, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
    order.default = Vt.TokenArray(list(ops))


def _place(xform: UsdGeom.Xform, T_world_prim: Sim3) -> None:
    xform.AddTranslateOp().Set(Gf.Vec3d(*T_world_prim.translation.tolist()))
    w, x, y, z = quat_wxyz_from_rotation(T_world_prim.rotation).tolist()
    xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
