"""Which groups are things and which are fragments: what the other chunks say of the same place."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import Sim3
from list3r.memory.merging import Key, PairScores
from list3r.memory.shapes import ChunkShapes


@dataclass(frozen=True)
class EvidenceSettings:
    """When a group of local instances is shown."""

    min_frames: int = 12
    """A thing seen in fewer frames, over all chunks, is not shown; fewer are asked of a short memory."""
    min_share: float = 0.15
    """Share of all frames that is enough in a short memory, but never fewer than three frames."""
    swallowed: float = 0.75
    """Share of its surface that another chunk gives to one other thing, to speak against it."""
    min_agreement: float = 0.4
    """Share of the chunks that saw its place and found it too."""
    claim_m: float = 0.1
    """Edge of the cells in which the claims of things to a place are counted."""
    claims: int = 4
    """A bit that one chunk alone gives to a thing, and this many to another, is not part of it."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against one group."""

    frames: int
    """Different frames in which it is seen."""
    found: int
    """Chunks that found it."""
    swallowed: int
    """Chunks that saw its place, but as part of another thing."""
    within: tuple[int, ...]
    """Those other things (numbers of groups), the one named most first."""

    @property
    def agreement(self) -> float:
        """Share of the chunks that saw its place and found it as a thing of its own."""
        return self.found / max(self.found + self.swallowed, 1)

    def shown(self, s: EvidenceSettings, all_frames: int) -> bool:
        """Seen in enough of all posed frames, and more chunks for it than against (or nearly, if several found it)."""
        agreed = self.found > self.swallowed or (self.found >= 3 and self.agreement >= s.min_agreement)
        enough = min(s.min_frames, max(3, math.ceil(s.min_share * all_frames)))
        return self.frames >= enough and agreed


def weigh(
    groups: Sequence[Sequence[Key]],
    chunks: Mapping[int, ChunkShapes],
    pairs: Mapping[tuple[int, int], PairScores],
    settings: EvidenceSettings,
) -> list[Evidence]:
    """The evidence for each group, from the scores of all pairs of chunks."""
    home = {k: np.full(len(c.local_id), -1, np.int64) for k, c in chunks.items()}
    frames: list[set[tuple[int, int]]] = []
    for n, group in enumerate(groups):
        seen: set[tuple[int, int]] = set()
        for chunk_id, local_id in group:
            at = int(np.searchsorted(chunks[chunk_id].local_id, local_id))
            home[chunk_id][at] = n
            seen.update((chunks[chunk_id].session_id, int(f)) for f in chunks[chunk_id].frames[at])
        frames.append(seen)
    against: list[dict[int, tuple[float, int]]] = [{} for _ in groups]
    for (u, v), p in sorted(pairs.items()):
        a, b = home[u][p.i], home[v][p.j]
        for inner, outer, cover, chunk in ((a, b, p.i_on_j, v), (b, a, p.j_on_i, u)):
            for e in np.flatnonzero((inner != outer) & (cover >= settings.swallowed)):
                claim = (float(cover[e]), -int(outer[e]))
                against[int(inner[e])][chunk] = max(claim, against[int(inner[e])].get(chunk, claim))
    out = []
    for n, group in enumerate(groups):
        own = {k for k, _ in group}
        votes: dict[int, int] = {}
        for chunk, (_, other) in sorted(against[n].items()):
            if chunk not in own:
                votes[-other] = votes.get(-other, 0) + 1
        ranked = tuple(sorted(votes, key=lambda g: (-votes[g], g)))
        out.append(Evidence(len(frames[n]), len(own), sum(votes.values()), ranked))
    return out


def contested(
    groups: Sequence[Sequence[Key]],
    chunks: Mapping[int, ChunkShapes],
    S_world_chunk: Mapping[int, Sim3],
    unit: float,
    settings: EvidenceSettings,
) -> dict[int, NDArray[np.bool_]]:
    """The points of each chunk that it alone gives to a thing, while several chunks give their place to another one.

    Only things that at least three chunks found lose points so: a chair's back that one chunk took for table.
    """
    names = sorted(chunks)
    group = [np.full(len(chunks[k].local_id), -1, np.int64) for k in names]
    large = np.array([len({k for k, _ in g}) >= 3 for g in groups], dtype=bool)
    for n, members in enumerate(groups):
        for chunk_id, local_id in members:
            group[names.index(chunk_id)][int(np.searchsorted(chunks[chunk_id].local_id, local_id))] = n
    points = np.concatenate([S_world_chunk[k].apply(chunks[k].points) for k in names])
    owner = np.concatenate([g[chunks[k].owner] for g, k in zip(group, names, strict=True)])
    chunk = np.concatenate([np.full(len(chunks[k].points), n) for n, k in enumerate(names)])
    drop = np.zeros(len(points), dtype=bool)
    if len(points):
        cell = np.floor(points / (settings.claim_m * unit)).astype(np.int64)
        _, place = np.unique(cell @ np.array([73856093, 19349663, 83492791]), return_inverse=True)
        claim, at = np.unique(place * len(groups) + owner, return_inverse=True)
        pairs = np.unique(at * len(names) + chunk)
        count = np.bincount(pairs // len(names), minlength=len(claim))
        most = np.zeros(int(place.max()) + 1, np.int64)
        np.maximum.at(most, claim // len(groups), count)
        drop = large[owner] & (count[at] == 1) & (most[place] >= settings.claims)
    split = np.cumsum([len(chunks[k].points) for k in names])[:-1]
    return dict(zip(names, np.split(drop, split), strict=True))
