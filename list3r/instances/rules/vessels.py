"""The near outside and the far inside of a bowl, basket or mug, made one by the rim that they share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.instances.rules.surfaces import Labels, Scene, Surface
from list3r.instances.rules.things import least_voxels, members_of

RIM_M = 0.03
"""Height of the band under a piece's top that is taken for its rim."""
RADIUS_M = (0.02, 0.4)
"""Of vessels."""
SECTORS = 16
"""Into which the circle of a rim is cut."""
COVERED = 12
"""Of which the two pieces together must be seen in."""
EACH = 4
"""Of which either piece must be seen in."""
RIM_SIGMAS = 3.0
"""How far off the circle a rim may be, in standard deviations of single readings, besides two voxels."""


def join_vessels(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Labels with pairs of pieces made one that end at one level circle, each along another part of it.

    Seen from above, a vessel shows the outside of its near wall and the inside of its far wall; the depth edge at the
    rim parts them.
    """
    first, second = _level_axes(scene)
    rims: dict[int, tuple[float, NDArray[np.float64], float]] = {}
    for label, mine in members_of(labels, len(surfaces)).items():
        if len(mine) < least_voxels(scene):
            continue
        points = scene.cloud.points[mine].astype(np.float64)
        height = points @ scene.up
        top = float(np.quantile(height, 0.97))
        rim = points[height > top - RIM_M * scene.unit] @ np.stack([first, second]).T
        if len(rim) >= 10 and np.ptp(rim, axis=0).max() < 2.0 * RADIUS_M[1] * scene.unit:
            rims[label] = (top, rim, float(np.median(scene.cloud.reading[mine])))
    table = np.arange(int(labels.max(initial=0)) + 1, dtype=np.int32)
    names = sorted(rims)
    for n, a in enumerate(names):
        for b in names[n + 1 :]:
            if table[a] == a and table[b] == b and _one_rim(scene, rims[a], rims[b]):
                table[b] = a
    return np.asarray(table[labels], np.int32)


def _level_axes(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first = np.cross(scene.up, np.eye(3)[int(np.argmin(np.abs(scene.up)))])
    first /= np.linalg.norm(first)
    return first, np.cross(scene.up, first)


def _one_rim(
    scene: Scene, a: tuple[float, NDArray[np.float64], float], b: tuple[float, NDArray[np.float64], float]
) -> bool:
    """True for two rims of one height on one circle, each along a part of it."""
    (top_a, rim_a, noise_a), (top_b, rim_b, noise_b) = a, b
    away = np.linalg.norm(rim_a.mean(axis=0) - rim_b.mean(axis=0))
    if abs(top_a - top_b) > RIM_M * scene.unit or away > 2.0 * RADIUS_M[1] * scene.unit:
        return False
    center, radius = fit_circle(rim_a, rim_b)
    if not RADIUS_M[0] * scene.unit < radius < RADIUS_M[1] * scene.unit:
        return False
    slack = min(2.0 * scene.cloud.voxel + RIM_SIGMAS * max(noise_a, noise_b), 0.4 * radius)
    seen = []
    for rim in (rim_a, rim_b):
        local = rim - center
        on = np.abs(np.linalg.norm(local, axis=1) - radius) < slack
        if on.mean() < 0.8:
            return False
        sector = np.floor((np.arctan2(local[on, 1], local[on, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
        seen.append(set(sector.tolist()))
    both = len(seen[0] | seen[1])
    fewest, shared = min(len(s) for s in seen), len(seen[0] & seen[1])
    return both >= COVERED and fewest >= EACH and shared <= SECTORS // 4


def fit_circle(*arcs: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centre and radius of the circle through arcs (N, 2) of equal weight (algebraic least squares, Kasa 1976)."""
    p = np.concatenate(arcs)
    weight = np.concatenate([np.full(len(arc), 1.0 / np.sqrt(len(arc))) for arc in arcs])
    middle = p.mean(axis=0)
    q = p - middle
    A = np.column_stack([2.0 * q, np.ones(len(q))]) * weight[:, None]
    x = np.linalg.lstsq(A, np.sum(q * q, axis=1) * weight, rcond=None)[0]
    return middle + x[:2], float(np.sqrt(max(x[2] + x[:2] @ x[:2], 0.0)))
