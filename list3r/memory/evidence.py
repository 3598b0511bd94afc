"""Which groups are things and which are fragments: what the other chunks say of the same place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from list3r.memory.merging import Key, PairScores
from list3r.memory.shapes import ChunkShapes


@dataclass(frozen=True)
class EvidenceSettings:
    """When a group of local instances is shown."""

    min_frames: int = 12
    """A thing seen in fewer frames, over all chunks, is not shown."""
    swallowed: float = 0.75
    """Share of its surface that another chunk gives to one other thing, to speak against it."""
    min_agreement: float = 0.4
    """Share of the chunks that saw its place and found it too."""


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

    def shown(self, s: EvidenceSettings) -> bool:
        """Enough frames, and more chunks for it than against it (or nearly so when several found it)."""
        agreed = self.found > self.swallowed or (self.found >= 3 and self.agreement >= s.min_agreement)
        return self.frames >= s.min_frames and agreed


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
