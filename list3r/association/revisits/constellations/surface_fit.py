"""Align two chunks' surfaces from a rough similarity: floors, walls, tables, and the shared sides of instances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.association.revisits.cross_check import Side
from list3r.memory.core.geometry import Sim3, skew

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceFitSettings:
    """How surfaces are aligned. Lengths are shares of the target's typical depth."""

    source_points: int = 1500
    target_points: int = 6000
    neighbours: int = 12
    """Points that determine a surface's normal."""
    reaches: tuple[float, ...] = (0.16, 0.11, 0.07, 0.05)
    """Largest distance of corresponding points, by round."""
    steps: int = 4
    """Steps of each round."""
    least_cosine: float = 0.75
    """Least cosine between the normals, up to sign, of corresponding points."""
    instance_sigma: float = 0.08
    """Standard deviation of an instance's centre, which constrains the directions that surfaces leave open."""
    instance_weight: float = 0.05
    """Weight of all instances against all surfaces."""
    upright: float = 0.065
    """Weight of both chunks' estimates of up, which are accurate to a degree or two,"""
    scaled: float = 0.02
    """and of the scale by the instances: smaller copies fit surfaces too well."""


@dataclass(frozen=True)
class KnownRelation:
    """Evidence for a relation other than surfaces."""

    middle_u: Array
    """Centres of matched instances in u. Shape (P, 3)."""
    middle_v: Array
    """The same in v. Shape (P, 3)."""
    up_u: Array
    """Unit length. Shape (3,)."""
    up_v: Array
    """Unit length. Shape (3,)."""
    scale: float
    """By the instances."""


@dataclass(frozen=True)
class SurfaceFit:
    """A similarity after the fit to surfaces."""

    S_v_u: Sim3
    fitting: float
    """Share of u's points within the last reach of a surface of v of the same direction."""
    residual: float
    """Root mean square distance of these points from the surface, share of v's typical depth."""
    spread: float
    """Least eigenvalue over largest of these surfaces' directions: 0 where they leave a shift open."""


class ChunkSurfaces:
    """Points and normals of a chunk, kept for repeated use."""

    def __init__(self, side: Side, unit: float, settings: SurfaceFitSettings) -> None:
        self.unit = unit
        self._settings = settings
        s = side.samples
        sound = np.isfinite(s.points).all(axis=1) & ~np.isin(s.instance, sorted(side.moving)) & (s.confidence > 0)
        median = float(np.median(s.confidence[sound])) if sound.any() else 0.0
        rows = np.flatnonzero(sound & (s.confidence >= 0.3 * median))
        pick = np.linspace(0, len(rows) - 1, min(len(rows), settings.target_points)).astype(np.int64)
        self.points: Array = s.points[rows[pick]].astype(np.float64)

    @cached_property
    def tree(self) -> cKDTree:
        """Return the points as a tree."""
        return cKDTree(self.points)

    @cached_property
    def normals(self) -> Array:
        """Return the normals of the points, of either sign. Shape (N, 3)."""
        count = min(self._settings.neighbours, len(self.points))
        near = self.points[self.tree.query(self.points, count)[1].reshape(len(self.points), count)]
        off = near - near.mean(axis=1, keepdims=True)
        return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][:, :, 0])


def fit_surfaces(
    S_v_u: Sim3,
    u: ChunkSurfaces,
    v: ChunkSurfaces,
    held: KnownRelation,
    metric: bool,
    settings: SurfaceFitSettings | None = None,
) -> SurfaceFit | None:
    """Refine a similarity by point-to-plane distances (Chen and Medioni, 1992), reweighted; None for too few points."""
    s = settings or SurfaceFitSettings()
    if min(len(u.points), len(v.points)) < 100:
        return None
    pick = np.linspace(0, len(u.points) - 1, min(len(u.points), s.source_points)).astype(np.int64)
    fit = _Fit(u.points[pick], u.normals[pick], v, held, metric, s)
    for reach in s.reaches:
        for _ in range(s.steps):
            step = fit.step(S_v_u, reach)
            if step is None:
                return None
            S_v_u = step
    found = fit.pairs(S_v_u, s.reaches[-1])
    if len(found.near) < 50:
        return None
    values = np.linalg.eigvalsh(found.normals.T @ found.normals)
    return SurfaceFit(
        S_v_u=S_v_u,
        fitting=len(found.near) / len(pick),
        residual=float(np.sqrt((found.off**2).mean()) / v.unit),
        spread=float(values[0] / values[2]),
    )


@dataclass(frozen=True)
class _Pairs:
    """Points of u near a surface of v of the same direction."""

    near: Array
    """The points, moved to v. Shape (N, 3)."""
    normals: Array
    """Of v. Shape (N, 3)."""
    off: Array
    """From the points to the surface, along its normal. Shape (N,)."""


@dataclass(frozen=True)
class _Fit:
    """The inputs of a surface fit."""

    points: Array
    """Of u. Shape (N, 3)."""
    point_normals: Array
    """Shape (N, 3)."""
    v: ChunkSurfaces
    held: KnownRelation
    metric: bool
    settings: SurfaceFitSettings

    def pairs(self, S: Sim3, reach: float) -> _Pairs:
        """Return the corresponding points within a reach."""
        v = self.v
        there = S.apply(self.points)
        distance, at = v.tree.query(there, distance_upper_bound=reach * v.unit)
        found = np.isfinite(distance)
        at = np.where(found, at, 0).astype(np.int64)
        along = np.abs(np.einsum("ni,ni->n", self.point_normals @ S.rotation.T, v.normals[at]))
        near = found & (along >= self.settings.least_cosine)
        p, q, n = there[near], v.points[at[near]], v.normals[at[near]]
        return _Pairs(p, n, np.einsum("ni,ni->n", q - p, n))

    def step(self, S: Sim3, reach: float) -> Sim3 | None:
        """Return the similarity after one Gauss-Newton step, about the centre of the pairs."""
        s, v, held, found = self.settings, self.v, self.held, self.pairs(S, reach)
        p, n, r = found.near, found.normals, found.off
        if len(p) < 50:
            return None
        middle = p.mean(axis=0)
        weight = (1 - np.minimum(np.abs(r) / (reach * v.unit), 1.0) ** 2) ** 2 / len(r)
        arm = p - middle
        J = np.concatenate([n, np.cross(arm, n), np.einsum("ni,ni->n", arm, n)[:, None]], axis=1)
        A, b = (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ r
        centers = S.apply(held.middle_u)
        arm = centers - middle
        J_a = np.concatenate([np.tile(np.eye(3), (len(centers), 1, 1)), -skew(arm), arm[:, :, None]], axis=2)
        off = held.middle_v - centers
        weight_a = (
            s.instance_weight / (1 + (np.linalg.norm(off, axis=1) / (s.instance_sigma * v.unit)) ** 2) / len(centers)
        )
        A += np.einsum("p,pki,pkj->ij", weight_a, J_a, J_a)
        b += np.einsum("p,pki,pk->i", weight_a, J_a, off)
        lean = s.upright * v.unit**2
        A[3:6, 3:6] += lean * (np.eye(3) - np.outer(held.up_v, held.up_v))
        b[3:6] += lean * np.cross(S.rotation @ held.up_u, held.up_v)
        A[6, 6] += s.scaled * v.unit**2
        b[6] += s.scaled * v.unit**2 * (np.log(held.scale) - float(np.log(S.scale)))
        free = 6 if self.metric else 7
        x = np.zeros(7)
        x[:free] = np.linalg.solve(A[:free, :free] + 1e-9 * np.trace(A) * np.eye(free), b[:free])
        turn = Sim3.exp(np.r_[np.zeros(3), x[3:]])
        about = Sim3(turn.scale, turn.rotation, middle + x[:3] - turn.scale * turn.rotation @ middle)
        return about @ S
