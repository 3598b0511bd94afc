"""Decide whether a session is placed in the world of another: by two relations that agree, or by a certain one.

Two relations must be of two pairs of chunks and four keyframes, or of one pair of chunks with frames far apart, or one
by frames and one by instances. A relation is certain with many inlier features, or when all keyframes of both chunks
support it (research/sessions 0134).

Within one video neighbouring chunks share frames, and the chain exposes a false loop. Nothing exposes a false relation
that alone joins two sessions: the whole session would be placed wrongly on top of the old world. Such a relation is
deferred, with the reason, until another agrees with it or a later session connects the two (research/sessions 0049).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from list3r.association.graph.pose_graph import across, chain_poses
from list3r.association.revisits.all_keyframes import WITNESSED
from list3r.association.revisits.further_pairs import FramesApart, are_independent
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge

DEFERRED = "deferred"
"""Score of a deferred relation."""


@dataclass(frozen=True)
class SessionEdgeSettings:
    """When relations place one session in the world of another."""

    agree_m: float = 0.3
    """Two relations agree when their positions of the chunks differ by at most this,"""
    agree_deg: float = 8.0
    """their rotations by at most this,"""
    agree_scale: float = 1.15
    """and their scales by at most this ratio: the possible drift of the chunks between."""
    apart: FramesApart = field(default_factory=FramesApart)
    """When relations of the same two chunks are independent."""
    sure_features: int = 60
    """One relation is certain when this many features agree on it,"""
    sure_overlap: float = 0.6
    """both sides see this share of the same surfaces,"""
    sure_agreement: float = 0.97
    """and this share of them agrees."""


def defer_session_edges(
    edges: Sequence[Edge], session_of: Mapping[int, int], unit: float = 1.0, settings: SessionEdgeSettings | None = None
) -> list[Edge]:
    """Return the edges; relations between sessions are deferred where they do not suffice, and released where they do.

    `session_of` gives the session of every chunk; `unit` is what a metre is in chunk units.
    """
    s = settings or SessionEdgeSettings()
    if len(set(session_of.values())) < 2:
        return list(edges)
    ids = sorted(session_of)
    between = [k for k, e in enumerate(edges) if session_of[e.u] != session_of[e.v] and (e.accepted or _is_deferred(e))]
    own = [e for e in edges if session_of[e.u] == session_of[e.v] and (e.accepted or "trust" in e.scores)]
    blocks = _Blocks(*chain_poses(ids, own), session_of)
    waiting = _by_block(between, edges, blocks)
    while waiting:
        pair = next((p for p, found in waiting.items() if _suffices([edges[k] for k in found], blocks, unit, s)), None)
        if pair is None:
            break
        blocks.join(_best([edges[k] for k in waiting[pair]], blocks, unit, s))
        waiting = _by_block(between, edges, blocks)
    deferred = {k for found in waiting.values() for k in found}
    out = list(edges)
    for k in between:
        if (k in deferred) != _is_deferred(edges[k]):
            out[k] = _deferred(edges[k]) if k in deferred else _released(edges[k])
    return out


class _Blocks:
    """Components of chunks: the frame that each shares, and the chunks' poses in it."""

    def __init__(self, poses: dict[int, Sim3], block: dict[int, int], session_of: Mapping[int, int]) -> None:
        self.poses, self.block, self.session_of = poses, block, session_of

    def offset(self, e: Edge) -> Sim3:
        """Return the similarity that takes u's block into v's by this relation."""
        return across(self.poses[e.v], e, e.v) @ self.poses[e.u].inverse()

    def join(self, e: Edge) -> None:
        """Take u's block into v's, by this relation."""
        S, gone = self.offset(e), self.block[e.u]
        for chunk, block in self.block.items():
            if block == gone:
                self.poses[chunk] = S @ self.poses[chunk]
                self.block[chunk] = self.block[e.v]


def _by_block(between: Sequence[int], edges: Sequence[Edge], blocks: _Blocks) -> dict[tuple[int, int], list[int]]:
    """Return the relations between each two blocks that are not joined yet, in order."""
    out: dict[tuple[int, int], list[int]] = {}
    for k in between:
        a, b = sorted((blocks.block[edges[k].u], blocks.block[edges[k].v]))
        if a != b:
            out.setdefault((a, b), []).append(k)
    return dict(sorted(out.items()))


def _suffices(found: Sequence[Edge], blocks: _Blocks, unit: float, s: SessionEdgeSettings) -> bool:
    return any(_is_sure(e, s) for e in found) or max(_agreeing(found, blocks, unit, s)) >= 2


def _best(found: Sequence[Edge], blocks: _Blocks, unit: float, s: SessionEdgeSettings) -> Edge:
    """Return the relation that most others agree with."""
    votes = _agreeing(found, blocks, unit, s)
    return max(zip(votes, found, strict=True), key=lambda v: (v[0], v[1].confidence, -v[1].u, -v[1].v))[1]


def _agreeing(found: Sequence[Edge], blocks: _Blocks, unit: float, s: SessionEdgeSettings) -> list[int]:
    """Return the number of independent relations that each agrees with, itself included."""
    others = [[f for f in found if are_independent(e, f, blocks.session_of, s.apart)] for e in found]
    return [
        1 + len({(f.u, f.v) for f in rest if _agree(e, f, blocks, unit, s)})
        for e, rest in zip(found, others, strict=True)
    ]


def _agree(e: Edge, f: Edge, blocks: _Blocks, unit: float, s: SessionEdgeSettings) -> bool:
    a = blocks.offset(e)
    same_way = (blocks.block[e.u], blocks.block[e.v]) == (blocks.block[f.u], blocks.block[f.v])
    b = blocks.offset(f) if same_way else blocks.offset(f).inverse()
    rest = a.inverse() @ b
    turn = np.degrees(np.arccos(np.clip((np.trace(rest.rotation) - 1.0) / 2.0, -1.0, 1.0)))
    places = np.array([blocks.poses[e.u].translation, blocks.poses[f.u if same_way else f.v].translation])
    off = float(np.linalg.norm(a.apply(places) - b.apply(places), axis=1).max())
    scale = abs(float(np.log(rest.scale)))
    return off <= s.agree_m * unit and float(turn) <= s.agree_deg and scale <= float(np.log(s.agree_scale))


def _is_sure(e: Edge, s: SessionEdgeSettings) -> bool:
    scores = e.scores
    return WITNESSED in scores or (
        scores.get("feature_inliers", 0.0) >= s.sure_features
        and scores.get("overlap", 0.0) >= s.sure_overlap
        and scores.get("agreement", 0.0) >= s.sure_agreement
    )


def _is_deferred(e: Edge) -> bool:
    return bool(e.scores.get(DEFERRED, 0.0))


def _deferred(e: Edge) -> Edge:
    scores = {k: v for k, v in e.scores.items() if k != "trust"} | {DEFERRED: 1.0}
    reason = f"deferred: no second relation supports this placement of the two sessions ({e.reason})"
    return replace(e, accepted=False, weight=0.0, scores=scores, reason=reason)


def _released(e: Edge) -> Edge:
    scores = {k: v for k, v in e.scores.items() if k != DEFERRED}
    reason = e.reason.removeprefix("deferred: no second relation supports this placement of the two sessions (")
    return replace(e, accepted=True, scores=scores, reason=reason.removesuffix(")"))
