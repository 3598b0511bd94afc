"""The information matrix of each edge of the graph, from its covariance and the deformation of chunks.

The paper weighs edges by their confidence instead (A.4), VGGT-Long weighs all alike: `WeightSettings.rule`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.solver import adjoint
from list3r.association.paper.weights import paper_weights
from list3r.memory.core.geometry import skew, stack
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WeightSettings:
    """How edges are weighted."""

    rule: str = "covariance"
    """covariance (what an edge states, and deformation), confidence (the paper's w_uv times the identity), or equal."""
    lever_m: float = 1.0
    """Distance at which a rotation weighs as much as a shift where an edge has no lever, metres; without metric scale
    half the spread of its points replaces it."""
    bending: float = 0.006
    """Standard deviation of a chunk's shape between the supports of two edges, as a share of the support's radius for
    shifts, in radians for rotations, and of the log scale: a prior that loops correct."""
    own_bending: float = 0.013
    """Standard deviation of a chunk's frame, as its edges see it, from its own cameras, in the units of `bending`. It
    does not weight edges: it is part of a chunk's stated covariance, once for the chunk and once for the first chunk
    of the component. Chosen on four simulated videos (seed 101)."""
    least_confidence: float = 0.01
    """Least confidence, in [0, 1], assumed for an edge without a covariance."""
    unmeasured: float = 0.02
    """Standard deviation of an edge without a covariance at confidence 1, as for `bending`."""


_LEAST_SCALE = 1e-4
"""Standard deviation of scale between two chunks whose depth a sensor measured, which state none."""


def information_of(edges: Sequence[Edge], metric: bool, settings: WeightSettings) -> Array:
    """Return the inverse covariances of the edges' tangent errors with deformation, in u's units.

    Shape (E, D, D), D = 6 if metric else 7.
    """
    if settings.rule != "covariance":
        equal = _equal_information(edges, metric, settings)
        if settings.rule == "equal":
            return equal
        return equal * np.maximum(paper_weights(np.array([e.confidence for e in edges])), 1e-6)[:, None, None]
    size = 6 if metric else 7
    covariance = np.empty((len(edges), 7, 7))
    measured = np.array([e.covariance is not None for e in edges], bool)
    if measured.any():
        covariance[measured] = _with_bending(
            np.array([e.covariance for e in edges if e.covariance is not None]), settings
        )
    for k in np.flatnonzero(~measured).tolist():
        covariance[k] = _unmeasured(edges[k], metric, settings)
    if not metric:  # chunks with a sensor's depth beside others
        covariance[:, 6, 6] = np.maximum(covariance[:, 6, 6], _LEAST_SCALE**2)
    inverse = np.linalg.inv(covariance[:, :size, :size])
    return np.asarray((inverse + np.swapaxes(inverse, 1, 2)) / 2.0)


def own_shapes(edges: Sequence[Edge], row: Mapping[int, int], count: int, settings: WeightSettings) -> Array:
    """Return covariances of chunks' frames from their own deformation, about the centre of their edges' support, chunk
    units.

    Shape (K, 7, 7), 0 for chunks without an edge that states a covariance.
    """
    stated = [e for e in edges if e.covariance is not None]
    out, seen = np.zeros((count, 7, 7)), np.zeros(count)
    if stated:
        covariance = np.array([e.covariance for e in stated])
        shape = _with_bending(covariance, settings) - covariance
        moved = adjoint(stack([e.S_v_u for e in stated]))
        rows = np.array([[row[e.u], row[e.v]] for e in stated])
        np.add.at(out, rows[:, 0], shape)
        np.add.at(out, rows[:, 1], moved @ shape @ np.swapaxes(moved, 1, 2))
        np.add.at(seen, rows, 1)
    return np.asarray(out * (settings.own_bending / settings.bending) ** 2 / np.maximum(seen, 1)[:, None, None])


def lever_of(edge: Edge, metric: bool, settings: WeightSettings) -> float | None:
    """Return half the spread of an edge's points in u's units; None where it is not stated."""
    if metric or "spread" not in edge.scores:
        return settings.lever_m if metric else None
    return max(0.5 * edge.scores["spread"] / float(edge.S_v_u.scale), 1e-9)


def _equal_information(edges: Sequence[Edge], metric: bool, settings: WeightSettings) -> Array:
    """Return the same information for every edge, angles and shifts in one unit. Shape (E, D, D)."""
    levers = [lever for e in edges if (lever := lever_of(e, metric, settings)) is not None]
    lever = float(np.median(levers)) if levers else settings.lever_m
    unit = np.array([lever] * 3 + [1.0] * (3 if metric else 4)) * settings.unmeasured
    return np.tile(np.diag(1.0 / unit**2), (len(edges), 1, 1))


def _unmeasured(edge: Edge, metric: bool, settings: WeightSettings) -> Array:
    """Return the covariance of an edge that states none. Shape (7, 7)."""
    lever = lever_of(edge, metric, settings) or settings.lever_m
    deviation = settings.unmeasured / np.sqrt(max(edge.confidence, settings.least_confidence))
    unit = np.array([lever] * 3 + [1.0] * 4)
    return np.asarray(np.diag(unit**2 * (deviation**2 + settings.bending**2)))


def _with_bending(covariance: Array, settings: WeightSettings) -> Array:
    """Return covariances with deformation about the centre of each edge's support. Shape (E, 7, 7)."""
    center, radius = support_of(covariance)
    shape = about(center)
    shape[:, :, :3] *= radius[:, None, None]
    return np.asarray(covariance + settings.bending**2 * shape @ np.swapaxes(shape, 1, 2))


def about(center: Array) -> Array:
    """Return matrices that take tangents about centres to tangents about the origin. Shape (E, 3) -> (E, 7, 7)."""
    out = np.tile(np.eye(7), (len(center), 1, 1))
    out[:, :3, 3:6], out[:, :3, 6] = skew(center), -center
    return out


def support_of(covariance: Array) -> tuple[Array, Array]:
    """Return centre and radius of the support of alignments with these covariances. Shapes (E, 3) and (E,).

    About the centre the errors of shift and turn are independent, which gives the centre; the ratio of their
    deviations is the radius. 0 and 1 where the turn has no error.
    """
    turn = covariance[:, 3:6, 3:6]
    size = np.trace(turn, axis1=1, axis2=2)
    exact = ~(size > 0)
    steady = np.where(exact[:, None, None], np.eye(3), turn + 1e-9 * size[:, None, None] * np.eye(3))
    cross = np.swapaxes(np.linalg.solve(steady, np.swapaxes(covariance[:, :3, 3:6], 1, 2)), 1, 2)
    center = 0.5 * np.stack(
        [cross[:, 2, 1] - cross[:, 1, 2], cross[:, 0, 2] - cross[:, 2, 0], cross[:, 1, 0] - cross[:, 0, 1]], axis=1
    )
    center[exact] = 0.0
    back = about(-center)
    shift = np.trace((back @ covariance @ np.swapaxes(back, 1, 2))[:, :3, :3], axis1=1, axis2=2)
    return center, np.where(exact, 1.0, np.sqrt(np.maximum(shift, 1e-18) / np.where(exact, 1.0, size)))
