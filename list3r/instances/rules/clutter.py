"""Crowded components along walls and on counters, parted where surfaces meet in a hollow or end at a depth edge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.instances.geometric.cloud import Float, component_numbers, linked_components, neighbour_pairs, pack, unpack
from list3r.instances.geometric.features import lab_of
from list3r.instances.rules.surfaces import Labels, Scene, Surface
from list3r.instances.rules.things import least_voxels, members_of

CROWD_M = 1.0
"""A component longer than this is no single thing that can be moved about."""
WALL_GAP_M = 0.15
"""A component that lies mostly within this of a wall may be several things before the wall."""
MIN_CROWD_M = 0.3
"""Smaller components are left whole."""
COLOR_LENGTH_M = 0.003
"""Distance that one unit of colour difference counts for when parts grow."""
REGROW_M = 0.06
"""How far a part grows."""
COLOR_STEP = 8.0
"""Colour difference (Lab, lightness halved) of neighbouring voxels that parts."""
COLOR_JOIN = 12.0
"""Mean colour difference up to which flat neighbours are one."""
HOLLOW_PER_M = 9.0
"""Change of the normal over distance from which a hollow parts: 15 degrees over 3 cm."""


def split_crowds(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Labels with crowded components cut into the things they are made of (after Stein et al., CVPR 2014)."""
    out = labels.copy()
    following = int(labels.max(initial=0)) + 1
    for mine in members_of(labels, len(surfaces)).values():
        if not _crowded(scene, surfaces, mine):
            continue
        parts = _split(scene, mine)
        if parts.max(initial=0) > 1:
            out[mine] = np.where(parts > 1, following + parts - 2, out[mine])
            following += int(parts.max()) - 1
    return out


def _crowded(scene: Scene, surfaces: list[Surface], mine: NDArray[np.int64]) -> bool:
    points = scene.cloud.points[mine]
    spread = points - points.mean(axis=0)
    along = spread @ np.linalg.eigh(spread.T @ spread)[1][:, 2]
    length = float(np.ptp(np.quantile(along, [0.02, 0.98]))) / scene.unit
    if length < MIN_CROWD_M:
        return False
    if length > CROWD_M:
        return True
    walls = [s.plane for s in surfaces if scene.upright(s.plane) and s.plane.area > 0.15 * scene.unit**2]
    return any(np.mean(np.abs(w.height(points)) < WALL_GAP_M * scene.unit) > 0.6 for w in walls)


def _split(scene: Scene, mine: NDArray[np.int64]) -> NDArray[np.int64]:
    """Part of each voxel of one component, from 1. Shape (M,)."""
    cloud = scene.cloud
    normals = cloud.normals[mine]
    smooth = (np.abs(normals).sum(axis=1) > 0.5) & ~_hollow(scene, mine)
    core = np.flatnonzero(smooth)
    if len(core) < least_voxels(scene):
        return np.ones(len(mine), np.int64)
    left, right = neighbour_pairs(cloud.keys[mine[core]], 1)
    color = lab_of(cloud.rgb[mine])
    alike = np.sum(normals[core[left]] * normals[core[right]], axis=1) > 0.8
    alike &= np.linalg.norm(color[core[left]] - color[core[right]], axis=1) < COLOR_STEP
    left, right = left[alike], right[alike]
    component, size = component_numbers(left, right, len(core))
    large = size[component] >= 2 * least_voxels(scene)
    if not large.any():
        return np.ones(len(mine), np.int64)
    seeds, number = core[large], np.unique(component[large], return_inverse=True)[1] + 1
    return _rejoin(scene, mine, _regrow(scene, mine, seeds, number, color), color)


def _regrow(
    scene: Scene, mine: NDArray[np.int64], seeds: NDArray[np.int64], number: NDArray[np.int64], color: Float
) -> NDArray[np.int64]:
    """Part of each voxel: that of the seed nearest in place and colour; what is near none makes parts of its own."""
    cloud = scene.cloud
    place = np.concatenate([cloud.points[mine], color * np.float32(COLOR_LENGTH_M * scene.unit)], axis=1)
    distance, nearest = cKDTree(place[seeds]).query(place, distance_upper_bound=REGROW_M * scene.unit)
    found = np.isfinite(distance)
    parts = np.zeros(len(mine), np.int64)
    parts[found] = number[np.asarray(nearest)[found]]
    left = np.flatnonzero(~found)
    component, size = linked_components(cloud.keys[mine[left]], 2)
    large = size[component] >= 2 * least_voxels(scene)
    parts[left[large]] = number.max() + 1 + component[large] if len(left) else 0
    small = np.flatnonzero(parts == 0)
    if len(small):
        known = np.flatnonzero(parts)
        parts[small] = parts[known[cKDTree(cloud.points[mine[known]]).query(cloud.points[mine[small]])[1]]]
    return np.unique(parts, return_inverse=True)[1] + 1


def _hollow(scene: Scene, mine: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Voxels where the surface is concave over about 3 cm. Shape (M,)."""
    cloud, reach = scene.cloud, max(2, round(0.03 * scene.unit / scene.cloud.voxel))
    keys = cloud.keys[mine]
    cells = unpack(keys)
    bend, count = np.zeros(len(mine)), np.zeros(len(mine))
    span = (-reach, 0, reach)
    for offset in ((i, j, k) for i in span for j in span for k in span if (i, j, k) > (0, 0, 0)):
        wanted = pack(cells + np.array(offset))
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        a = np.flatnonzero(keys[at] == wanted)
        b = at[a]
        d = cloud.points[mine[b]] - cloud.points[mine[a]]
        n_a, n_b = cloud.normals[mine[a]], cloud.normals[mine[b]]
        known = (np.abs(n_a).sum(axis=1) > 0.5) & (np.abs(n_b).sum(axis=1) > 0.5)
        value = np.where(known, np.sum((n_b - n_a) * d, axis=1) / np.maximum(np.sum(d * d, axis=1), 1e-12), 0.0)
        for side in (a, b):
            bend += np.bincount(side, np.minimum(value, 0.0), minlength=len(mine))
            count += np.bincount(side, known, minlength=len(mine))
    return np.asarray(bend / np.maximum(count, 1.0) < -0.5 * HOLLOW_PER_M / scene.unit)


def _means(parts: NDArray[np.int64], values: NDArray[np.float32]) -> NDArray[np.float64]:
    total = np.stack([np.bincount(parts, values[:, k]) for k in range(values.shape[1])], axis=1)
    return np.asarray(total / np.maximum(np.bincount(parts), 1)[:, None])


def _rejoin(
    scene: Scene, mine: NDArray[np.int64], parts: NDArray[np.int64], color: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Parts that meet convexly, or go on flatly in like colour, made one again, numbered from 1."""
    cloud = scene.cloud
    left, right = neighbour_pairs(cloud.keys[mine], 2)
    cross = parts[left] != parts[right]
    left, right = left[cross], right[cross]
    count = int(parts.max()) + 1
    mean, facing, tone = (_means(parts, v) for v in (cloud.points[mine], cloud.normals[mine], color))
    facing /= np.maximum(np.linalg.norm(facing, axis=1), 1e-9)[:, None]
    low, high = np.minimum(parts[left], parts[right]), np.maximum(parts[left], parts[right])
    pairs, contact = np.unique(np.stack([low, high], axis=1), axis=0, return_counts=True)
    parent = np.arange(count)
    for (a, b), touching in sorted(zip(pairs.tolist(), contact.tolist(), strict=True), key=lambda e: (-e[1], e[0])):
        d = mean[b] - mean[a]
        d /= max(float(np.linalg.norm(d)), 1e-9)
        convex = float((facing[b] - facing[a]) @ d)
        across = float(facing[a] @ facing[b])
        step = abs(float(d @ (facing[a] + facing[b]))) / 2.0
        alike = float(np.linalg.norm(tone[a] - tone[b])) < COLOR_JOIN
        meets = touching > 20 and ((across < 0.9 and convex > 0.25) or (across >= 0.9 and step < 0.08 and alike))
        if meets:
            parent[parent == parent[b]] = parent[a]
    return np.asarray(np.unique(parent[parts], return_inverse=True)[1] + 1)
