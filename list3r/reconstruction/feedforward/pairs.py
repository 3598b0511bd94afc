"""Poses and depth of a chunk's pictures from pairs: each pair in the camera of its first picture, at its own scale.

A picture's points are the mean over the pairs in which it is the first, brought to one scale. The second picture of a
pair gives the similarity from its own points to the first one's camera. Scales, rotations and translations of all
pictures then follow by least squares, one after the other, over all pairs; pairs that disagree lose weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import umeyama
from list3r.reconstruction.feedforward.output import WindowOutput
from list3r.reconstruction.feedforward.points import from_points

Array = NDArray[np.float64]
_ROUNDS = 10
_TURN = np.radians(2.0)
_SHIFT = 0.05
"""Disagreement of a pair, in radians and in depths of its picture, at which it counts half."""
_LEAST = 0.05
"""Least confidence of a point that counts."""


@dataclass(frozen=True)
class PairPoints:
    """A network's output for two pictures."""

    first: int
    second: int
    points: NDArray[np.float32]
    """Of both pictures, in the first one's camera, at the pair's own scale. Shape (2, h, w, 3)."""
    confidence: NDArray[np.float32]
    """In [0, 1]. Shape (2, h, w)."""


def pair_plan(count: int) -> NDArray[np.int64]:
    """Return the pairs of pictures that are 1, 2, 4, ... apart, in both orders. Shape (P, 2).

    The widest are up to half of all apart, so that both places of a joint window are paired.
    """
    steps = [2**k for k in range(max(1, count.bit_length())) if 2**k <= max(1, count // 2)]
    pairs = [(k, k + step) for step in steps for k in range(count - step)]
    return np.array([*pairs, *((b, a) for a, b in pairs)], np.int64).reshape(-1, 2)


def join_pairs(pairs: Sequence[PairPoints], count: int) -> WindowOutput:
    """Return the output for `count` pictures; those in no pair have no pose."""
    points, confidence, scale_of = _own_points(pairs, count)
    edges = [e for p in pairs if (e := _edge(p, points, confidence, scale_of)) is not None]
    log_scale, R, t = _synchronised(edges, count)
    T = np.full((count, 4, 4), np.nan)
    known = np.isfinite(t).all(axis=1)
    T[known] = np.eye(4)
    T[known, :3, :3], T[known, :3, 3] = R[known], t[known]
    return from_points(T, points * np.exp(log_scale)[:, None, None, None].astype(np.float32), confidence)


@dataclass(frozen=True)
class _PairEdge:
    """Similarity x_first = s R x_second + t between two pictures' own points."""

    first: int
    second: int
    weight: float
    log_scale: float
    R: Array
    t: Array
    depth: float
    """Median depth of the first picture, in its own units."""


def _own_points(
    pairs: Sequence[PairPoints], count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], dict[int, float]]:
    """Return each picture's points in its own camera, their confidence, and the scale of each pair (by its id)."""
    shape = pairs[0].confidence.shape[1:]
    points, sure = np.zeros((count, *shape, 3), np.float32), np.zeros((count, *shape), np.float32)
    scale_of: dict[int, float] = {}
    for k in range(count):
        own = [n for n, p in enumerate(pairs) if p.first == k]
        own.sort(key=lambda n: -float(pairs[n].confidence[0].mean()))
        for n in own:
            p, c = pairs[n].points[0], pairs[n].confidence[0]
            both = (c > _LEAST) & (sure[k] > 0) & (p[..., 2] > 0)
            mean_z = points[k, ..., 2] / np.maximum(sure[k], 1e-6)
            scale_of[id(pairs[n])] = float(np.median(mean_z[both] / p[..., 2][both])) if both.any() else 1.0
            points[k] += c[..., None] * p * np.float32(scale_of[id(pairs[n])])
            sure[k] += c
        points[k] /= np.maximum(sure[k], 1e-6)[..., None]
        sure[k] /= max(len(own), 1)
    return points, sure, scale_of


def _edge(
    pair: PairPoints, points: NDArray[np.float32], confidence: NDArray[np.float32], scale_of: dict[int, float]
) -> _PairEdge | None:
    """Return the similarity from the second picture's points to the first one's, None where too few are confident."""
    a = pair.points[1].reshape(-1, 3).astype(np.float64) * scale_of[id(pair)]
    b = points[pair.second].reshape(-1, 3).astype(np.float64)
    w = np.sqrt(pair.confidence[1].astype(np.float64) * confidence[pair.second]).ravel()
    good = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1) & (w > _LEAST)
    if good.sum() < 12:
        return None
    a, b, w = a[good], b[good], w[good]
    for _ in range(3):
        try:
            S = umeyama(b, a, w, with_scale=True)
        except DegenerateError:
            return None
        off = np.linalg.norm(a - S.apply(b), axis=1)
        w = w / (1.0 + (off / max(2.0 * float(np.median(off)), 1e-9)) ** 2)
    if not S.scale > 0:
        return None
    depth = float(np.median(points[pair.first][..., 2][confidence[pair.first] > 0]))
    return _PairEdge(
        pair.first, pair.second, float(pair.confidence.mean()), float(np.log(S.scale)), S.rotation, S.translation, depth
    )


def _synchronised(edges: Sequence[_PairEdge], count: int) -> tuple[Array, Array, Array]:
    """Return log scales (n,), rotations (n, 3, 3) and translations (n, 3) of pictures in the best connected one.

    x_world = e^s R x_picture + t, so that of an edge s_b = s_a + s_ab, R_b = R_a R_ab, t_b = t_a + e^s_a R_a t_ab. NaN
    translations for pictures without an edge.
    """
    reached = _reached(edges, count)
    used = [e for e in edges if e.first in reached and e.second in reached]
    weight = np.array([e.weight for e in used])
    R, s, t = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count), np.full((count, 3), np.nan)
    if not used:
        t[sorted(reached)[:1]] = 0.0
        return s, R, t
    a, b = (np.array(v) for v in zip(*((e.first, e.second) for e in used), strict=True))
    R_ab, t_ab = np.stack([e.R for e in used]), np.stack([e.t for e in used])
    depth = np.array([e.depth for e in used])
    root, factor = int(np.argmax(np.bincount(np.r_[a, b], np.r_[weight, weight], count))), np.ones(len(used))
    for _ in range(_ROUNDS):
        w = weight * factor
        s = _solved(a, b, w, np.array([e.log_scale for e in used])[:, None], root, count)[:, 0]
        R = _rotations(a, b, w, R_ab, root, count)
        step = np.exp(s[a])[:, None] * np.einsum("nij,nj->ni", R[a], t_ab)
        t = _solved(a, b, w, step, root, count)
        turn = np.arccos(np.clip((np.einsum("nij,nij->n", R[a] @ R_ab, R[b]) - 1) / 2, -1, 1))
        shift = np.linalg.norm(t[b] - t[a] - step, axis=1) / np.maximum(np.exp(s[a]) * depth, 1e-9)
        factor = 1.0 / (1.0 + (turn / _TURN) ** 2 + (shift / _SHIFT) ** 2)
    t[[k for k in range(count) if k not in reached]] = np.nan
    return s, R, t


def _reached(edges: Sequence[_PairEdge], count: int) -> set[int]:
    """Return the largest connected component of pictures."""
    group = list(range(count))
    for e in edges:
        one, two = group[e.first], group[e.second]
        group = [one if g == two else g for g in group]
    largest = max(group, key=group.count, default=0)
    return {k for k, g in enumerate(group) if g == largest}


def _solved(a: NDArray[np.int64], b: NDArray[np.int64], w: Array, steps: Array, root: int, count: int) -> Array:
    """Return x (n, D) with x_b - x_a = steps (E, D) in weighted least squares and x_root = 0."""
    laplacian, right = np.zeros((count, count)), np.zeros((count, steps.shape[1]))
    for (i, j), v in (((a, a), w), ((b, b), w), ((a, b), -w), ((b, a), -w)):
        np.add.at(laplacian, (i, j), v)
    np.add.at(right, b, w[:, None] * steps)
    np.add.at(right, a, -w[:, None] * steps)
    laplacian[root], right[root], laplacian[root, root] = 0.0, 0.0, 1.0
    laplacian[np.diag_indices(count)] += 1e-12
    return np.asarray(np.linalg.lstsq(laplacian, right, rcond=None)[0])


def _rotations(a: NDArray[np.int64], b: NDArray[np.int64], w: Array, R_ab: Array, root: int, count: int) -> Array:
    """Return rotations with R_b = R_a R_ab: the three strongest eigenvectors of the pairs' block matrix, made rigid."""
    blocks, degree = np.zeros((count, count, 3, 3)), np.bincount(np.r_[a, b], np.r_[w, w], count)
    np.add.at(blocks, (a, b), w[:, None, None] * R_ab)
    np.add.at(blocks, (b, a), w[:, None, None] * np.swapaxes(R_ab, 1, 2))
    even = 1.0 / np.sqrt(np.maximum(degree, 1e-12))
    M = (blocks * (even[:, None] * even[None, :])[..., None, None]).transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)
    vectors = np.linalg.eigh(M)[1][:, -3:].reshape(count, 3, 3)
    vectors = vectors if np.linalg.det(vectors[root]) > 0 else vectors * np.array([1.0, 1.0, -1.0])
    u, _, vt = np.linalg.svd(vectors)
    turns = np.einsum("nij,njk->nik", u * np.sign(np.linalg.det(u @ vt))[:, None, None] ** np.array([0, 0, 1]), vt)
    return np.asarray(turns[root] @ np.swapaxes(turns, 1, 2))
