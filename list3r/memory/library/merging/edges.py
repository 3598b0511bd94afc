"""Which local instances are one instance: edges of overlap, joined best first (paper 3.3, with complete links)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.constraints import ConstraintCheck, Constraints, key_name
from list3r.memory.core.geometry import Array
from list3r.memory.core.records import MergeDecision
from list3r.memory.library.merging.nodes import Nodes
from list3r.memory.library.merging.settings import MergeSettings
from list3r.memory.library.overlap.pair_scores import Key, PairTable
from list3r.memory.library.overlap.voxels import Ints

NONE, SAME, PART, PLANE = -1, 0, 1, 2
"""What two local instances that meet may be: nothing to each other, or one instance for one of three reasons."""
_REASON = (
    "two views of one instance: the surfaces cover each other",
    "a partial view: its surface lies on that of the whole",
    "two pieces of one plane that touch",
)
_APART_IOU = 0.02
_PART_SCORE, _PLANE_SCORE, _BY_COVER = 0.3, 0.2, 0.2
"""Scores of partial views and of pieces of planes, all below 0.5, which two whole views begin with."""


@dataclass(frozen=True)
class Links:
    """What argues for each of M pairs of local instances that meet being one instance."""

    a: Ints
    """Position of the first one among the nodes. Shape (M,)."""
    b: Ints
    """Of the second one, which comes later. Shape (M,)."""
    kind: NDArray[np.int8]
    """NONE, SAME, PART or PLANE. Shape (M,)."""
    score: Array
    """By which those that are not NONE are taken, the largest first. Shape (M,)."""
    a_on_b: Array
    """Share of the first one's surface that lies on the second. Shape (M,)."""
    b_on_a: Array
    """The same of the second one. Shape (M,)."""
    cosine: Array
    """Of the features. Shape (M,)."""
    frame_iou: Array
    """Mean IoU of their boxes in the frames that two chunks share; NaN where they share too few. Shape (M,)."""

    def scores_of(self, n: int) -> dict[str, float]:
        """Return the numbers of one pair, for the log."""
        low, high = sorted((self.a_on_b[n], self.b_on_a[n]))
        numbers = {"overlap": low, "containment": high, "cosine": self.cosine[n], "score": self.score[n]}
        if not np.isnan(self.frame_iou[n]):
            numbers["frame_iou"] = self.frame_iou[n]
        return {name: round(float(value), 3) for name, value in numbers.items()}


def form_groups(
    nodes: Nodes,
    links: Links,
    cannot_link: Sequence[tuple[Key, Key]],
    settings: MergeSettings,
    constraints: Constraints | None = None,
) -> tuple[list[list[Key]], list[MergeDecision]]:
    """Group local instances, in one frame of reference, into instances.

    The partition is the same in whatever order chunks and pairs are given: links are taken best first, ties by key. Two
    groups are joined unless a cannot-link pair would come together, or too many pairs across contradict it (complete
    link), or far more chunks tell them apart than see them as one, or the operator's `constraints` part them. What
    these link is joined afterwards, by `Constraints.joined`, so that each half of it goes on attracting what looks like
    it. Returns the groups, each sorted, ordered by their first member, and the decisions: one `merge` for each union,
    one `refuse` for each strong link that was not taken.
    """
    check = constraints.check() if constraints else None
    return _join(nodes, links, _enemies(nodes, cannot_link), settings, check)


# ---------------------------------------------------------------------------------------------- the evidence


def links_of(t: Nodes, p: PairTable, s: MergeSettings) -> Links:
    """Return what argues for local instances that meet being one instance."""
    a, b = p.a, p.b
    low, high = np.minimum(p.a_on_b, p.b_on_a), np.maximum(p.a_on_b, p.b_on_a)
    cosine = np.einsum("ij,ij->i", t.feature[a], t.feature[b]).astype(float)
    across = t.chunk[a] != t.chunk[b]
    enough = (p.shared >= s.min_shared_frames) & across
    larger, smaller = np.maximum(t.size[a], t.size[b]), np.minimum(t.size[a], t.size[b])
    alike = larger < s.max_size_ratio * smaller
    one_mask, apart = enough & (p.frame_iou >= s.same_mask_iou), enough & (p.frame_iou < _APART_IOU)
    coplanar = t.coplanar(a, b, s.max_angle_deg)
    both_structure, one_structure = t.structure[a] & t.structure[b], t.structure[a] ^ t.structure[b]
    same = (low >= s.min_overlap) & (high >= s.min_containment) & (~one_structure | (low >= 0.5) & coplanar)
    same |= one_mask & alike & (high >= s.same_mask_containment) & ~one_structure
    same &= across | (low >= s.min_containment)
    cut = np.where(p.a_on_b >= p.b_on_a, t.truncated[a], t.truncated[b])
    color = np.linalg.norm((t.lab[a] - t.lab[b]) * np.array([0.5, 1.0, 1.0]), axis=1)
    part = (high >= s.part_containment) & (color <= s.max_part_color) & ~one_structure & across
    part &= (cut >= s.min_truncated) | (coplanar & (smaller / np.maximum(larger, 1e-12) >= s.min_part_size))
    piece = both_structure & coplanar & (high >= s.piece_containment)
    base = np.sqrt(low * high)
    score = np.where(
        same, 0.5 + 0.5 * base, np.where(part, _PART_SCORE + _BY_COVER * high, _PLANE_SCORE + _BY_COVER * high)
    )
    score += np.where(one_mask & alike, 0.5 * p.frame_iou, 0.0)
    wanted = (same | part | piece) & (cosine >= s.min_cosine) & ~(apart & ~both_structure)
    kind = np.where(wanted, np.where(same, SAME, np.where(part, PART, PLANE)), NONE).astype(np.int8)
    frame_iou = np.where(enough, p.frame_iou, np.nan)
    return Links(a, b, kind, np.round(score, 6).astype(np.float64), p.a_on_b, p.b_on_a, cosine, frame_iou)


# ---------------------------------------------------------------------------------------------- the decision


def _enemies(t: Nodes, cannot_link: Sequence[tuple[Key, Key]]) -> list[set[int]]:
    at = {key: n for n, key in enumerate(t.keys)}
    out: list[set[int]] = [set() for _ in t.keys]
    for a, b in cannot_link:
        if a in at and b in at:
            out[at[a]].add(at[b])
            out[at[b]].add(at[a])
    return out


class _Overlaps:
    """How far pairs of nodes overlap."""

    def __init__(self, links: Links, count: int) -> None:
        code = np.concatenate([links.a * count + links.b, links.b * count + links.a])
        order = np.argsort(code, kind="stable")
        self._count, self._code = count, code[order]
        self._share = np.concatenate([links.a_on_b, links.b_on_a])[order]

    def on(self, x: Ints, y: Ints) -> Array:
        """Share of the surface of each x that lies on its y; 0 for pairs that do not meet. Shapes broadcast."""
        code = x * self._count + y
        if len(self._code) == 0:
            return np.zeros(code.shape)
        at = np.minimum(np.searchsorted(self._code, code), len(self._code) - 1)
        return np.asarray(np.where(self._code[at] == code, self._share[at], 0.0))

    def of(self, x: Ints, y: Ints) -> Array:
        """The share of the less covered one of each pair."""
        return np.minimum(self.on(x, y), self.on(y, x))


class _Clusters:
    """Groups of nodes that grow: members, boxes, and the nodes that must stay out."""

    def __init__(self, t: Nodes, enemies: list[set[int]]) -> None:
        count = range(len(t.keys))
        self.home = list(count)
        """The cluster of each node."""
        self.members = {n: [n] for n in count}
        self.low, self.high = t.low.copy(), t.high.copy()
        self.foes = {n: set(enemies[n]) for n in count}

    def pair(self, x: int, y: int) -> tuple[int, int]:
        """Return the clusters of two nodes, the one with the smallest member first."""
        a, b = self.home[x], self.home[y]
        return (a, b) if self.members[a][0] <= self.members[b][0] else (b, a)

    def span(self, a: int, b: int) -> float:
        """Return the longest edge of the box round two clusters."""
        return float((np.maximum(self.high[a], self.high[b]) - np.minimum(self.low[a], self.low[b])).max())

    def merge(self, a: int, b: int) -> None:
        """Make two clusters one."""
        kept, gone = (a, b) if len(self.members[a]) >= len(self.members[b]) else (b, a)
        for n in self.members[gone]:
            self.home[n] = kept
        self.low[kept], self.high[kept] = np.minimum(self.low[a], self.low[b]), np.maximum(self.high[a], self.high[b])
        self.foes[kept] = self.foes.pop(a) | self.foes.pop(b)
        self.members[kept] = sorted(self.members.pop(a) + self.members.pop(b))


def _join(
    t: Nodes, links: Links, enemies: list[set[int]], s: MergeSettings, check: ConstraintCheck | None = None
) -> tuple[list[list[Key]], list[MergeDecision]]:
    clusters, overlaps = _Clusters(t, enemies), _Overlaps(links, len(t.keys))
    decisions: list[MergeDecision] = []
    refused: set[tuple[int, int]] = set()
    edges = np.flatnonzero(links.kind != NONE)
    edges = edges[np.lexsort((links.b[edges], links.a[edges], -links.score[edges]))]
    for n, x, y in zip(edges.tolist(), links.a[edges].tolist(), links.b[edges].tolist(), strict=True):
        if clusters.home[x] == clusters.home[y]:
            continue
        a, b = clusters.pair(x, y)
        if (a, b) in refused:
            continue
        against = "" if check is None else check.objection(t.keys[x], t.keys[y])
        against = against or _too_long(t, clusters, a, b, s) or _objection(t, clusters, a, b, overlaps, s)
        against = against or _outvoted(t, clusters, a, b, overlaps, s)
        names, scores = (key_name(t.keys[x]), key_name(t.keys[y])), links.scores_of(n)
        if against:
            refused.add((a, b))
            decisions.append(MergeDecision("refuse", *names, scores, against))
            continue
        decisions.append(MergeDecision("merge", *names, scores, _REASON[links.kind[n]]))
        if check is not None:
            check.join(t.keys[x], t.keys[y])
        clusters.merge(a, b)
        refused = {pair for pair in refused if a not in pair and b not in pair}
    groups = sorted([t.keys[n] for n in ns] for ns in clusters.members.values())
    return groups, decisions


def _too_long(t: Nodes, clusters: _Clusters, a: int, b: int, s: MergeSettings) -> str:
    """Return why two clusters would reach too far together, or nothing."""
    span = clusters.span(a, b)
    unit = max(t.unit[clusters.members[a][0]], t.unit[clusters.members[b][0]])
    return f"together they would reach over {span:.0f} m" if span > s.most_span_m * unit else ""


def _objection(t: Nodes, clusters: _Clusters, a: int, b: int, overlaps: _Overlaps, s: MergeSettings) -> str:
    """Return why two clusters must stay apart, or nothing."""
    members = clusters.members[a], clusters.members[b]
    seen_apart = clusters.foes[a].intersection(members[1])
    if seen_apart:
        return f"{key_name(t.keys[min(seen_apart)])} was seen beside a member of the other in one frame"
    one, other = (np.array(ns)[t.truncated[ns] < s.min_truncated] for ns in members)
    left, right = (x.ravel() for x in np.meshgrid(one, other, indexing="ij"))
    whole = np.maximum(t.size[left], t.size[right]) < s.max_whole_m * np.maximum(t.unit[left], t.unit[right])
    compared = np.flatnonzero(whole & ~t.coplanar(left, right, s.max_angle_deg))
    if len(compared) == 0:
        return ""
    x, y = left[compared], right[compared]
    smaller, larger = np.minimum(t.size[x], t.size[y]), np.maximum(t.size[x], t.size[y])
    offset = np.linalg.norm(t.center[x] - t.center[y], axis=1)
    apart = (overlaps.of(x, y) < s.apart_overlap) & (offset > s.max_center_offset * smaller)
    apart &= larger < s.max_size_ratio * smaller
    if apart.sum() > s.max_conflicts * len(compared):
        return f"{int(apart.sum())} of {len(compared)} pairs of whole views lie apart"
    return ""


def _outvoted(t: Nodes, clusters: _Clusters, a: int, b: int, overlaps: _Overlaps, s: MergeSettings) -> str:
    """Return how many chunks tell two clusters apart and see them as one, where those are far more, or nothing: what
    one chunk saw whole several may well have seen in parts.

    A chunk with a member of either tells them apart, unless one of these covers both: half of a member of either that
    is of another chunk and no larger. It tells nothing where its two lie on one another. Structure, which comes in
    pieces, has no say.
    """
    one, other = (np.array([n for n in clusters.members[c] if not t.structure[n]], np.int64) for c in (a, b))
    beside = t.chunk[one][:, None] == t.chunk[other]
    if not beside.any():
        return ""
    cover = [[_covered(t, x, y, overlaps, s) for y in (one, other)] for x in (one, other)]
    both = np.union1d(t.chunk[one][cover[0][0] & cover[0][1]], t.chunk[other][cover[1][0] & cover[1][1]])
    x, y = one[np.nonzero(beside)[0]], other[np.nonzero(beside)[1]]
    doubled = t.chunk[x[np.maximum(overlaps.on(x, y), overlaps.on(y, x)) >= s.min_containment]]
    apart = np.setdiff1d(t.chunk[x], np.concatenate([both, doubled]))
    told = f"chunks that tell them apart: {len(apart)}, that see them as one: {len(both)}"
    return told if len(apart) > s.max_apart * len(both) else ""


def _covered(t: Nodes, x: Ints, y: Ints, overlaps: _Overlaps, s: MergeSettings) -> NDArray[np.bool_]:
    """Return whether each of the nodes `x` covers any of `y` of another chunk, no larger than it. Shapes (X,), (Y,) ->
    (X,).
    """
    asked = (t.chunk[x][:, None] != t.chunk[y]) & (t.size[x][:, None] >= t.size[y])
    return np.asarray((asked & (overlaps.on(y[None], x[:, None]) >= s.min_containment)).any(axis=1))
