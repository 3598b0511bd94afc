"""Choose the points on which two chunks are aligned: shared pixels without moving regions (paper 3.2 and A.3).

The same pixel of the same frame is the same surface point in both chunks. Regions are the instances, by the masks of
either chunk, and blocks of the picture outside all masks (`regions`); `inconsistency` finds the moving ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from list3r.association.overlap.inconsistency import Inconsistency, displacement, inconsistency
from list3r.association.overlap.regions import (
    EdgeSupportSettings,
    Floats,
    Mask,
    Regions,
    confident,
    divide,
    median,
    weighted_quantile,
)
from list3r.association.overlap.shared_points import Pairs
from list3r.frames.base import Camera
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3

Fit = Callable[[Pairs, Mask], Sim3]
"""A robust similarity S_v_u from the pairs that a mask of shape (N,) chooses; raises `DegenerateError`."""


@dataclass(frozen=True)
class StaticSupport:
    """The static part of the pairs."""

    S_v_u: Sim3
    """First estimate of the similarity of the static part."""
    confident: Mask
    """Pairs with enough confidence. Shape (N,)."""
    removed: Mask
    """Pairs on moving regions. Shape (N,)."""
    left_out_u: frozenset[int]
    """Local ids of chunk u whose regions were removed."""
    left_out_v: frozenset[int]
    """Local ids of chunk v whose regions were removed."""
    moving_u: frozenset[int]
    """Ids of `left_out_u` that plainly move."""
    moving_v: frozenset[int]
    """Ids of `left_out_v` that plainly move."""
    delta_max_px: float
    """Largest delta of a region that stays."""


def static_support(
    pairs: Pairs, camera: Camera, fit: Fit, settings: EdgeSupportSettings, known: Mask | None = None
) -> StaticSupport:
    """Find the static part and its similarity, even where a mover covers half of the pairs.

    `known` (N,) are pairs on instances known to move. Raises `DegenerateError` when no part of the pairs determines a
    similarity.
    """
    sure = confident(pairs, settings)
    known = np.zeros(len(pairs), bool) if known is None else known
    if not (sure & ~known).any():
        raise DegenerateError("no shared static point has enough confidence in both chunks")
    by_u = divide(pairs, pairs.instance_u, camera, settings)
    by_v = divide(pairs, pairs.instance_v, camera, settings)
    S_v_u, doubted = _best_hypothesis(pairs, sure & ~known, by_u, fit, settings)
    removed = known | doubted
    of_u = of_v = None
    for _ in range(settings.rounds):
        off = displacement(pairs, S_v_u, camera, sure, removed)
        of_u, of_v = (inconsistency(off, by, pairs.frame, camera, settings) for by in (by_u, by_v))
        removed_now = known | of_u.moving[by_u.of_pair] | of_v.moving[by_v.of_pair]
        if np.array_equal(removed_now, removed):
            break
        try:
            S_v_u = fit(pairs, sure & ~removed_now)
        except DegenerateError:
            break
        removed = removed_now
    assert of_u is not None and of_v is not None
    staying = np.concatenate([of_u.delta_px[~of_u.moving], of_v.delta_px[~of_v.moving]])
    return StaticSupport(
        S_v_u=S_v_u,
        confident=sure,
        removed=removed,
        left_out_u=_ids(by_u, of_u, 1.0),
        left_out_v=_ids(by_v, of_v, 1.0),
        moving_u=_ids(by_u, of_u, settings.plainly),
        moving_v=_ids(by_v, of_v, settings.plainly),
        delta_max_px=float(np.nanmax(staying)) if np.isfinite(staying).any() else 0.0,
    )


def _best_hypothesis(
    pairs: Pairs, sure: Mask, regions: Regions, fit: Fit, settings: EdgeSupportSettings
) -> tuple[Sim3, Mask]:
    """Return the similarity that most regions agree with (of all pairs, of those without an instance, and of each large
    region), and the pairs of the regions that do not.

    A region counts by the square root of its pairs, so that a few others outvote one large instance, and by its extent
    in space, because walls and floors are wide.
    """
    held = np.bincount(regions.of_pair, sure, len(regions.count))
    extent = np.array([_extent(pairs.p_v[(regions.of_pair == k) & sure]) for k in range(len(held))])
    vote = np.sqrt(held) * np.sqrt(extent / max(float(extent.max()), 1e-12)) * (held >= settings.least_region_pairs)
    masks = [sure, sure & (regions.label[regions.of_pair] < 0)]
    masks += [sure & (regions.of_pair == k) for k in np.argsort(-vote, kind="stable")[: settings.hypotheses]]
    depth = np.maximum(pairs.cam_v[:, 2], 1e-9)
    found: list[tuple[Sim3, Floats]] = []
    failure = DegenerateError("the shared points do not determine a transform")
    for number, mask in enumerate(masks):
        try:
            S_v_u = fit(pairs, mask)
        except DegenerateError as error:
            failure = error if number == 0 else failure
            continue
        off = np.linalg.norm(S_v_u.apply(pairs.p_u) - pairs.p_v, axis=1) / depth
        found.append((S_v_u, np.array([median(off[(regions.of_pair == k) & sure]) for k in range(len(held))])))
    if not found:
        raise failure
    if not vote.any():
        return found[0][0], np.zeros(len(pairs), bool)
    scale = max(2.0 * min(weighted_quantile(off, vote, settings.vote_quantile) for _, off in found), 1e-6)
    scores = [float((vote / (1.0 + (np.nan_to_num(off, nan=1e6) / scale) ** 2)).sum()) for _, off in found]
    best = 0 if scores[0] >= settings.all_pairs_share * max(scores) else int(np.argmax(scores))
    doubted = found[best][1] > settings.factor * scale
    return found[best][0], sure & doubted[regions.of_pair]


def _ids(regions: Regions, found: Inconsistency, excess: float) -> frozenset[int]:
    return frozenset(int(k) for k in regions.label[found.excess > excess] if k >= 0)


def _extent(points: Floats) -> float:
    if len(points) < 2:
        return 0.0
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))
