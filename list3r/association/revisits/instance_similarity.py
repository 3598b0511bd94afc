"""Compare the instances of two chunks as evidence for a revisit (paper 3.2: s_sem, s_rel, s_loop).

Pairs P_uv are mutual nearest neighbours in the feature space, and s_sem is their mean cosine. The layout score s_rel
does not depend on the unknown scale and rotation between the chunks: distances between matched instances are compared
by their ratio, and triples of instances by their orientation, seen from above. Repeated objects make nearest neighbours
wrong, so the layout is scored on the largest consistent set of pairs among several candidates for each instance; a
place with merely the same kinds of objects has no such set, and s_rel vetoes it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.store.tables.local_instances import LocalNode

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class SimilaritySettings:
    """How instances of two chunks are compared."""

    least_cosine: float = 0.5
    """Least cosine of two features for their instances to be candidates for one object."""
    candidates: int = 3
    """Most candidates for an instance."""
    cosine_margin: float = 0.08
    """Candidates within this of the best cosine are kept as well."""
    most_instances: int = 40
    """Instances compared of a chunk, those seen in most frames first."""
    sigma: float = 0.15
    """Difference of two log distances at which a pair of pairs counts 1/e."""
    least_lean: float = 0.25
    """Least height of a triple's normal over its area, in [0, 1], from which its orientation seen from above counts."""
    consistent: float = 0.37
    """Least score of a pair of pairs for both to belong to one layout (1/e: one sigma)."""


@dataclass(frozen=True)
class InstanceSet:
    """The instances of one chunk that can be recognised: static and no structure, N of them."""

    local_id: Ints
    """Shape (N,)."""
    feature: Array
    """Unit length. Shape (N, D)."""
    center: Array
    """Centre of the support, chunk units. Shape (N, 3)."""
    size: Array
    """Diagonal of the support's box without its outermost tenths, chunk units. Shape (N,)."""
    up: Array
    """Mean upward direction of the cameras, unit length or 0 where unknown. Shape (3,)."""
    space: str
    """Embedding space of the features."""


@dataclass(frozen=True)
class InstanceSimilarity:
    """Agreement of the instances of two chunks."""

    s_sem: float
    """Mean cosine of the mutual nearest neighbours, in [0, 1]; 0 without any."""
    s_rel: float
    """Consistency of the layout, in [0, 1]; 0 with fewer than 3 pairs."""
    pairs: tuple[tuple[int, int], ...]
    """Local ids (u, v) of the largest consistent set of pairs; of the mutual nearest ones where there is none."""
    log_scale: float
    """Log of v's units over u's by the layout, NaN where there is none."""


NO_SIMILARITY = InstanceSimilarity(0.0, 0.0, (), float("nan"))


def instance_set(
    nodes: Sequence[LocalNode], T_chunk_cam: NDArray[np.float64], space: str, settings: SimilaritySettings
) -> InstanceSet:
    """Return the instances of a chunk from its local nodes and the poses (G, 4, 4) of its cameras.

    Structure, movers, and instances without a finite feature or support are left out.
    """
    usable = [n for n in nodes if not n.structure and not n.dynamic and _sound(n)]
    usable = sorted(usable, key=lambda n: (-len(n.frames), n.local_id))[: settings.most_instances]
    usable.sort(key=lambda n: n.local_id)
    length = len(usable[0].feature) if usable else 0
    feature = np.array([n.feature for n in usable], np.float64).reshape(len(usable), length)
    low_high = np.array([np.quantile(n.support.points, [0.1, 0.9], axis=0) for n in usable]).reshape(-1, 2, 3)
    up = -T_chunk_cam[:, :3, 1].sum(axis=0) if len(T_chunk_cam) else np.zeros(3)
    return InstanceSet(
        local_id=np.array([n.local_id for n in usable], np.int64),
        feature=feature / np.maximum(np.linalg.norm(feature, axis=1, keepdims=True), 1e-12),
        center=low_high.mean(axis=1),
        size=np.linalg.norm(low_high[:, 1] - low_high[:, 0], axis=1),
        up=up / max(float(np.linalg.norm(up)), 1e-12),
        space=space,
    )


def _sound(node: LocalNode) -> bool:
    points, feature = node.support.points, node.feature
    return len(points) > 0 and bool(np.isfinite(feature).all() and np.isfinite(points).all() and feature.any())


def compare_instances(u: InstanceSet, v: InstanceSet, settings: SimilaritySettings | None = None) -> InstanceSimilarity:
    """Compare the instances of two chunks. Features of two spaces cannot be compared and give no similarity."""
    chosen = settings or SimilaritySettings()
    if u.space != v.space or not len(u.local_id) or not len(v.local_id) or u.feature.shape[1] != v.feature.shape[1]:
        return NO_SIMILARITY
    cosine = u.feature @ v.feature.T
    mutual = _mutual(cosine, chosen)
    s_sem = float(np.clip(cosine[mutual[:, 0], mutual[:, 1]].mean(), 0.0, 1.0)) if len(mutual) else 0.0
    layout, s_rel, log_scale = _layout(u, v, cosine, chosen)
    kept = layout if len(layout) else mutual
    pairs = tuple((int(u.local_id[i]), int(v.local_id[j])) for i, j in kept)
    return InstanceSimilarity(s_sem, s_rel, pairs, log_scale)


def loop_score(s_det: float, similarity: InstanceSimilarity, weight: float) -> float:
    """Return s_loop of the paper, (0 to 2): weight * s_det + (1 - weight) * (s_sem + s_rel)."""
    return weight * s_det + (1.0 - weight) * (similarity.s_sem + similarity.s_rel)


def _mutual(cosine: Array, settings: SimilaritySettings) -> Ints:
    """Return the mutual nearest neighbours. Shape (P, 2)."""
    forth, back = cosine.argmax(axis=1), cosine.argmax(axis=0)
    rows = np.flatnonzero((back[forth] == np.arange(len(cosine))) & (cosine.max(axis=1) >= settings.least_cosine))
    return np.stack([rows, forth[rows]], axis=1)


def _candidates(cosine: Array, settings: SimilaritySettings) -> Ints:
    """Return pairs of instances that may be one object: near the best of either side. Shape (M, 2)."""
    out = np.zeros(cosine.shape, bool)
    for axis in (0, 1):
        best = cosine.max(axis=axis, keepdims=True)
        rank = np.argsort(np.argsort(-cosine, axis=axis, kind="stable"), axis=axis)
        out |= (rank < settings.candidates) & (cosine >= best - settings.cosine_margin)
    return np.argwhere(out & (cosine >= settings.least_cosine))


def _layout(u: InstanceSet, v: InstanceSet, cosine: Array, settings: SimilaritySettings) -> tuple[Ints, float, float]:
    """Return largest set of candidate pairs (P, 2) whose distances agree up to one scale, its score and log scale."""
    pairs = _candidates(cosine, settings)
    none = np.zeros((0, 2), np.int64), 0.0, float("nan")
    if len(pairs) < 3:
        return none
    ratio, sigma = _log_ratios(u, v, pairs, settings)
    best: tuple[float, list[int], float] = (0.0, [], float("nan"))
    for scale in _scales(ratio, sigma):
        agree = np.where(np.isfinite(ratio), np.exp(-np.abs(ratio - scale) / sigma), 0.0)
        chosen = _consistent(agree, cosine[pairs[:, 0], pairs[:, 1]], settings)
        score = float(agree[np.ix_(chosen, chosen)].sum()) / 2
        if score > best[0]:
            best = (score, chosen, scale)
    chosen = best[1]
    if len(chosen) < 3:
        return none
    inside = np.ix_(chosen, chosen)
    upper = np.triu_indices(len(chosen), 1)
    ratios, sigmas = ratio[inside][upper], sigma[inside][upper]
    known = np.isfinite(ratios)
    median = float(np.median(ratios[known]))
    likeness = float(np.where(known, np.exp(-np.abs(np.where(known, ratios - median, 0.0)) / sigmas), 0.0).mean())
    turned = _orientation(u, v, pairs[chosen], settings)
    number = 1.0 - 0.5 ** (len(chosen) - 2)
    return pairs[chosen], likeness * turned * number, median


def _log_ratios(u: InstanceSet, v: InstanceSet, pairs: Ints, settings: SimilaritySettings) -> tuple[Array, Array]:
    """Return the log ratios of distances for each pair of pairs, NaN where they share an instance, and their scatter.
    (M, M)."""
    i, j = pairs.T
    d_u = np.linalg.norm(u.center[i][:, None] - u.center[i][None], axis=-1)
    d_v = np.linalg.norm(v.center[j][:, None] - v.center[j][None], axis=-1)
    apart = (i[:, None] != i[None]) & (j[:, None] != j[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(apart & (d_u > 1e-12) & (d_v > 1e-12), np.log(d_v / d_u), np.nan)
        # The centre of an instance seen from one side only is off by a part of its size.
        loose = [np.hypot(s[:, None], s[None]) / np.maximum(d, 1e-12) for s, d in ((u.size[i], d_u), (v.size[j], d_v))]
    return ratio, settings.sigma * np.clip(np.maximum(loose[0], loose[1]), 0.5, 2.0)


def _scales(ratio: Array, sigma: Array, most: int = 4) -> list[float]:
    """Return the likeliest common log ratios: modes of a smooth histogram."""
    upper = np.triu_indices(len(ratio), 1)
    values, widths = ratio[upper], sigma[upper]
    known = np.isfinite(values)
    if not known.any():
        return []
    values, widths = values[known], widths[known]
    grid = np.arange(values.min() - 0.1, values.max() + 0.15, 0.05)[:400]
    votes = np.exp(-np.abs(grid[:, None] - values[None]) / widths).sum(axis=1)
    padded = np.concatenate([[-1.0], votes, [-1.0]])
    peaks = np.flatnonzero((votes >= padded[:-2]) & (votes > padded[2:]))
    return [float(grid[p]) for p in sorted(peaks, key=lambda p: (-votes[p], p))[:most]]


def _consistent(agree: Array, cosine: Array, settings: SimilaritySettings) -> list[int]:
    """Return a large set of pairs each of which agrees with every other, grown from best connected pairs of pairs."""
    linked = np.where(agree >= settings.consistent, agree, 0.0)
    strength = (linked @ linked) * (linked > 0) * (cosine[:, None] + cosine[None])
    starts = np.argsort(-np.triu(strength, 1), axis=None, kind="stable")[:12]
    best: tuple[float, list[int]] = (0.0, [])
    for start in starts:
        a, b = divmod(int(start), len(agree))
        if strength[a, b] <= 0:
            break
        chosen = [a, b]
        open_ = (linked[a] > 0) & (linked[b] > 0)
        while open_.any():
            gain = np.where(open_, (linked[chosen].sum(axis=0) + linked @ open_ * 0.1) * cosine, -1.0)
            chosen.append(int(gain.argmax()))
            open_ &= linked[chosen[-1]] > 0
        score = float(linked[np.ix_(chosen, chosen)].sum())
        if score > best[0]:
            best = (score, sorted(chosen))
    return best[1]


def _orientation(u: InstanceSet, v: InstanceSet, pairs: Ints, settings: SimilaritySettings) -> float:
    """2 f - 1, at least 0; f: share of triples of equal orientation seen from above. 1 without a triple that counts."""
    if not u.up.any() or not v.up.any():
        return 1.0
    triples = np.array(list(itertools.combinations(range(len(pairs)), 3))[:2000])
    signs = []
    for side, rows in ((u, pairs[:, 0]), (v, pairs[:, 1])):
        a, b, c = (side.center[rows[triples[:, k]]] for k in range(3))
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
        lean = (normal @ side.up) / np.maximum(length, 1e-12)
        signs.append(np.where(np.abs(lean) > settings.least_lean, np.sign(lean), 0.0))
    sign = signs[0] * signs[1]
    known = sign != 0
    return max(0.0, float(sign[known].mean())) if known.any() else 1.0
