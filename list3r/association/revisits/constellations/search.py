"""Find loop closures by things alone, where frames that look alike join a chunk to nothing.

What is apart from the new chunk (another session, what lies behind a jump of the picture) is matched whole; of what is
tied to it only what lies near by as the chain of edges has it. Registration costs a tenth of a second for each pair
of chunks, so it is asked only where appearance did not suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.chain import Ways
from list3r.association.revisits.constellations.constellation import (
    Constellation,
    make_constellation,
    typical_depth,
)
from list3r.association.revisits.constellations.matching import match_constellations
from list3r.association.revisits.constellations.registration import (
    ConstellationRegistrationSettings,
    RegisteredChunk,
    Registration,
    covariance,
    doubt,
    register,
)
from list3r.association.revisits.constellations.surface_fit import ChunkSurfaces
from list3r.association.revisits.cross_check import Side
from list3r.memory.geometry import Sim3
from list3r.memory.records import ChunkRow, Edge
from list3r.memory.store.store import Store

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ThingSearchSettings:
    """Where things are asked."""

    enabled: bool = True
    most_apart: int = 60
    """Most chunks apart from the new one whose things are matched, spread over all of them."""
    registered: int = 6
    """Most pairs of chunks that are registered, those whose things match best."""
    near: float = 1.5
    """Chunks tied to the new one are asked where they lie this near, shares of both typical depths."""
    most_near: int = 4
    most_looked: int = 16
    """Chunks whose origins lie nearest, of which it is asked how near they lie; reading all takes long."""
    registration: ConstellationRegistrationSettings = field(default_factory=ConstellationRegistrationSettings)


@dataclass
class _Known:
    """Constellations of an open store, by chunk and what could change them."""

    by_chunk: dict[int, tuple[object, Constellation]] = field(default_factory=dict)
    middles: dict[int, tuple[int | None, Array, float]] = field(default_factory=dict)
    """Checksum, middle of the samples (3,) and typical depth of chunks, chunk units."""


class ThingSearch:
    """The new chunk and the stored ones, as constellations."""

    def __init__(
        self,
        store: Store,
        rows: dict[int, ChunkRow],
        chunk_id: int,
        side: Callable[[int], Side],
        settings: ThingSearchSettings,
    ) -> None:
        self._store, self._rows, self._id, self._side, self._settings = store, rows, chunk_id, side, settings
        self._known = store.derived.of(_Known)
        self._checksums = store.chunks.checksums()

    def edges(self, apart: Sequence[int], tied: Sequence[int], ways: Ways, most_deviations: float) -> list[Edge]:
        """Return loop edges, accepted or rejected, to the chunks that are worth it."""
        s = self._settings
        pick = np.linspace(0, len(apart) - 1, min(len(apart), s.most_apart)).astype(np.int64)
        wanted = [apart[k] for k in pick.tolist()] + self._near(tied)
        if not wanted:
            return []
        here = self._constellation(self._id)
        likely = []
        for u in wanted:
            matches = match_constellations(self._constellation(u), here, self._metric(u), s.registration.matching)
            best = max((m.score for m in matches if len(m.pairs) >= s.registration.least_pairs), default=0.0)
            if best >= s.registration.least_match:
                likely.append((-best, u))
        if not likely:
            return []
        new = self._place(self._id)
        out = []
        for _, u in sorted(likely)[: s.registered]:
            old = self._place(u)
            found = register(old, new, self._metric(u), s.registration)
            if found is not None:
                way = ways.predict(u, self._id) if u in tied else None
                off = None if way is None else way.deviations(found.S_v_u)
                against = doubt(found.scores, s.registration)
                if against is None and off is not None and off > most_deviations:
                    against = f"the way between the chunks contradicts it by {off:.0f} deviations"
                out.append(self._edge(u, old, new, found, against))
        return out

    def _near(self, tied: Sequence[int]) -> list[int]:
        """Return the tied chunks whose things lie nearest to those of the new one, as the neighbour's edge has it."""
        before = [e for e in self._store.edges.all() if e.v == self._id and e.kind == "adjacent" and e.accepted]
        if not before or not tied:
            return []
        S_world_v = self._rows[before[0].u].S_world_chunk @ before[0].S_v_u.inverse()
        middle, reach = self._middle(self._id, S_world_v)
        origins = np.array([self._rows[u].S_world_chunk.translation for u in tied])
        nearest = np.argsort(np.linalg.norm(origins - S_world_v.translation, axis=1), kind="stable")
        out = []
        for u in (tied[k] for k in nearest[: self._settings.most_looked].tolist()):
            other, also = self._middle(u, self._rows[u].S_world_chunk)
            off = float(np.linalg.norm(middle - other)) / (reach + also)
            if off <= self._settings.near / 2:
                out.append((off, u))
        return [u for _, u in sorted(out)[: self._settings.most_near]]

    def _middle(self, chunk_id: int, S_world_chunk: Sim3) -> tuple[Array, float]:
        """Return the middle of a chunk's samples, world, and its typical depth there."""
        state = self._checksums.get(chunk_id)
        held = self._known.middles.get(chunk_id)
        if held is None or held[0] != state:
            samples = self._store.chunks.samples(chunk_id)
            points = samples.points[np.isfinite(samples.points).all(axis=1)]
            middle = np.median(points, axis=0).astype(np.float64) if len(points) else np.zeros(3)
            held = self._known.middles[chunk_id] = state, middle, typical_depth(samples)
        return S_world_chunk.apply(held[1][None])[0], float(S_world_chunk.scale) * held[2]

    def _metric(self, u: int) -> bool:
        return self._rows[u].scale_kind == self._rows[self._id].scale_kind == "metric"

    def _constellation(self, chunk_id: int) -> Constellation:
        state = self._checksums.get(chunk_id), self._store.local_instances.signature(chunk_id)
        held = self._known.by_chunk.get(chunk_id)
        if held is None or held[0] != state:
            nodes = self._store.local_instances.nodes([chunk_id])
            space = self._store.chunks.feature_space(chunk_id)
            made = make_constellation(nodes, self._side(chunk_id), space, self._settings.registration.constellation)
            held = self._known.by_chunk[chunk_id] = state, made
        return held[1]

    def _place(self, chunk_id: int) -> RegisteredChunk:
        c, side = self._constellation(chunk_id), self._side(chunk_id)
        return RegisteredChunk(c, ChunkSurfaces(side, c.unit, self._settings.registration.surfaces), side)

    def _middle_keyframe(self, chunk_id: int) -> int:
        keys, _ = self._store.keyframes.descriptors([chunk_id])
        return int(keys[len(keys) // 2, 1]) if len(keys) else self._rows[chunk_id].first_frame

    def _edge(
        self, u: int, old: RegisteredChunk, new: RegisteredChunk, found: Registration, against: str | None
    ) -> Edge:
        agree = f"{found.scores['pairs']:.0f} things agree on where they stand"
        confidence = float(
            np.clip(
                found.scores["agreement"] * found.scores["fitting"] / self._settings.registration.enough_fitting,
                0.05,
                1.0,
            )
        )
        return Edge(
            u=u,
            v=self._id,
            kind="loop",
            S_v_u=found.S_v_u,
            confidence=confidence,
            weight=0.0 if against else confidence,
            inliers=int(found.scores["pairs"]),
            residual_m=found.fit.residual * new.constellation.unit,
            accepted=against is None,
            reason=f"{agree}; {against}" if against else f"{agree}, and surfaces with them",
            scores={f"things_{name}": value for name, value in found.scores.items()},
            frames=(self._middle_keyframe(u), self._middle_keyframe(self._id)),
            covariance=covariance(old, self._metric(u), self._settings.registration),
        )
