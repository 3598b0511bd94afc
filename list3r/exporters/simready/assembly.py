"""Write each instance as a SimReady prop and a scene that puts them where they are."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from list3r.exporters.components import has_box, read_components
from list3r.exporters.meshes.instance_mesh import InstanceMesh, instance_mesh
from list3r.exporters.output import replacing_folder, units
from list3r.exporters.simready.prop import Prop, PropFacts, write_prop
from list3r.exporters.usd.labels import set_labels
from list3r.exporters.usd.mesh import add_collider, add_mesh, add_vertex_material, bind
from list3r.exporters.usd.stage import errors_of_disk
from list3r.memory.errors import OptionError
from list3r.memory.geometry import Sim3, quat_wxyz_from_rotation
from list3r.memory.records import Instance
from list3r.memory.store.store import Store


@dataclass(frozen=True)
class SimreadySettings:
    """What props are told to be."""

    density: float | None = None
    """kg per cubic metre of the convex hull, for an estimate of the mass; None for no mass and no rigid body."""

    def __post_init__(self) -> None:
        if self.density is not None and not 0 < self.density < 1e6:
            raise OptionError(f"density {self.density:g}: kilograms per cubic metre above 0 are needed, such as 300")


def write_simready(store: Store, folder: str | Path, settings: SimreadySettings | None = None) -> tuple[Path, ...]:
    """Write `NAME/simready_usd/NAME.usd` for each thing of the main component and `scene.usdc`; return the files.

    Props have a closed mesh, a material, labels, a collider, a thumbnail and metadata; with a density a rigid body
    whose mass is an estimate, marked so. Structure is fixed and lies in the scene. What was seen to move, is gone, or
    has too few points for a mesh has no prop. Raises `OptionError` for a memory without scale.
    """
    folder, settings = Path(folder), settings or SimreadySettings()
    if units(store) != "m":
        raise OptionError(
            f"{store.path.name} has no metric scale, which a simulator needs: `list3r scale --anchor` gives it one"
        )
    facts = PropFacts(datetime.date.today().isoformat(), store.path.name, settings.density)
    main = read_components(store)[0]
    with replacing_folder(folder, "simready") as temporary, errors_of_disk(folder):
        props: list[Prop] = []
        fixed: list[tuple[Instance, InstanceMesh]] = []
        for i in main.instances:
            if i.state == "removed" or not has_box(i) or (mesh := instance_mesh(store, i)) is None:
                continue
            if i.structure is not None:
                fixed.append((i, mesh))
            elif not i.dynamic:
                props.append(write_prop(temporary, i, mesh, facts))
        stage = Usd.Stage.CreateNew(str(temporary / "scene.usdc"))  # references are found from where it lies
        _fill_scene(stage, props, fixed)
        stage.GetRootLayer().Save()
    return tuple(sorted(p for p in folder.rglob("*") if p.is_file()))


def _fill_scene(stage: Usd.Stage, props: Sequence[Prop], fixed: Sequence[tuple[Instance, InstanceMesh]]) -> None:
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
    for prop in props:
        xform = UsdGeom.Xform.Define(stage, f"/World/Props/{prop.name}")
        xform.GetPrim().GetReferences().AddReference(f"./{prop.file}")
        _place(xform, prop.T_world_prop)
    for i, mesh in fixed:
        xform = UsdGeom.Xform.Define(stage, f"/World/Structure/instance_{i.id}")
        set_labels(xform.GetPrim(), i)
        T_world_prim = Sim3(np.ones(()), i.box.rotation, i.box.center)
        _place(xform, T_world_prim)
        body = add_mesh(stage, xform.GetPath().AppendChild("mesh"), mesh, T_world_prim)
        bind(body.GetPrim(), material)
        add_collider(body, fixed=True)


def _place(xform: UsdGeom.Xform, T_world_prim: Sim3) -> None:
    xform.AddTranslateOp().Set(Gf.Vec3d(*T_world_prim.translation.tolist()))
    w, x, y, z = quat_wxyz_from_rotation(T_world_prim.rotation).tolist()
    xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
