"""The surface points of instances as objects of other libraries, in world coordinates."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store

if TYPE_CHECKING:
    import open3d
    import trimesh


def open3d_cloud(store: Store, instances: Iterable[Instance]) -> open3d.geometry.PointCloud:
    """Return the coloured points of instances as one cloud."""
    import open3d

    surfaces = [store.surfaces.of(i.id) for i in instances]
    cloud = open3d.geometry.PointCloud()  # type: ignore[no-untyped-call]
    if surfaces:
        points, rgb = np.concatenate([s.points for s in surfaces]), np.concatenate([s.rgb for s in surfaces])
        cloud.points = open3d.utility.Vector3dVector(points.astype(np.float64))
        cloud.colors = open3d.utility.Vector3dVector(rgb / 255.0)
    return cloud


def trimesh_scene(store: Store, instances: Iterable[Instance]) -> trimesh.Scene:
    """Return a scene with a point cloud for each instance that has points, called by its id and name."""
    import trimesh

    scene = trimesh.Scene()
    for i in instances:
        surface = store.surfaces.of(i.id)
        if len(surface.points):
            cloud = trimesh.PointCloud(surface.points, surface.rgb)  # type: ignore[no-untyped-call]
            scene.add_geometry(cloud, geom_name=f"{i.id} {i.name}")
    return scene
