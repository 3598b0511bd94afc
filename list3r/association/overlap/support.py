"""What two chunks may be aligned on: the pixels they share, without what moves (paper 3.2 and A.3).

The same pixel of the same frame is the same surface point in both chunks. Regions are the instances, by the masks of
either chunk, and blocks of the picture where no mask holds the pixel. A region moves when the two chunks place it
differently from what surrounds it. The paper measures that in pixels,

    delta(o) = mean over p in Omega_o of | pi(S_v_u P_u(p)) - phi_uv(p) |,

with phi_uv(p) = p on shared frames. A pixel residual cannot see a thing that is displaced along the ray, which is what
a moving thing mostly does there (its rays are given by the frame), so the share of its depth by which it is displaced
along the ray is measured beside it. Both are held against what the static regions show, never against a fixed limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.shared_points import Pairs, moved
from list3r.frames.base import Camera
from list3r.memory.errors import DegenerateError
from list3r.memory.geometry import Sim3

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Fit = Callable[[Pairs, Mask], Sim3]
"""A robust similarity S_v_u from the pairs that a mask of shape (N,) chooses; raises `DegenerateError`."""


@dataclass(frozen=True)
class EdgeSupportSettings:
    """What counts as confident, as moving, and how the support is spread."""

    confidence_share: float = 0.1
    """Least confidence, as a share of the smaller median of the two chunks (VGGT-Long's rule)."""
    blocks: tuple[int, int] = (4, 3)
    """Columns and rows of blocks into which pixels without an instance are divided."""
    least_region_pairs: int = 12
    """Fewest pairs on which a region is judged."""
    factor: float = 3.0
    """A region moves when it is off by so many times what static regions are off by."""
    deviations: float = 6.0
    """... and by so many robust deviations of the static regions more than they are."""
    least_pixels: float = 0.002
    """... and by no less than this share of the image's width."""
    least_depth: float = 0.01
    """... or, along the ray, this share of its depth."""
    plainly: float = 3.0
    """So many times beyond that limit a region plainly moves; short of it it may as well be wrongly followed or
    badly reconstructed. Both leave the support."""
    rounds: int = 2
    """Rounds of alignment and removal."""
    hypotheses: int = 6
    """Largest regions that are tried as what stands still."""
    patches: tuple[int, int] = (8, 6)
    """Columns and rows of patches, each of which is one correspondence in each frame and region."""
    prior_patches: int = 60
    """Patches of a region that tell as much of its errors as all regions together do (errors last over frames)."""
    least_patches: int = 300
    """Fewer patches than this are taken apart into their pairs again."""
    budget: int = 6000
    """Most correspondences handed to the alignment."""
    patch_kernel: float = 8.0
    """Distance from its patch's median along the ray beyond which a pair has no say (Tukey's biweight), in medians of
    that distance."""
    prior_pairs: int = 20
    """Pairs of a region that tell as much of the scatter within patches as all regions together do."""
    least_region_share: float = 0.05
    """Least variance of a region's patches, as a share of that of all regions."""
    vote_quantile: float = 0.4
    """Quantile of the regions' disagreement with a hypothesis that tells how well it can fit: what stands still is more
    than this share."""
    all_pairs_share: float = 0.98
    """The hypothesis of all pairs is taken where its votes reach this share of the best one's."""
    least_deviation: float = 0.001
    """Disagreement, as a share of the depth, below which chunks are not told to disagree."""


@dataclass(frozen=True)
class Regions:
    """A division of the pairs into R regions by the masks of one chunk."""

    label: Ints
    """Local id of each region, -1 for a block of the picture without an instance. Shape (R,)."""
    of_pair: Ints
    """Region of each pair. Shape (N,)."""
    count: Ints
    """Pairs of each region. Shape (R,)."""


@dataclass(frozen=True)
class Inconsistency:
    """How far the two chunks place each of R regions apart."""

    delta_px: Floats
    """The paper's delta. Shape (R,)."""
    along: Floats
    """Displacement along the ray relative to the frame, as a share of the depth. Shape (R,)."""
    excess: Floats
    """How many times what a static region is off by at most; 0 where there are too few pairs to judge. Shape (R,)."""

    @property
    def moving(self) -> Mask:
        """Shape (R,)."""
        return np.asarray(self.excess > 1.0)


@dataclass(frozen=True)
class StaticSupport:
    """What of the pairs stands still."""

    S_v_u: Sim3
    """The similarity of what stands still, first estimate."""
    confident: Mask
    """Pairs that confidence alone would take. Shape (N,)."""
    removed: Mask
    """Pairs on regions that move. Shape (N,)."""
    left_out_u: frozenset[int]
    """Local ids of chunk u whose regions were removed."""
    left_out_v: frozenset[int]
    """Local ids of chunk v whose regions were removed."""
    moving_u: frozenset[int]
    """Those of chunk u that plainly move."""
    moving_v: frozenset[int]
    """Those of chunk v that plainly move."""
    delta_max_px: float
    """Largest delta of a region that stays."""


def confident(pairs: Pairs, settings: EdgeSupportSettings) -> Mask:
    """Return pairs that confidence alone would take. Shape (N,)."""
    least = settings.confidence_share * min(np.median(pairs.confidence_u), np.median(pairs.confidence_v))
    return np.asarray((pairs.confidence_u > least) & (pairs.confidence_v > least))


def divide(pairs: Pairs, instance: Ints, camera: Camera, settings: EdgeSupportSettings) -> Regions:
    """Return regions by one chunk's instances, and by blocks of the picture where there is none."""
    columns, rows = settings.blocks
    block = (pairs.pixel % camera.width) * columns // camera.width
    block = block + columns * ((pairs.pixel // camera.width) * rows // camera.height)
    key = np.where(instance >= 0, instance, -1 - block)
    values, of_pair, count = np.unique(key, return_inverse=True, return_counts=True)
    return Regions(np.maximum(values, -1), of_pair.ravel().astype(np.int64), count)


def static_support(
    pairs: Pairs, camera: Camera, fit: Fit, settings: EdgeSupportSettings, known: Mask | None = None
) -> StaticSupport:
    """Find what stands still, and the similarity it agrees on, even where a mover covers half of the pairs.

    `known` (N,) are pairs on things that are known to move. Raises `DegenerateError` when no part of the pairs
    determines a similarity.
    """
    sure = confident(pairs, settings)
    known = np.zeros(len(pairs), bool) if known is None else known
    if not (sure & ~known).any():
        raise DegenerateError("no shared point that stands still has enough confidence in both chunks")
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


@dataclass(frozen=True)
class Displacement:
    """How far the two chunks place each of N pairs apart."""

    share: Floats
    """In the camera of v, as a share of the depth. Shape (N, 3)."""
    delta_px: Floats
    """In the picture. Shape (N,)."""
    sure: Mask
    """Pairs that confidence alone would take. Shape (N,)."""
    rest: Mask
    """Those of them that were not removed. Shape (N,)."""


def displacement(pairs: Pairs, S_v_u: Sim3, camera: Camera, sure: Mask, removed: Mask) -> Displacement:
    """Measure how far the two chunks place each pair apart.

    The pose error of a frame displaces all that the frame shows and says nothing of motion, so points are compared in
    the camera of their frame, each chunk's by its own pose, after the frame's common change of scale is taken out;
    where the poses of the two chunks agree worse than their points do, in chunk v.
    """
    off_world = moved(pairs.T_cam_v, S_v_u.apply(pairs.p_u)) - pairs.cam_v
    depth = np.maximum(pairs.cam_v[:, 2], 1e-9)
    delta = np.linalg.norm(_pixels(off_world + pairs.cam_v, camera) - _pixels(pairs.cam_v, camera), axis=1)
    delta = np.minimum(delta, np.hypot(camera.width, camera.height))
    rest = sure & ~removed
    off = relative_to_frame(pairs, S_v_u, rest)
    if _typical(off, depth, rest) > _typical(off_world, depth, rest):
        off = off_world
    return Displacement(off / depth[:, None], delta, sure, rest)


def inconsistency(
    off: Displacement, regions: Regions, frame: Ints, camera: Camera, settings: EdgeSupportSettings
) -> Inconsistency:
    """Tell how far each region is off, and whether that is more than what stands still is off by. `frame` has shape
    (N,)."""
    sure, rest = off.sure, off.rest
    medians, row, weight = _by_region_and_frame(off.share, regions, frame, sure)
    total = np.maximum(np.bincount(row, weight, len(regions.count)), 1e-12)
    focal = np.array([camera.fx, camera.fy])
    across = np.bincount(row, weight * np.linalg.norm(medians[:, :2] * focal, axis=1), len(regions.count)) / total
    along = np.bincount(row, weight * np.abs(medians[:, 2]), len(regions.count)) / total
    judged = np.bincount(regions.of_pair, sure, len(regions.count)) >= settings.least_region_pairs
    still = np.bincount(regions.of_pair, rest, len(regions.count))
    limit_across = _limit(across, still, judged, settings, settings.least_pixels * camera.width)
    limit_along = _limit(along, still, judged, settings, settings.least_depth)
    mean_delta = np.bincount(regions.of_pair, off.delta_px * sure, len(regions.count)) / np.maximum(
        np.bincount(regions.of_pair, sure, len(regions.count)), 1
    )
    excess = np.where(judged, np.maximum(across / limit_across, along / limit_along), 0.0)
    return Inconsistency(mean_delta, along, excess)


def relative_to_frame(pairs: Pairs, S_v_u: Sim3, rest: Mask) -> Floats:
    """Return points of u against those of v in camera of their frame, each by its own chunk's pose. Shape (N, 3)."""
    cam_u = moved(pairs.T_cam_u, pairs.p_u)
    ratio = np.log(np.maximum(pairs.cam_v[:, 2], 1e-9) / np.maximum(cam_u[:, 2], 1e-9))
    frames, which = np.unique(pairs.frame, return_inverse=True)
    common = np.full(len(frames), np.log(float(S_v_u.scale)))
    for k in range(len(frames)):
        mine = ratio[(which == k) & rest]
        if len(mine) >= 8:
            common[k] = np.median(mine)
    return np.asarray(np.exp(common[which.ravel()])[:, None] * cam_u - pairs.cam_v)


# ------------------------------------------------------------------------------------------------ parts


def _best_hypothesis(
    pairs: Pairs, sure: Mask, regions: Regions, fit: Fit, settings: EdgeSupportSettings
) -> tuple[Sim3, Mask]:
    """Return the similarity that most regions agree with (of all pairs, of what has no instance, and of each large
    region), and the pairs of the regions that do not.

    A region counts by the square root of its pairs, so that one thing, however large, is outvoted by a few others, and
    by its extent in space, because what bounds a room is wide.
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
    scale = max(2.0 * min(_weighted_quantile(off, vote, settings.vote_quantile) for _, off in found), 1e-6)
    scores = [float((vote / (1.0 + (np.nan_to_num(off, nan=1e6) / scale) ** 2)).sum()) for _, off in found]
    best = 0 if scores[0] >= settings.all_pairs_share * max(scores) else int(np.argmax(scores))
    doubted = found[best][1] > settings.factor * scale
    return found[best][0], sure & doubted[regions.of_pair]


def _by_region_and_frame(share: Floats, regions: Regions, frame: Ints, sure: Mask) -> tuple[Floats, Ints, Floats]:
    """Return the median displacement of each region in each frame, its region, and its number of pairs."""
    pick = np.flatnonzero(sure)
    _, place = np.unique(frame[pick], return_inverse=True)
    key = regions.of_pair[pick] * (int(place.max()) + 1) + place.ravel()
    order = np.argsort(key, kind="stable")
    bounds = np.flatnonzero(np.diff(key[order], prepend=-1, append=-1))
    medians = np.array([np.median(share[pick[order[a:b]]], axis=0) for a, b in pairwise(bounds)])
    row = regions.of_pair[pick[order[bounds[:-1]]]]
    return medians.reshape(-1, 3), row, np.diff(bounds).astype(np.float64)


def _limit(
    value: Floats, still: NDArray[np.signedinteger], judged: Mask, settings: EdgeSupportSettings, least: float
) -> float:
    """Return what a static region is off by at most, from those that were not removed."""
    vote = np.asarray(np.sqrt(still) * judged, np.float64)
    if not vote.any():
        return float("inf")
    middle = _weighted_quantile(value, vote, 0.5)
    deviation = 1.4826 * _weighted_quantile(np.abs(value - middle), vote, 0.5)
    return max(settings.factor * middle, middle + settings.deviations * deviation, least)


def _ids(regions: Regions, found: Inconsistency, excess: float) -> frozenset[int]:
    return frozenset(int(k) for k in regions.label[found.excess > excess] if k >= 0)


def _pixels(cam: Floats, camera: Camera) -> Floats:
    """Return the pinhole projection, px; a point behind the camera projects far outside. Shape (N, 3) -> (N, 2)."""
    depth = np.maximum(cam[:, 2:], 1e-6)
    return np.asarray(cam[:, :2] / depth * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def _typical(off: Floats, depth: Floats, rest: Mask) -> float:
    return float(np.median(np.linalg.norm(off[rest], axis=1) / depth[rest])) if rest.any() else 0.0


def _extent(points: Floats) -> float:
    if len(points) < 2:
        return 0.0
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))


def median(values: Floats) -> float:
    """Return the median, NaN of nothing."""
    return float(np.median(values)) if len(values) else float("nan")


def _weighted_quantile(values: Floats, weight: Floats, share: float) -> float:
    known = np.asarray(np.isfinite(values) & (weight > 0))
    if not known.any():
        return 0.0
    order = np.argsort(values[known], kind="stable")
    total = np.asarray(np.cumsum(weight[known][order]))
    return float(values[known][order][int(np.searchsorted(total, share * total[-1]))])
