"""Flat things on a level surface (papers, magazines, a phone) by colour and by the little height they have."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.features import lab_of
from list3r.instances.geometric.planes import Raster, plane_raster
from list3r.instances.rules.surfaces import Labels, Scene, Surface, hull_of
from list3r.instances.rules.things import members_of

Float = NDArray[np.float32]

MIN_SURFACE_AREA_M2 = 0.15
MIN_CONTRAST = 7.0
"""Colour difference (Lab, lightness halved) below which nothing is told apart."""


SHEET_M = 0.025
"""Thickness up to which a thing on a top is flat."""
PANEL_M = 0.05
"""Thickness up to which a thing on a wall or floor is flat."""
PANEL_AREA_M2 = 0.06
"""Smallest panel on a wall or floor: a sheet of A4."""
PANEL_FILL = 0.8
"""Share of what is seen in its rectangle that a panel fills."""
PANEL_SEEN = 0.5
"""Share of its rectangle that must be seen; the image's border and what stands before it cut the rest."""


@dataclass(frozen=True)
class _Top:
    """What a level surface looks like from above, on a grid of voxel size. Images share their shape."""

    raster: Raster
    known: NDArray[np.bool_]
    color: Float
    """Half lightness, a, b. Shape (h, w, 3)."""
    height: Float
    """Height over the plane, chunk units."""
    voxels: NDArray[np.int64]
    """Voxels of the cloud that are seen here. Shape (M,)."""
    cell: NDArray[np.int64]
    """Row-major cell of each of them. Shape (M,)."""


def find_sheets(scene: Scene, surfaces: list[Surface], labels: Labels) -> tuple[Labels, dict[int, int]]:
    """Labels with flat things cut out of the surfaces they lie on or hang at, and the surface's number for each."""
    out = labels.copy()
    found: dict[int, int] = {}
    for number, surface in enumerate(surfaces):
        if surface.sheet or not (surface.level or surface.structure):
            continue
        if surface.plane.area < MIN_SURFACE_AREA_M2 * scene.unit**2:
            continue
        if np.count_nonzero(out == number + 1) < 0.5 * len(surface.plane.members):
            continue
        top = _look_down(scene, surfaces, out, number)
        pieces = _panels(scene, top) if surface.structure else _pieces(scene, top)
        mine = pieces.ravel()[top.cell]
        first = int(out.max(initial=0))
        rest = out[top.voxels] if surface.structure else number + 1
        out[top.voxels] = np.where(mine > 0, first + mine, rest)
        found.update({label: number for label in range(first + 1, first + int(pieces.max(initial=0)) + 1)})
    return out, found


def _look_down(scene: Scene, surfaces: list[Surface], labels: Labels, number: int) -> _Top:
    """Gather the surface, the sheets on it and the flat components on it."""
    cloud, plane = scene.cloud, surfaces[number].plane
    height = plane.height(cloud.points)
    chosen = np.zeros(len(labels), bool)
    chosen[labels == number + 1] = True
    bounding = surfaces[number].structure
    flat = (PANEL_M if bounding else SHEET_M) * scene.unit
    below = hull_of(plane.footprint) if bounding else plane.footprint
    for label, mine in members_of(labels, 0).items():
        thin = label > len(surfaces) or surfaces[label - 1].sheet or (bounding and not surfaces[label - 1].structure)
        if thin and np.quantile(height[mine], 0.9) < flat and np.quantile(height[mine], 0.1) > -flat:
            over = plane.raster.look_up(below, cloud.points[mine]) > 0
            chosen[mine] = over.mean() > 0.3
    chosen &= (height > -1.5 * scene.tolerance) & (height < 2.0 * flat)
    voxels = np.flatnonzero(chosen)
    grain = cloud.voxel * (2.0 if bounding else 1.0)
    raster = plane_raster(plane.equation, cloud.points[voxels], grain)
    rc = raster.cells(cloud.points[voxels])
    cell = rc[:, 0] * raster.shape[1] + rc[:, 1]
    size = raster.shape[0] * raster.shape[1]
    weight = np.exp(np.clip(height[voxels] / cloud.voxel, -3.0, 3.0))
    total = np.bincount(cell, weight, minlength=size)
    known = (total > 0).reshape(raster.shape)
    lab = lab_of(cloud.rgb[voxels])
    channels = [np.bincount(cell, weight * v, minlength=size) for v in (*lab.T, height[voxels])]
    images = [(c / np.maximum(total, 1e-9)).reshape(raster.shape).astype(np.float32) for c in channels]
    return _Top(raster, known, np.stack(images[:3], axis=-1), images[3], voxels, cell)


def _stands_out(scene: Scene, top: _Top) -> tuple[Float, NDArray[np.bool_]]:
    """Smoothed colour, and the cells that differ from the surface around them in colour or height."""
    channels = [cv2.medianBlur(np.ascontiguousarray(top.color[..., k]), 3) for k in range(3)]
    color = np.stack(channels, axis=-1).astype(np.float32)
    away, ground = _away_from_ground(color, top, scene)
    height = np.asarray(cv2.blur(np.where(top.known, top.height, 0.0), (3, 3)), np.float32)
    noise = 1.4826 * float(np.median(np.abs(height[ground]))) if ground.any() else 0.0
    raised = top.known & (_less_ground(height, ground, top, scene) > max(4.0 * noise, 0.004 * scene.unit))
    return color, away | raised


def _panels(scene: Scene, top: _Top) -> NDArray[np.int32]:
    """Rectangles on a wall or floor (pictures, boards, rugs), numbered from 1, on the grid.

    A wall has edges, shadows and stains of its own, so only a well filled rectangle that leaves most of the wall bare
    counts, whatever the pattern inside it.
    """
    mask = _stands_out(scene, top)[1].astype(np.uint8)
    wide = 2 * max(1, round(0.03 * scene.unit / top.raster.cell)) + 1
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((wide, wide), np.uint8))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((wide, wide), np.uint8))
    count, regions = cv2.connectedComponents(opened, connectivity=4)
    square = (scene.unit / top.raster.cell) ** 2
    out, number = np.zeros(top.known.shape, np.int32), 0
    for region in range(1, count):
        inside = (regions == region) & top.known
        area = float(np.count_nonzero(regions == region))
        if area < PANEL_AREA_M2 * square or area > 0.5 * np.count_nonzero(top.known):
            continue
        rectangle = cv2.minAreaRect(np.argwhere(regions == region)[:, ::-1].astype(np.float32))
        sides = np.asarray(rectangle[1]) + 1.0
        frame = cv2.fillConvexPoly(
            np.zeros(mask.shape, np.uint8), np.rint(cv2.boxPoints(rectangle)).astype(np.int32), 1
        )
        bare = np.count_nonzero((frame > 0) & top.known & (regions != region))
        if sides.max() > 5.0 * sides.min() or area < PANEL_SEEN * float(np.prod(sides)):
            continue
        if area > PANEL_FILL * (area + bare):
            number += 1
            out[inside] = number
    return out


def _pieces(scene: Scene, top: _Top) -> NDArray[np.int32]:
    """Flat things, numbered from 1, on the grid."""
    color, differs = _stands_out(scene, top)
    square = np.ones((3, 3), np.uint8)
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, square)
    mask = (np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, square)) > 0) & top.known
    least = int(scene.settings.flat_area_m2 / (top.raster.cell / scene.unit) ** 2)
    regions = merge_regions(color, mask, least)
    return _accept(regions, least)


def _away_from_ground(color: Float, top: _Top, scene: Scene) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Cells whose colour is not that of the surface around them, and the cells that make the surface's colour."""
    values = color[top.known]
    bins = np.floor(values / 6.0).astype(np.int64) + 64
    codes, count = np.unique((bins[:, 0] << 20) | (bins[:, 1] << 10) | bins[:, 2], return_counts=True)
    best = int(codes[np.argmax(count)])
    mode = (np.array([best >> 20, (best >> 10) & 1023, best & 1023]) - 64 + 0.5) * 6.0
    difference = np.linalg.norm(color - mode.astype(np.float32), axis=-1)
    ground = top.known & (difference < 12.0)
    for _ in range(3):
        residual = np.stack([_less_ground(color[..., k], ground, top, scene) for k in range(3)], axis=-1)
        difference = np.linalg.norm(residual, axis=-1)
        spread = 1.4826 * float(np.median(difference[ground])) if ground.any() else 0.0
        limit = max(MIN_CONTRAST, 2.5 * spread)
        ground = top.known & (difference < limit)
    return top.known & (difference > 1.3 * limit), ground


def _less_ground(image: Float, ground: NDArray[np.bool_], top: _Top, scene: Scene) -> Float:
    """An image less the mean of the ground's cells around (Gaussian, 15 cm)."""
    sigma = 0.15 * scene.unit / top.raster.cell
    mass = cv2.GaussianBlur(ground.astype(np.float32), (0, 0), sigma) + np.float32(1e-6)
    mean = cv2.GaussianBlur(np.where(ground, image, 0.0).astype(np.float32), (0, 0), sigma) / mass
    overall = float(image[ground].mean()) if ground.any() else 0.0
    return np.asarray(image - np.where(mass > 0.01, mean, overall), np.float32)


def merge_regions(color: Float, mask: NDArray[np.bool_], least: int) -> NDArray[np.int32]:
    """Regions of like colour in a mask, numbered from 1 (Felzenszwalb and Huttenlocher 2004), none under `least` cells.

    Edges are taken in order of colour difference; two regions join when the edge is no stronger than what either
    holds inside, with a bonus that falls with their size. Afterwards small regions join their most alike neighbour.
    """
    number = np.full(mask.shape, -1, np.int64)
    count = int(mask.sum())
    number[mask] = np.arange(count)
    pairs, weights = [], []
    for axis in (0, 1):
        a = number[:-1] if axis == 0 else number[:, :-1]
        b = number[1:] if axis == 0 else number[:, 1:]
        step = np.linalg.norm(np.diff(color, axis=axis), axis=-1)
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]], axis=1))
        weights.append(step[both])
    edges, weight = np.concatenate(pairs), np.concatenate(weights)
    order = np.argsort(weight, kind="stable")
    root = _join(edges[order].tolist(), weight[order].tolist(), count, least)
    out = np.zeros(mask.shape, np.int32)
    if count:
        _, compact = np.unique(root, return_inverse=True)
        out[mask] = compact + 1
    return out


def _join(edges: list[list[int]], weights: list[float], count: int, least: int) -> NDArray[np.int64]:
    parent, size, inner = list(range(count)), [1] * count, [0.0] * count

    def find(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    bonus = 3.0 * least
    for (a, b), weight in zip(edges, weights, strict=True):
        a, b = find(a), find(b)
        if a != b and weight <= min(inner[a] + bonus / size[a], inner[b] + bonus / size[b]):
            parent[b] = a
            size[a], inner[a] = size[a] + size[b], weight
    for a, b in edges:
        a, b = find(a), find(b)
        if a != b and min(size[a], size[b]) < least:
            parent[b] = a
            size[a] += size[b]
    return np.array([find(node) for node in range(count)], np.int64)


def _accept(regions: NDArray[np.int32], least: int) -> NDArray[np.int32]:
    """The regions that are large, compact and no mere strip, numbered from 1."""
    out, number = np.zeros_like(regions), 0
    for region in range(1, int(regions.max(initial=0)) + 1):
        mask = (regions == region).astype(np.uint8)
        area = int(mask.sum())
        if area < least:
            continue
        corners = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
        hull = cv2.contourArea(corners) + 0.5 * cv2.arcLength(corners, True) + 1.0
        width = min(cv2.minAreaRect(corners)[1]) + 1.0
        if area > 0.55 * hull and width**2 > 0.25 * least:
            number += 1
            out[mask > 0] = number
    return out
