"""The chunk's cloud cut into things: surfaces first, then what stands on, hangs under or leans before them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.cuts import Segment, Segmentation
from list3r.instances.geometric.planes import estimate_up, find_planes, plane_tolerance
from list3r.instances.rules.clutter import split_crowds
from list3r.instances.rules.furniture import join_bodies
from list3r.instances.rules.sheets import find_sheets
from list3r.instances.rules.surfaces import Labels, Scene, Surface, assign_surfaces, choose_surfaces
from list3r.instances.rules.things import (
    adopt_fragments,
    adopt_islands,
    attach_parts,
    connect_rest,
    drop_junk,
    drop_reveals,
    drop_slivers,
    least_voxels,
)
from list3r.instances.rules.vessels import join_vessels
from list3r.instances.settings import SegmentSettings


def segment_cloud(
    cloud: Cloud, T_chunk_cam: NDArray[np.float64], unit: float, settings: SegmentSettings
) -> Segmentation:
    """Cut the cloud into things. `T_chunk_cam` are the posed cameras, shape (F, 4, 4)."""
    planes = find_planes(cloud, settings.plane_area_m2 * unit**2, unit)
    up = estimate_up(planes, T_chunk_cam)
    tolerance = plane_tolerance(cloud)
    scene = Scene(cloud, up, tolerance, T_chunk_cam[:, :3, 3], unit, settings)
    surfaces = choose_surfaces(scene, planes)
    labels = assign_surfaces(scene, surfaces)
    labels = connect_rest(scene, surfaces, labels)
    labels = adopt_islands(scene, surfaces, labels)
    labels = attach_parts(scene, surfaces, labels)
    labels = split_crowds(scene, surfaces, labels)
    labels = adopt_fragments(scene, surfaces, labels)
    labels = join_vessels(scene, surfaces, labels)
    labels = drop_slivers(scene, surfaces, labels)
    labels = drop_reveals(scene, surfaces, labels)
    labels = drop_junk(scene, surfaces, labels)
    labels, sheets = find_sheets(scene, surfaces, labels)
    labels = join_bodies(scene, surfaces, labels, sheets)
    return _describe(scene, surfaces, labels, sheets)


def _describe(scene: Scene, surfaces: list[Surface], labels: Labels, sheets: dict[int, int]) -> Segmentation:
    """Number the labels that are left from 1 and say what each is."""
    present = np.unique(labels[labels > 0])
    renumber = np.zeros(int(labels.max(initial=0)) + 1, np.int32)
    renumber[present] = np.arange(1, len(present) + 1)
    segments = []
    for label in present.tolist():
        mine = labels == label
        if label <= len(surfaces):
            surface = surfaces[label - 1]
            height = np.abs(surface.plane.height(scene.cloud.points[mine]))
            flat = float(np.mean(height < 2 * scene.tolerance[mine]))
            equation = surface.plane.equation if flat > 0.6 else None
            kind = "sheet" if surface.sheet else "surface"
            segments.append(Segment(kind, equation, surface.structure, 0.95))
            continue
        if label in sheets:
            under = surfaces[sheets[label]]
            base = under.plane.equation if under.structure else None
            plane = _plane_of(scene, mine, scene.up if base is None else base[:3])
            rug = base is not None and under.level
            segments.append(Segment("sheet", None if rug else plane, False, 0.8, base))
            continue
        score = 1.0 - np.exp(-mine.sum() / (2.0 * least_voxels(scene)))
        segments.append(Segment("thing", None, False, float(score)))
    return Segmentation(np.asarray(renumber[labels], np.int32), tuple(segments), scene.up)


def _plane_of(scene: Scene, mine: NDArray[np.bool_], toward: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least-squares plane through the voxels of a flat thing, its normal on the side of `toward`. Shape (4,).

    Fewer than three voxels, which the sheets around have left over, face as `toward` does.
    """
    points = scene.cloud.points[mine].astype(np.float64)
    mean, n = points.mean(axis=0), np.asarray(toward, np.float64)
    if len(points) >= 3:
        n = np.linalg.eigh(np.cov((points - mean).T))[1][:, 0]
        n = n if n @ toward > 0 else -n
    return np.append(n, -n @ mean)
