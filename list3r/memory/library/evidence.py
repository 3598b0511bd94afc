"""Which groups are instances and which are fragments: what the other chunks say of the same place."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3
from list3r.memory.library.overlap.missed import MissedSettings, frames_beside, misses, pictures_confirm
from list3r.memory.library.overlap.pair_scores import Key, Numbering, PairScores, PairTable
from list3r.memory.library.overlap.voxels import ChunkShapes, Ints
from list3r.memory.library.uncertainty import OF_COMPUTED_DEPTH, ConfidenceWeights, Signs, signs_of


@dataclass(frozen=True)
class EvidenceSettings:
    """When a group of local instances is shown."""

    min_frames: int = 12
    """An instance seen in fewer frames, over all chunks, is not shown; fewer are asked of a short memory."""
    min_share: float = 0.15
    """Share of all frames that is enough in a short memory, but never fewer than three frames."""
    swallowed: float = 0.75
    """Share of its surface that another chunk gives to one other instance, to speak against it."""
    covered: float = 0.5
    """Share of its surface on which another chunk has instances of whatever kind, to have seen it."""
    min_agreement: float = 0.4
    """Share of the chunks that saw its place and found it too."""
    least_confidence: float = 0.3
    """What is less probably one thing and all of it is not shown; chosen on walks that the weights were not fitted to,
    where hardly any right one lies below it."""
    odds: ConfidenceWeights = field(default_factory=ConfidenceWeights)
    computed_odds: ConfidenceWeights = field(default_factory=lambda: OF_COMPUTED_DEPTH)
    """The same where depth was computed from colour."""
    claim_m: float = 0.1
    """Edge of the cells in which the claims of instances to a place are counted."""
    claims: int = 4
    """A bit that one chunk alone gives to an instance, and this many to another, is not part of it."""
    looks: MissedSettings = field(default_factory=MissedSettings)
    """When a chunk of computed depth has missed an instance."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against one group."""

    frames: int
    """Different frames of the recording in which it is seen, see `ChunkShapes.stands_for`."""
    found: int
    """Chunks that found it."""
    swallowed: int
    """Chunks that saw its place, but as part of another instance."""
    within: tuple[int, ...]
    """Those other instances (numbers of groups), the one named most first."""
    missed: int = 0
    """Chunks of computed depth that looked at it in frames they share with one that found it, and found nothing."""
    seen: int = 0
    """Chunks that saw its place: those that found it, missed it, gave it to another instance, or, unless its pixels in
    shared frames tell, have instances on half of its surface."""
    confidence: float = 1.0
    """How probably it is one thing and all of it."""
    signs: Signs | None = None
    """What tells so."""

    @property
    def agreement(self) -> float:
        """Share of the chunks that saw its place and found it as an instance of its own."""
        return self.found / max(self.found + self.swallowed + self.missed, 1)

    def shown(self, s: EvidenceSettings, all_frames: int) -> bool:
        """Seen in enough of all posed frames, surely enough one thing, and more chunks for it than against (or nearly,
        if several found it).
        """
        agreed = self.found > self.swallowed + self.missed or (self.found >= 3 and self.agreement >= s.min_agreement)
        enough = min(s.min_frames, max(3, math.ceil(s.min_share * all_frames)))
        return self.frames >= enough and agreed and self.confidence >= s.least_confidence


def weigh(
    groups: Sequence[Sequence[Key]],
    chunks: Mapping[int, ChunkShapes],
    pairs: Mapping[tuple[int, int], PairScores],
    settings: EvidenceSettings,
    wanted: Collection[int] | None = None,
) -> list[Evidence]:
    """Return the evidence for each group, from the scores of all pairs of chunks.

    With `wanted` only these groups are weighed, by the pairs of their chunks, and the others are left without any;
    every local instance of those chunks must be in a group.
    """
    numbering = Numbering(chunks)
    home = numbering.homes(groups)
    weighed = np.zeros(len(groups) + 1, dtype=bool)
    weighed[list(range(len(groups)) if wanted is None else wanted)] = True
    frames = [_frames_of(g, chunks) if weighed[n] else 0 for n, g in enumerate(groups)]
    chunk_of = np.array([k for k, _ in numbering.keys], np.int64)
    meet = PairTable.of(pairs, numbering)
    against: list[dict[int, tuple[float, int]]] = [{} for _ in groups]
    beside = frames_beside(chunks, pairs)
    over = covered(meet, numbering, settings.covered)
    for inner, outer, cover in ((meet.a, meet.b, meet.a_on_b), (meet.b, meet.a, meet.b_on_a)):
        a, b = home[inner], home[outer]
        swallowed = np.flatnonzero((a != b) & weighed[a] & (cover >= settings.swallowed))
        met = zip(inner[swallowed].tolist(), outer[swallowed].tolist(), strict=True)
        agreed = [
            pictures_confirm(numbering.keys[x], numbering.keys[y], chunks, beside, settings.looks.least_share)
            for x, y in met
        ]
        swallowed = swallowed[np.array(agreed, bool)]
        seen_by = chunk_of[outer[swallowed]].tolist()
        rows = zip(a[swallowed].tolist(), b[swallowed].tolist(), cover[swallowed].tolist(), seen_by, strict=True)
        for n, other, share, chunk in rows:
            claim = (share, -other)
            against[n][chunk] = max(claim, against[n].get(chunk, claim))
    out = []
    for n, group in enumerate(groups):
        own = {k for k, _ in group}
        votes: dict[int, int] = {}
        for chunk, (_, other) in sorted(against[n].items()):
            if chunk not in own:
                votes[-other] = votes.get(-other, 0) + 1
        ranked = tuple(sorted(votes, key=lambda g: (-votes[g], g)))
        asked = weighed[n] and not all(_bounds(chunks, key) for key in group)
        silent = {v for u in own for v in beside.get(u, {})} - own - against[n].keys() if asked else set()
        missed = {v for v in silent if misses(v, group, chunks, beside, settings.looks)}
        apart = {v for key in group for v in over.get(key, ()) if v not in beside.get(key[0], {})}
        saw = len(own | against[n].keys() | missed | apart) if weighed[n] else len(own)
        found = Evidence(frames[n], len(own), sum(votes.values()), ranked, len(missed), saw)
        if weighed[n]:
            signs = signs_of(group, chunks, found.frames, found.found / found.seen)
            sure = found.agreement if signs.structure > 0.5 else 1.0
            found = replace(found, confidence=sure * settings.odds.probability(signs), signs=signs)
        out.append(found)
    return out


def covered(meet: PairTable, numbering: Numbering, least: float) -> dict[Key, list[int]]:
    """Return the chunks that have instances on at least this share of the surface of local instances of others."""
    chunk_of = np.array([k for k, _ in numbering.keys], np.int64)
    inner, outer = np.concatenate([meet.a, meet.b]), np.concatenate([meet.b, meet.a])
    cover = np.concatenate([meet.a_on_b, meet.b_on_a])
    chunks, at = np.unique(chunk_of, return_inverse=True)
    apart = chunk_of[inner] != chunk_of[outer]
    code, met = np.unique(inner[apart] * len(chunks) + at[outer[apart]], return_inverse=True)
    share = np.bincount(met, cover[apart])
    out: dict[Key, list[int]] = {}
    for n in code[share >= least].tolist():
        out.setdefault(numbering.keys[n // len(chunks)], []).append(int(chunks[n % len(chunks)]))
    return out


def without_missed(
    before: Mapping[Key, int], groups: Sequence[Sequence[Key]], evidence: Sequence[Evidence], shown: Sequence[bool]
) -> dict[Key, int]:
    """Return the ids of before without those of instances that others looked at and missed, and that lie within no
    other: they were never there, so that no instance goes on with their id.
    """
    gone = {
        key
        for group, e, show in zip(groups, evidence, shown, strict=True)
        if e.missed and not show and not e.within
        for key in group
    }
    return {key: n for key, n in before.items() if key not in gone}


def _bounds(chunks: Mapping[int, ChunkShapes], key: Key) -> bool:
    """Return whether a local instance is a surface that bounds the room, of which each chunk sees what it sees."""
    chunk = chunks.get(key[0])
    return chunk is not None and bool(chunk.structure[int(np.searchsorted(chunk.local_id, key[1]))])


def _frames_of(group: Sequence[Key], chunks: Mapping[int, ChunkShapes]) -> int:
    """Return in how many different frames of the recording a group is seen."""
    seen: dict[tuple[int, int], int] = {}
    for chunk_id, local_id in group:
        if chunk_id in chunks:
            shapes = chunks[chunk_id]
            at = int(np.searchsorted(shapes.local_id, local_id))
            seen |= {(shapes.session_id, f): shapes.stands_for for f in shapes.frames[at].tolist()}
    return sum(seen.values())


def contested(
    groups: Sequence[Sequence[Key]],
    chunks: Mapping[int, ChunkShapes],
    S_world_chunk: Mapping[int, Sim3],
    unit: float,
    settings: EvidenceSettings,
) -> dict[int, NDArray[np.bool_]]:
    """Return which points of each chunk it alone gives to an instance, while several chunks give their place to another
    one. Shape (R,) each.

    Only instances that at least three chunks found lose points so: a chair's back that one chunk took for table.
    """
    names = sorted(chunks)
    number = {k: n for n, k in enumerate(names)}
    group = [np.full(len(chunks[k].local_id), -1, np.int64) for k in names]
    large = np.array([len({k for k, _ in g}) >= 3 for g in groups], dtype=bool)
    for n, members in enumerate(groups):
        for chunk_id, local_id in members:
            if chunk_id in number:
                group[number[chunk_id]][int(np.searchsorted(chunks[chunk_id].local_id, local_id))] = n
    owners = [g[chunks[k].owner] for g, k in zip(group, names, strict=True)]
    drop = {k: np.zeros(len(o), bool) for k, o in zip(names, owners, strict=True)}
    kept = [np.flatnonzero(o >= 0) for o in owners]
    if not any(map(len, kept)):
        return drop
    owner = np.concatenate([o[at] for o, at in zip(owners, kept, strict=True)])
    chunk = np.repeat(np.arange(len(names)), [len(at) for at in kept])
    cells = [claim_cells(chunks[k], S_world_chunk[k], unit, settings)[at] for k, at in zip(names, kept, strict=True)]
    _, place = np.unique(np.concatenate(cells), return_inverse=True)
    claim, at = np.unique(place * len(groups) + owner, return_inverse=True)
    pairs = np.unique(at * len(names) + chunk)
    count = np.bincount(pairs // len(names), minlength=len(claim))
    most = np.zeros(int(place.max()) + 1, np.int64)
    np.maximum.at(most, claim // len(groups), count)
    lost = large[owner] & (count[at] == 1) & (most[place] >= settings.claims)
    for n in np.unique(chunk[lost]).tolist():
        drop[names[n]][kept[n]] = lost[chunk == n]
    return drop


def claim_cells(chunk: ChunkShapes, S_world_chunk: Sim3, unit: float, settings: EvidenceSettings) -> Ints:
    """Return the key of the cell in which each representative point of a chunk lies. Shape (R,)."""
    cell = np.floor(S_world_chunk.apply(chunk.points) / (settings.claim_m * unit)).astype(np.int64) + (1 << 20)
    c = np.clip(cell, 0, (1 << 21) - 1)
    return np.asarray(c[:, 0] << 42 | c[:, 1] << 21 | c[:, 2])
