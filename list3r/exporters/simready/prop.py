"""One instance as a SimReady prop: a folder with one USD file that simulators take, its base at the origin."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from list3r.exporters.meshes.closed import hull
from list3r.exporters.meshes.instance_mesh import InstanceMesh
from list3r.exporters.simready.thumbnail import thumbnail
from list3r.exporters.solids.solid import Solid
from list3r.exporters.usd.labels import class_token, set_labels
from list3r.exporters.usd.mesh import add_solid, add_vertex_material, bind
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Instance

_NOT_STATED = "unknown"


@dataclass(frozen=True)
class PropFacts:
    """Facts about all props of an export."""

    date: str
    """Of the export, as 2026-01-31."""
    source_file: str
    """Name of the memory."""
    density_kg_m3: float | None
    """For an estimate of the mass; None for no mass and no rigid body."""
    parts: bool = False
    """Whether a thousand ids share a folder."""

    def part(self, instance_id: int) -> str:
        """Return the folder of a prop, relative to the export."""
        return f"from_{instance_id // 1000 * 1000}" if self.parts else ""


@dataclass(frozen=True)
class Prop:
    """File and pose of a prop."""

    name: str
    file: str
    """Path of its USD file, from the folder of the export."""
    instance_id: int
    T_world_prop: Sim3


def write_prop(folder: Path, instance: Instance, solid: Solid, facts: PropFacts) -> Prop:
    """Write `NAME/simready_usd/NAME.usd` with its thumbnail below the folder of the export, or of its part."""
    name, mesh = prop_name(instance), solid.mesh
    T_world_prop = _base(instance, mesh)
    place = folder / facts.part(instance.id) / name / "simready_usd"
    thumbs = place / ".thumbs" / "256x256"
    thumbs.mkdir(parents=True)
    stage = _stage(name, instance, solid, T_world_prop, facts)
    file = place / f"{name}.usd"
    if not stage.GetRootLayer().Export(str(file)):
        raise OSError(f"{file} cannot be written")
    image = thumbnail(T_world_prop.inverse().apply(mesh.surface.vertices), mesh.surface.faces, mesh.rgb)
    Image.fromarray(image).save(thumbs / f"{name}.usd.png", compress_level=4)  # half the time, 4 % more bytes
    return Prop(name, file.relative_to(folder).as_posix(), instance.id, T_world_prop)


def prop_name(instance: Instance) -> str:
    """Return the name of a prop, lower-case letters without accents, digits and underscores, its id at the end."""
    plain = unicodedata.normalize("NFKD", class_token(instance)).encode("ascii", "ignore").decode()
    words = re.sub(r"[^a-z0-9]+", "_", plain).strip("_")[:40].strip("_")
    return f"{words if words[:1].isalpha() else 'instance'}_{instance.id}"


def _base(instance: Instance, mesh: InstanceMesh) -> Sim3:
    """Return the frame of a prop: turned as the box, the origin at the centre of the base."""
    rotation = instance.box.rotation
    local = mesh.surface.vertices @ rotation
    low, high = local.min(axis=0), local.max(axis=0)
    origin: NDArray[np.float64] = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return Sim3(np.ones(()), rotation, rotation @ origin)


def _stage(name: str, instance: Instance, solid: Solid, T_world_prop: Sim3, facts: PropFacts) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind("component")
    root.SetDocumentation(instance.description or class_token(instance))
    set_labels(root, instance)
    root.CreateAttribute("list3r:id", Sdf.ValueTypeNames.Int, custom=True).Set(instance.id)
    UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("Looks"))
    material = add_vertex_material(stage, root.GetPath().AppendPath("Looks/seen"))
    body = add_solid(stage, root.GetPath(), solid, T_world_prop)
    bind(body.GetPrim(), material)
    density = facts.density_kg_m3
    mass = None if density is None else density * hull(solid.mesh.surface.vertices).volume()
    if mass is not None:
        UsdPhysics.RigidBodyAPI.Apply(root)
        UsdPhysics.MassAPI.Apply(root).CreateMassAttr(mass)
        root.CreateAttribute("list3r:mass:estimated", Sdf.ValueTypeNames.Bool, custom=True).Set(True)
        root.CreateAttribute("list3r:mass:density", Sdf.ValueTypeNames.Double, custom=True).Set(density)
    extents = np.ptp(np.asarray(body.GetPointsAttr().Get()), axis=0)
    metadata = {
        "author": "list3r",
        "asset_name": name,
        "asset_type": "prop",
        "asset_license": _NOT_STATED,
        "category": class_token(instance),
        "source_file": facts.source_file,
        "usd_date_generated": facts.date,
        "qcode": "Q223557",  # physical object
        "rigid_body_count": int(mass is not None),
        "asset_extents": Gf.Vec3f(*extents.tolist()),
        **({} if mass is None else {"mass": float(mass)}),
    }
    stage.GetRootLayer().customLayerData = {"SimReady_Metadata": metadata}
    return stage
