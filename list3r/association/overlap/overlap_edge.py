"""Measure the relation of two chunks that share frames (paper 3.2, instance-aware subsequence merging).

Shared pixels without moving regions, spread evenly over space and instances, are aligned. The same code serves adjacent
chunks and both halves of a loop (chunk u against the window, the window against chunk v).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.alignment import Alignment, AlignmentSettings, align
from list3r.association.overlap.balance import BalancedSupport, balanced_support
from list3r.association.overlap.regions import EdgeSupportSettings, Mask, confident
from list3r.association.overlap.shared_points import Pairs, shared_pairs
from list3r.association.overlap.support import Fit, StaticSupport, static_support
from list3r.association.paper.plain_alignment import plain_align
from list3r.association.paper.support import sampled, without_large_delta
from list3r.frames.base import Camera
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples


@dataclass(frozen=True)
class EdgeSettings:
    """How an edge is measured."""

    method: str = "instances"
    """instances (moving regions leave the support), paper (its support and alignment), or plain (VGGT-Long: all pairs
    with enough confidence)."""
    least_pairs: int = 60
    """Fewest pairs of an edge."""
    least_inliers: float = 0.3
    """Least share of the weight within three residual scales for an edge to be accepted."""
    most_moving: float = 0.9
    """Largest moving share of the confident pairs in an accepted edge."""
    trial_pairs: int = 1500
    """Pairs of a trial alignment."""
    support: EdgeSupportSettings = field(default_factory=EdgeSupportSettings)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)


@dataclass(frozen=True)
class EdgeSupport:
    """The masks of the N pairs of an edge, for pictures."""

    frame: NDArray[np.int64]
    """Frame.index. Shape (N,)."""
    pixel: NDArray[np.int64]
    """Row-major number in the colour image. Shape (N,)."""
    confident: Mask
    """Pairs with enough confidence. Shape (N,)."""
    removed: Mask
    """On a moving region. Shape (N,)."""
    kept: Mask
    """Pairs that the edge uses. Shape (N,)."""


@dataclass(frozen=True)
class MeasuredEdge:
    """An edge and its support."""

    edge: Edge
    moving_u: frozenset[int]
    """Local ids of chunk u that plainly move; merely inconsistent ones leave the support without being named."""
    moving_v: frozenset[int]
    """Local ids of chunk v that plainly move."""
    support: EdgeSupport


@dataclass(frozen=True)
class EdgeEnd:
    """One of two chunks that share frames."""

    chunk_id: int
    samples: FrameSamples
    dynamic: Collection[int] = ()
    """Local ids of instances known to move (`motion.flag_dynamic`), which are left out."""


def measure_edge(
    u: EdgeEnd,
    v: EdgeEnd,
    camera: Camera,
    metric: bool,
    settings: EdgeSettings | None = None,
    *,
    kind: str = "adjacent",
) -> MeasuredEdge:
    """Measure the edge between two chunks that share frames, a rigid one when `metric`.

    `camera` is that of the colour images. Raises `DegenerateError` where the shared points determine no transform; an
    edge whose points do not agree is returned with `accepted` false and the reason.
    """
    chosen = settings or EdgeSettings()
    try:
        pairs = shared_pairs(u.samples, v.samples)
        if len(pairs) < chosen.least_pairs:
            raise DegenerateError(f"only {len(pairs)} points are shared; at least {chosen.least_pairs} are needed")
        known = np.isin(pairs.instance_u, list(u.dynamic)) | np.isin(pairs.instance_v, list(v.dynamic))
        static, support, found = _aligned(pairs, known, camera, metric, chosen)
    except DegenerateError as error:
        raise DegenerateError(f"chunks {u.chunk_id} and {v.chunk_id} cannot be aligned: {error}") from error
    return MeasuredEdge(
        edge=_edge(static, support, found, (u.chunk_id, v.chunk_id), kind, chosen),
        moving_u=static.moving_u,
        moving_v=static.moving_v,
        support=EdgeSupport(pairs.frame, pairs.pixel, static.confident, static.removed, support.used),
    )


def _aligned(
    pairs: Pairs, known: Mask, camera: Camera, metric: bool, settings: EdgeSettings
) -> tuple[StaticSupport, BalancedSupport, Alignment]:
    """Choose the support of an edge and align it; without instances where they leave too little."""
    if settings.method != "instances":
        if settings.method == "paper":
            static = without_large_delta(pairs, camera, settings.support)
            support = sampled(pairs, static)
        else:
            static, support = _confident_support(pairs, settings.support)
        return static, support, plain_align(support.p_u, support.p_v, support.weight, support.frame, metric)
    static = static_support(pairs, camera, _trial_fit(metric, settings), settings.support, known)
    support = balanced_support(pairs, static, camera, settings.support)
    try:
        found = _align(support, metric, settings)
    except DegenerateError:
        if not static.removed.any():
            raise
        static, support = _confident_support(pairs, settings.support)
        found = _align(support, metric, settings)
    return static, support, found


def _align(s: BalancedSupport, metric: bool, settings: EdgeSettings) -> Alignment:
    return align(s.p_u, s.p_v, s.weight, s.frame, metric, settings.alignment)


def _trial_fit(metric: bool, settings: EdgeSettings) -> Fit:
    """Return a robust alignment of a thinned part of the pairs."""

    def fit(pairs: Pairs, mask: Mask) -> Sim3:
        rows = np.flatnonzero(mask)
        if len(rows) > settings.trial_pairs:
            rows = rows[np.linspace(0, len(rows) - 1, settings.trial_pairs).astype(np.int64)]
        found = align(
            pairs.p_u[rows], pairs.p_v[rows], pairs.weight[rows], pairs.frame[rows], metric, settings.alignment
        )
        return found.S_v_u

    return fit


def _confident_support(pairs: Pairs, settings: EdgeSupportSettings) -> tuple[StaticSupport, BalancedSupport]:
    """Return all pairs with enough confidence, weighted by their confidence."""
    sure = confident(pairs, settings)
    none = np.zeros(len(pairs), bool)
    nobody: frozenset[int] = frozenset()
    static = StaticSupport(Sim3.identity(), sure, none, nobody, nobody, nobody, nobody, 0.0)
    return static, BalancedSupport(pairs.p_u[sure], pairs.p_v[sure], pairs.weight[sure], pairs.frame[sure], sure)


def _edge(
    static: StaticSupport,
    support: BalancedSupport,
    found: Alignment,
    chunk_ids: tuple[int, int],
    kind: str,
    settings: EdgeSettings,
) -> Edge:
    """Return the record of an edge, accepted or rejected with the reason."""
    shared_frames = len(np.unique(support.frame))
    moving = float((static.removed & static.confident).sum()) / max(1, int(static.confident.sum()))
    reason = (
        f"{found.inliers} of {len(support.weight)} points of {shared_frames} shared frames agree to {found.rms:.4f}"
    )
    if static.removed.any():
        reason += f"; {moving:.0%} of the shared points move and were left out"
    accepted = True
    if found.close < settings.least_inliers:
        width = 3 * settings.alignment.residual_scale * found.spread
        reason, accepted = f"{reason}; only {found.close:.0%} of the weight is within {width:.3f}", False
    elif moving > settings.most_moving:
        reason, accepted = f"{reason}; too little is static", False
    return Edge(
        u=chunk_ids[0],
        v=chunk_ids[1],
        kind=kind,
        S_v_u=found.S_v_u,
        confidence=found.confidence,
        weight=found.confidence if accepted else 0.0,
        inliers=found.inliers,
        residual_m=found.rms,
        accepted=accepted,
        reason=reason,
        scores={
            "pairs": float(len(support.weight)),
            "shared_pairs": float(len(static.confident)),
            "shared_frames": float(shared_frames),
            "spread": found.spread,
            "close": found.close,
            "moving": moving,
            "removed_instances": float(max(len(static.left_out_u), len(static.left_out_v))),
            "delta_max_px": static.delta_max_px,
        },
        covariance=found.covariance,
    )
