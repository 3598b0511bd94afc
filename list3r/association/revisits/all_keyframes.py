"""Relate a chunk of one session to one of another by all keyframes of both, where much has changed in between.

Few frames of a changed room in another light are similar, so all pairs of keyframes are compared. Moved objects then
support wrong places, often with several keyframes; so relations that place the chunk equally are grouped, and all
keyframes of both chunks decide between the groups (`chunk_agreement`, research/sessions 0134).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.chunk_agreement import (
    ChunkAgreement,
    ChunkAgreementSettings,
    ChunkKeyframes,
    chunk_agreement,
)
from list3r.association.revisits.verification import VerificationSettings, verify
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, Keyframe

Array = NDArray[np.float64]

WITNESSED = "witnessed"
"""Score of a relation that all keyframes of both chunks support: agreeing share of the common surface, in [0, 1]."""


@dataclass(frozen=True)
class AllKeyframesSettings:
    """Where all keyframes of two chunks are compared, and which place is accepted."""

    chunks: int = 2
    """Most chunks of other sessions that are compared with a new one, those with the most similar frames."""
    keyframes: int = 20
    """Most keyframes of a chunk, spread over it."""
    one_place_m: float = 0.15
    """Two relations are of one place where they place the new one's keyframes within this distance and"""
    one_place_deg: float = 5.0
    """this rotation."""
    least_seen: float = 0.08
    """Least share of either chunk's points that neither keyframe saw and the other chunk did."""
    least_agreement: float = 0.4
    """Least share of these points on a surface of the other, for any normal (`ChunkAgreement.agreement`)."""
    contradicted: float = 0.15
    """Agreement below which a relation is contradicted, whatever else supports it."""
    margin: float = 0.15
    """Least lead of the agreement over that of another place."""
    kept: int = 6
    """Most relations of the accepted place."""
    whole: ChunkAgreementSettings = field(default_factory=ChunkAgreementSettings)


@dataclass(frozen=True)
class _Place:
    """Relations that put a chunk at one place, the best one first, and the agreement of the chunks there."""

    edges: list[Edge]
    whole: ChunkAgreement


def place_by_all_keyframes(
    u: tuple[int, Sequence[Keyframe]],
    v: tuple[int, Sequence[Keyframe]],
    verification: VerificationSettings,
    settings: AllKeyframesSettings | None = None,
) -> list[Edge]:
    """Return accepted relations of chunk v of one session to chunk u of another, none where they are uncertain.

    `u` and `v` are chunk ids and their keyframes, with features and depth in metres.
    """
    s = settings or AllKeyframesSettings()
    (u_id, old), (v_id, new) = (u[0], _spread(u[1], s.keyframes)), (v[0], _spread(v[1], s.keyframes))
    edges = [verify(a, b, u_id, v_id, verification, later=True) for a, b in itertools.product(old, new)]
    measured = [e for e in edges if e.S_v_u.translation.any()]
    if not any(e.accepted for e in measured):
        return []
    views = ChunkKeyframes(old, s.whole), ChunkKeyframes(new, s.whole)
    centers = np.array([k.T_chunk_cam[:3, 3] for k in old])
    places = [_asked(group, *views) for group in _by_place(measured, centers, s)]
    likely = sorted((p for p in places if p.whole.seen >= s.least_seen), key=lambda p: -p.whole.agreement)
    if not likely:
        return []
    best = likely[0].whole.agreement
    unsure = len(likely) > 1 and likely[1].whole.agreement > best - s.margin
    if best < s.least_agreement or unsure:
        return []
    return [_witnessed(e, likely[0].whole) for e in likely[0].edges if e.accepted][: s.kept]


def contradicted(
    edge: Edge, old: Sequence[Keyframe], new: Sequence[Keyframe], settings: AllKeyframesSettings | None = None
) -> bool:
    """Return whether the keyframes of chunks u and v, without those of a relation, contradict it, metres."""
    s = settings or AllKeyframesSettings()
    if edge.frames is None:
        return False
    views = ChunkKeyframes(old, s.whole), ChunkKeyframes(new, s.whole)
    found = chunk_agreement(edge.S_v_u.as_matrix(), *views, edge.frames)
    return found.seen >= s.least_seen and found.agreement < s.contradicted


def _spread(keyframes: Sequence[Keyframe], most: int) -> list[Keyframe]:
    rows = np.linspace(0, len(keyframes) - 1, min(len(keyframes), most)).astype(np.int64)
    return [keyframes[k] for k in rows.tolist()]


def _by_place(edges: Sequence[Edge], centers: Array, s: AllKeyframesSettings) -> list[list[Edge]]:
    """Return relations in groups that put the cameras of u (K, 3) at one place, the best one of each group first."""
    groups: list[list[Edge]] = []
    for edge in sorted(edges, key=lambda e: (not e.accepted, -e.scores["feature_inliers"], e.frames or (0, 0))):
        group = next((g for g in groups if _one_place(edge.S_v_u, g[0].S_v_u, centers, s)), None)
        if group is None:
            groups.append([edge])
        else:
            group.append(edge)
    return groups


def _one_place(a: Sim3, b: Sim3, centers: Array, s: AllKeyframesSettings) -> bool:
    turn = np.degrees(np.arccos(np.clip((np.trace(a.rotation @ b.rotation.T) - 1.0) / 2.0, -1.0, 1.0)))
    off = float(np.linalg.norm(a.apply(centers) - b.apply(centers), axis=1).mean())
    return float(turn) <= s.one_place_deg and off <= s.one_place_m


def _asked(edges: list[Edge], u: ChunkKeyframes, v: ChunkKeyframes) -> _Place:
    best = edges[0]
    assert best.frames is not None
    return _Place(edges, chunk_agreement(best.S_v_u.as_matrix(), u, v, best.frames))


def _witnessed(edge: Edge, found: ChunkAgreement) -> Edge:
    reason = f"{edge.reason}; of the rest that both chunks saw {found.agreement:.0%} agrees"
    return replace(edge, scores=edge.scores | {WITNESSED: found.agreement}, reason=reason)
