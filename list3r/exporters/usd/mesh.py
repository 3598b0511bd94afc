"""Meshes of instances as USD prims: points, faces, normals, colours of vertices, material, colliders."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from list3r.exporters.meshes.closed import ClosedSurface
from list3r.exporters.meshes.instance_mesh import InstanceMesh
from list3r.exporters.palette import linear_from_srgb
from list3r.exporters.solids.solid import Solid
from list3r.exporters.usd.labels import set_token
from list3r.memory.core.geometry import Sim3


def add_mesh(stage: Usd.Stage, path: Sdf.Path, mesh: InstanceMesh, T_world_prim: Sim3) -> UsdGeom.Mesh:
    """Add a mesh in the frame of its parent prim, with its kind as `list3r:surface`."""
    prim = _add_surface(stage, path, mesh.surface, T_world_prim)
    set_vertex_colors(prim, mesh.rgb)
    prim.GetPrim().CreateAttribute("list3r:surface", Sdf.ValueTypeNames.Token, custom=True).Set(mesh.kind)
    return prim


def _add_surface(stage: Usd.Stage, path: Sdf.Path, surface: ClosedSurface, T_world_prim: Sim3) -> UsdGeom.Mesh:
    prim = UsdGeom.Mesh.Define(stage, path)
    local = np.ascontiguousarray(T_world_prim.inverse().apply(surface.vertices), dtype=np.float32)
    normals = surface.normals() @ T_world_prim.rotation
    faces = np.ascontiguousarray(surface.faces, dtype=np.int32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(local))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
    prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, dtype=np.float32)))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr([Gf.Vec3f(*v.tolist()) for v in (local.min(axis=0), local.max(axis=0))])
    return prim


def set_vertex_colors(prim: UsdGeom.Gprim, rgb: NDArray[np.uint8]) -> None:
    """Set the colour of each point or vertex; each colour once with indices, where that is less. Shape (N, 3)."""
    _, first, index = np.unique(rgb @ np.array([1 << 16, 1 << 8, 1]), return_index=True, return_inverse=True)
    distinct = rgb[first]
    primvar = prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    indexed = len(distinct) < len(rgb)
    colors = np.ascontiguousarray(linear_from_srgb(distinct if indexed else rgb), dtype=np.float32)
    primvar.Set(Vt.Vec3fArray.FromNumpy(colors))
    if indexed:
        primvar.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(index.ravel(), dtype=np.int32)))


def add_vertex_material(stage: Usd.Stage, path: Sdf.Path) -> UsdShade.Material:
    """Add a material that shows the colours of vertices: a rough UsdPreviewSurface. The real material is unknown."""
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.9)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    reader = UsdShade.Shader.Define(stage, path.AppendChild("color"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(Gf.Vec3f(0.5))
    color = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    set_token(material.GetPrim(), "material", "unknown")
    return material


def bind(prim: Usd.Prim, material: UsdShade.Material) -> None:
    """Bind a material to a prim and its children."""
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def add_solid(stage: Usd.Stage, path: Sdf.Path, solid: Solid, T_world_prim: Sim3) -> UsdGeom.Mesh:
    """Add `mesh`, with `primvars:list3r:seen` for each face, and below `colliders` the convex parts that collide."""
    prim = add_mesh(stage, path.AppendChild("mesh"), solid.mesh, T_world_prim)
    seen = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("list3r:seen", Sdf.ValueTypeNames.BoolArray, UsdGeom.Tokens.uniform)
    seen.Set(Vt.BoolArray.FromNumpy(solid.seen))
    group = UsdGeom.Xform.Define(stage, path.AppendChild("colliders")).GetPath()
    for n, part in enumerate(solid.parts):
        shape = _add_surface(stage, group.AppendChild(f"part_{n}"), part, T_world_prim)
        shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
        add_collider(shape, fixed=False)
    return prim


def add_collider(mesh: UsdGeom.Mesh, *, fixed: bool) -> None:
    """Make a mesh collide: its convex hull, or its triangles where it is fixed."""
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    shape = UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim())
    shape.CreateApproximationAttr(UsdPhysics.Tokens.none if fixed else UsdPhysics.Tokens.convexHull)
