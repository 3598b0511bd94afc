"""Match two constellations: the similarities about the vertical that align most instances with similar ones.

With up known two matched instances determine a similarity (yaw, scale, shift), so all pairs of candidate matches are
tried and each is scored by all other candidates: the largest set of matches that agree, found without sampling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.constellations.constellation import Constellation
from list3r.memory.core.geometry import Sim3

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class MatchingSettings:
    """How instances are matched. Lengths are shares of the chunk's typical depth."""

    candidates: int = 4
    """Most candidates of an instance, the most similar ones."""
    least_likeness: float = 0.4
    """Least log odds of a candidate that two instances are one object, by appearance, colour and shape."""
    scale_range: float = 1.0
    """Largest log of the scale between two chunks without metric scale,"""
    metric_range: float = 0.06
    """and with it."""
    size_range: float = 0.7
    """Largest log ratio of two instances' sizes beyond that scale: each is seen in part."""
    least_apart: float = 0.15
    """Two matches nearer to each other than this determine no direction."""
    place: float = 0.06
    """Standard deviation of an instance's centre between two chunks,"""
    place_of_size: float = 0.22
    """and as a share of its size: the centre of a partial view is nearer to the camera."""
    hypotheses: int = 4000
    """Most pairs of matches that are tried, the likeliest ones."""
    refined: int = 24
    """Best hypotheses that are refined."""
    apart: float = 0.25
    """Two hypotheses are one when they place the instances within this"""
    apart_deg: float = 15.0
    """and within this rotation."""


@dataclass(frozen=True)
class ConstellationMatch:
    """A similarity of two upright frames and its inlier instances."""

    S_v_u: Sim3
    """From the upright frame of u to that of v."""
    pairs: Ints
    """Rows of u's and of v's instances. Shape (P, 2)."""
    score: float
    """Sum of the log odds of the pairs, each reduced by its misfit."""
    misfit: float
    """Root mean square distance of the pairs, in deviations."""


def likeness(u: Constellation, v: Constellation) -> Array:
    """Return the log odds that two instances are one object, by appearance, colour and shape. Shape (N_u, N_v)."""
    out = np.zeros((len(u.local_id), len(v.local_id)))
    if u.space == v.space and u.feature.shape[1] == v.feature.shape[1] and u.feature.shape[1]:
        cosine = u.feature @ v.feature.T
        spread = max(float(cosine.std()), 0.02)
        out += np.clip(1.3 * ((cosine - np.median(cosine)) / spread - 1.2), -1.5, 3.0)
    chroma = np.linalg.norm(u.color[:, None] - v.color[None], axis=-1)
    out += np.clip(0.5 - chroma / 0.08, -0.7, 0.5)
    flat_u, flat_v = (np.log(c.size[:, 2] / np.sqrt(c.size[:, 0] * c.size[:, 1])) for c in (u, v))
    out += np.clip(0.4 - np.abs(flat_u[:, None] - flat_v[None]) / 1.2, -0.6, 0.4)
    return np.asarray(out)


def match_constellations(
    u: Constellation, v: Constellation, metric: bool, settings: MatchingSettings | None = None
) -> list[ConstellationMatch]:
    """Return the best distinct hypotheses, best first; none for too few candidates."""
    s = settings or MatchingSettings()
    if min(len(u.local_id), len(v.local_id)) < 3:
        return []
    odds = likeness(u, v)
    rows = _candidates(odds, s)
    if len(rows) < 3:
        return []
    c = _Candidates(u, v, rows, odds[rows[:, 0], rows[:, 1]], s)
    tried = c.hypotheses(metric)
    if not len(tried.scale):
        return []
    best = np.argsort(-c.scores(tried), kind="stable")[: s.refined]
    found = [c.refined(Sim3(tried.scale[k], tried.rotation[k], tried.translation[k]), metric) for k in best]
    out: list[ConstellationMatch] = []
    for match in sorted((m for m in found if m is not None), key=lambda m: -m.score):
        if not any(_alike(match.S_v_u, other.S_v_u, u, v, s) for other in out):
            out.append(match)
    return out


def _candidates(odds: Array, s: MatchingSettings) -> Ints:
    """Return pairs of instances that may be one object, in order of u. Shape (M, 2)."""
    kept = np.zeros(odds.shape, bool)
    for axis in (0, 1):
        rank = np.argsort(np.argsort(-odds, axis=axis, kind="stable"), axis=axis)
        kept |= rank < s.candidates
    return np.argwhere(kept & (odds >= s.least_likeness))


def _alike(a: Sim3, b: Sim3, u: Constellation, v: Constellation, s: MatchingSettings) -> bool:
    middle = u.center.mean(axis=0, keepdims=True)
    off = float(np.linalg.norm(a.apply(middle) - b.apply(middle)))
    turn = np.degrees(np.arccos(np.clip((np.trace(a.rotation @ b.rotation.T) - 1) / 2, -1, 1)))
    return off <= s.apart * v.unit and float(turn) <= s.apart_deg


class _Candidates:
    """Candidate matches, M of them."""

    def __init__(self, u: Constellation, v: Constellation, rows: Ints, odds: Array, s: MatchingSettings) -> None:
        self._s, self._rows, self._odds = s, rows, odds
        self._a, self._b = u.center[rows[:, 0]], v.center[rows[:, 1]]
        volume_u, volume_v = (np.log(c.size).mean(axis=1) for c in (u, v))
        self._log_size = volume_v[rows[:, 1]] - volume_u[rows[:, 0]]
        size = np.linalg.norm(v.size[rows[:, 1]], axis=1)
        self._sigma = np.hypot(s.place * v.unit, s.place_of_size * size)
        self._units = u.unit, v.unit
        self._first = np.flatnonzero(np.r_[True, np.diff(rows[:, 0]) > 0])
        self._by_v = np.argsort(rows[:, 1], kind="stable")
        self._first_v = np.flatnonzero(np.r_[True, np.diff(rows[self._by_v, 1]) > 0])

    def hypotheses(self, metric: bool) -> Sim3:
        """Return similarities from pairs of matches, batched."""
        s, (unit_u, unit_v) = self._s, self._units
        k, n = np.triu_indices(len(self._rows), 1)
        distinct = (self._rows[k, 0] != self._rows[n, 0]) & (self._rows[k, 1] != self._rows[n, 1])
        k, n = k[distinct], n[distinct]
        d_u, d_v = self._a[n] - self._a[k], self._b[n] - self._b[k]
        flat_u, flat_v = np.linalg.norm(d_u[:, :2], axis=1), np.linalg.norm(d_v[:, :2], axis=1)
        apart = (flat_u > s.least_apart * unit_u) & (flat_v > s.least_apart * unit_v)
        log_scale = np.log(np.maximum(flat_v, 1e-9) / np.maximum(flat_u, 1e-9))
        reach = s.metric_range + 0.3 if metric else s.scale_range
        scale = np.ones_like(log_scale) if metric else np.exp(log_scale)
        level = np.abs(d_v[:, 2] - scale * d_u[:, 2]) < 2.0 * np.hypot(self._sigma[k], self._sigma[n])
        sized = np.maximum(np.abs(self._log_size[k] - log_scale), np.abs(self._log_size[n] - log_scale)) < s.size_range
        rigid = np.abs(flat_v - scale * flat_u) < 2.0 * np.hypot(self._sigma[k], self._sigma[n])
        good = np.flatnonzero(apart & level & sized & rigid & (np.abs(log_scale) < reach))
        odds = self._odds[k[good]] + self._odds[n[good]]
        good = good[np.argsort(-odds, kind="stable")[: s.hypotheses]]
        k, n, scale, d_u, d_v = k[good], n[good], scale[good], d_u[good], d_v[good]
        yaw = np.arctan2(d_v[:, 1], d_v[:, 0]) - np.arctan2(d_u[:, 1], d_u[:, 0])
        R = _about_z(yaw)
        middle_u, middle_v = (self._a[k] + self._a[n]) / 2, (self._b[k] + self._b[n]) / 2
        return Sim3(scale, R, middle_v - scale[:, None] * np.einsum("hij,hj->hi", R, middle_u))

    def scores(self, S: Sim3) -> Array:
        """Return the evidence for each similarity: no instance counts twice on either side. Shape (H,)."""
        gain = self._gain(S)
        of_u = np.maximum.reduceat(gain, self._first, axis=1).sum(axis=1)
        of_v = np.maximum.reduceat(gain[:, self._by_v], self._first_v, axis=1).sum(axis=1)
        return np.asarray(np.minimum(of_u, of_v))

    def _gain(self, S: Sim3) -> Array:
        there = S.scale[:, None, None] * (S.rotation @ self._a.T) + S.translation[:, :, None]
        off = ((there - self._b.T) ** 2).sum(axis=1) / self._sigma**2
        sized = np.abs(self._log_size - np.log(S.scale)[:, None]) < self._s.size_range
        return np.asarray(np.where(sized, self._odds * np.maximum(0.0, 1.0 - off / 2.5**2), 0.0))

    def refined(self, S: Sim3, metric: bool) -> ConstellationMatch | None:
        """Return the match refined from a similarity, None where less than three instances agree."""
        pairs = np.zeros(0, np.int64)
        for _ in range(4):
            gain = self._gain(Sim3(S.scale[None], S.rotation[None], S.translation[None]))[0]
            pairs = self._one_to_one(gain)
            if len(pairs) < 3:
                return None
            S = _fit(self._a[pairs], self._b[pairs], self._odds[pairs] / self._sigma[pairs] ** 2, metric)
        gain = self._gain(Sim3(S.scale[None], S.rotation[None], S.translation[None]))[0][pairs]
        off = np.linalg.norm(S.apply(self._a[pairs]) - self._b[pairs], axis=1) / self._sigma[pairs]
        return ConstellationMatch(S, self._rows[pairs], float(gain.sum()), float(np.sqrt((off**2).mean())))

    def _one_to_one(self, gain: Array) -> Ints:
        used_u: set[int] = set()
        used_v: set[int] = set()
        out = []
        for m in np.argsort(-gain, kind="stable"):
            i, j = (int(n) for n in self._rows[m])
            if gain[m] <= 0:
                break
            if i not in used_u and j not in used_v:
                out.append(int(m))
                used_u.add(i)
                used_v.add(j)
        return np.array(out, np.int64)


def _about_z(yaw: Array) -> Array:
    c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(*yaw.shape, 3, 3)


def _fit(a: Array, b: Array, weight: Array, metric: bool) -> Sim3:
    """Return the similarity about z that takes points a nearest to b. Shapes (P, 3), (P, 3), (P,)."""
    w = weight / weight.sum()
    mean_a, mean_b = w @ a, w @ b
    da, db = a - mean_a, b - mean_b
    cos = float(w @ (da[:, 0] * db[:, 0] + da[:, 1] * db[:, 1]))
    sin = float(w @ (da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]))
    R = _about_z(np.array(np.arctan2(sin, cos)))
    spread_a, spread_b = (float(w @ (d**2).sum(axis=1)) for d in (da, db))  # both sides are noisy
    scale = 1.0 if metric else float(np.sqrt(max(spread_b, 1e-12) / max(spread_a, 1e-12)))
    return Sim3(np.asarray(scale), R, mean_b - scale * R @ mean_a)
