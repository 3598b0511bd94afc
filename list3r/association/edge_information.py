"""How much each edge of the graph has to say: its information matrix, from its covariance, the bending of chunks and
its confidence (paper A.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import skew
from list3r.memory.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WeightSettings:
    """How edges are weighted."""

    alpha: float = 0.30
    """The paper's alpha of the edge weight."""
    sharpness: float = 6.0
    """The paper's exponent g of the edge weight."""
    sharpen: bool = False
    """Multiply the information of edges by the paper's weight; see `information` for why not."""
    lever_m: float = 1.0
    """Distance at which a turn counts as much as a shift where an edge does not say, metres; without metric scale half
    the spread of its points takes its place."""
    bend: float = 0.006
    """Deviation of a chunk's shape between the places where two edges hold it, as a share of the support's radius for
    shifts, in radians for turns, and of the logarithm of scale: a prior that loops correct."""
    unmeasured: float = 0.02
    """The same for the error of an edge without a covariance at confidence 1."""


def edge_weights(confidence: Array, settings: WeightSettings) -> Array:
    """Weights of edges from their confidence m (paper A.4), the strongest edge 1. Shape (E,).

    With the paper's constants all raw weights are below 3.3e-4, so only their ratios mean something.
    """
    grown = np.log1p(settings.alpha * np.clip(confidence, 0.0, 1.0))
    u = grown / (1.0 + grown)
    raw = u**settings.sharpness / (u**settings.sharpness + (1.0 - u) ** settings.sharpness)
    return np.asarray(raw / raw.max() if raw.size and raw.max() > 0 else np.ones_like(raw))


def information(edges: Sequence[Edge], metric: bool, settings: WeightSettings) -> Array:
    """Inverse covariances of the edges' tangent errors with bending, u's units. Shape (E, D, D), D = 6 if metric else 7.

    BASIS
    """
    covariance = np.stack([_covariance(e, metric, settings) for e in edges])
    size = 6 if metric else 7
    inverse = np.linalg.inv(covariance[:, :size, :size])
    inverse = (inverse + np.swapaxes(inverse, 1, 2)) / 2.0
    if settings.sharpen:
        inverse *= np.maximum(edge_weights(np.array([e.confidence for e in edges]), settings), 1e-6)[:, None, None]
    return np.asarray(inverse)


def plain_information(edges: Sequence[Edge], metric: bool, settings: WeightSettings) -> Array:
    """The same for every edge, angles and shifts in one unit: plain least squares. Shape (E, D, D)."""
    levers = [lever for e in edges if (lever := _lever(e, metric, settings)) is not None]
    lever = float(np.median(levers)) if levers else settings.lever_m
    unit = np.array([lever] * 3 + [1.0] * (3 if metric else 4)) * settings.unmeasured
    return np.tile(np.diag(1.0 / unit**2), (len(edges), 1, 1))


def _lever(edge: Edge, metric: bool, settings: WeightSettings) -> float | None:
    """Half the spread of an edge's points in u's units; None where it does not say."""
    if metric or "spread" not in edge.scores:
        return settings.lever_m if metric else None
    return max(0.5 * edge.scores["spread"] / float(edge.S_v_u.scale), 1e-9)


def _covariance(edge: Edge, metric: bool, settings: WeightSettings) -> Array:
    """Covariance of an edge with bending about the middle of its support. Shape (7, 7)."""
    if edge.covariance is None:
        lever = _lever(edge, metric, settings) or settings.lever_m
        deviation = settings.unmeasured / np.sqrt(max(edge.confidence, 1e-2))
        unit = np.array([lever] * 3 + [1.0] * 4)
        return np.diag(unit**2 * (deviation**2 + settings.bend**2))
    center, radius = support_of(edge.covariance)
    shape = np.eye(7)
    shape[:3, 3:6], shape[:3, 6] = skew(center), -center
    shape *= np.array([radius] * 3 + [1.0] * 4)
    return np.asarray(edge.covariance + settings.bend**2 * shape @ shape.T)


def support_of(covariance: Array) -> tuple[Array, float]:
    """Centre and radius of the points that an alignment with this covariance stood on, shape (3,) and a length.

    About the centre the errors of shift and turn are independent, which gives the centre; the ratio of their
    deviations is the radius.
    """
    turn = covariance[3:6, 3:6]
    if not np.trace(turn) > 0:
        return np.zeros(3), 1.0
    ridge = 1e-9 * float(np.trace(turn)) * np.eye(3)
    cross = np.linalg.solve(turn + ridge, covariance[:3, 3:6].T).T
    center = 0.5 * np.array([cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]])
    back = np.eye(7)
    back[:3, 3:6], back[:3, 6] = -skew(center), center
    shift = (back @ covariance @ back.T)[:3, :3]
    return center, float(np.sqrt(max(np.trace(shift) / np.trace(turn), 1e-18)))
