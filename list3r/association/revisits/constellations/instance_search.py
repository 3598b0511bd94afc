"""Find loop closures by instances alone, where similar frames join a chunk to no other.

A chunk in another component (another session, or before a jump of the picture) is always matched; one in the same
component only if the chain of edges places it near. A chunk is registered with its neighbourhood (`neighbourhood`),
which takes half a second a pair, so only where appearance did not suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.chain import EdgeChains
from list3r.association.revisits.constellations.chunk_registration import (
    ConstellationRegistrationSettings,
    RegisteredChunk,
    Registration,
    covariance,
    log_odds,
    refusal,
    register,
)
from list3r.association.revisits.constellations.constellation import (
    Constellation,
    make_constellation,
    typical_depth,
)
from list3r.association.revisits.constellations.matching import match_constellations
from list3r.association.revisits.constellations.neighbourhood import Neighbour, NeighbourhoodSettings, gather
from list3r.association.revisits.constellations.surface_fit import ChunkSurfaces
from list3r.association.revisits.cross_check import Side
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkRow, Edge
from list3r.memory.store.store import Store

Array = NDArray[np.float64]
_BELIEF = "things_belief"


@dataclass(frozen=True)
class InstanceSearchSettings:
    """Where instances are compared."""

    enabled: bool = True
    most_apart: int = 60
    """Most chunks of other components whose instances are matched, spread over all of them."""
    places: int = 4
    """Most chunks that are registered, those whose instances match best,"""
    registered: int = 6
    """and most with the neighbours of the best ones, which repeat the measurement."""
    near: float = 1.5
    """Chunks of the same component are compared within this distance, shares of both typical depths."""
    most_near: int = 4
    most_checked: int = 16
    """Chunks with the nearest origins whose distance is measured; reading all takes long."""
    least_lead: float = 2.0
    """Least difference of the log odds of an accepted relation and of any that places the new chunk elsewhere."""
    elsewhere: float = 1.5
    """Deviations between two relations from which on they are of two places. Relations of one place mostly differ by
    up to 0.3; similar rooms of one floor by 2.7 and more (research/association 0147)."""
    neighbourhood: NeighbourhoodSettings = field(default_factory=NeighbourhoodSettings)
    registration: ConstellationRegistrationSettings = field(default_factory=ConstellationRegistrationSettings)


@dataclass
class _Known:
    """Constellations of an open store, by chunk, with a key of their inputs."""

    by_chunk: dict[tuple[int, ...], tuple[object, Constellation]] = field(default_factory=dict)
    """Of neighbourhoods, by their chunks, the central one first."""
    middles: dict[int, tuple[int | None, Array, float]] = field(default_factory=dict)
    """Checksum, centre of the samples (3,) and typical depth of chunks, chunk units."""


class InstanceSearch:
    """The new chunk and the stored ones, as constellations."""

    def __init__(
        self,
        store: Store,
        rows: dict[int, ChunkRow],
        chunk_id: int,
        side: Callable[[int], Side],
        settings: InstanceSearchSettings,
    ) -> None:
        self._store, self._rows, self._id, self._side, self._settings = store, rows, chunk_id, side, settings
        self._known = store.derived.of(_Known)
        self._checksums = store.chunks.checksums()
        self._neighbours = _neighbours_in_time(store.edges.all(), chunk_id)
        self._here: dict[int, Sim3] = self._members(chunk_id, {})

    def edges(
        self, apart: Sequence[int], tied: Sequence[int], chains: EdgeChains, most_deviations: float
    ) -> list[Edge]:
        """Return the loop edges, accepted or rejected, to the chunks that are registered."""
        s = self._settings
        pick = np.linspace(0, len(apart) - 1, min(len(apart), s.most_apart)).astype(np.int64)
        members: dict[int, dict[int, Sim3]] = {}
        for u in [apart[k] for k in pick.tolist()]:
            if not any(u in held for held in members.values()):
                members[u] = self._members(u, self._here)
        members |= {u: self._members(u, self._here) for u in self._near(tied) if u not in self._here}
        if not members:
            return []
        here = self._constellation(self._here)
        likely = []
        for u in members:
            there = self._constellation(members[u])
            matches = match_constellations(there, here, self._metric(u), s.registration.matching)
            best = max((m.score for m in matches if len(m.pairs) >= s.registration.least_pairs), default=0.0)
            if best >= s.registration.least_match:
                likely.append((-best, u))
        if not likely:
            return []
        new = self._place(self._here)
        out = []
        for u in self._places([u for _, u in sorted(likely)], members, apart):
            old = self._place(members.setdefault(u, self._members(u, self._here)))
            found = register(old, new, self._metric(u), s.registration)
            if found is not None:
                chain = chains.predict(u, self._id) if u in tied else None
                off = None if chain is None else chain.deviations(found.S_v_u)
                against = refusal(found.scores, s.registration)
                if against is None and off is not None and off > most_deviations:
                    against = f"the chain of edges between the chunks contradicts it by {off:.0f} deviations"
                out.append(self._edge(u, old, new, found, against))
        return [self._outdone(e, out, chains) for e in out]

    def _places(self, likely: list[int], members: Mapping[int, Mapping[int, Sim3]], apart: Sequence[int]) -> list[int]:
        """Return the chunks whose neighbourhoods are registered: likely ones, then neighbours of the likeliest."""
        near = [n for u in likely for n in members[u] if n in apart and n not in likely]
        return list(dict.fromkeys([*likely[: self._settings.places], *near]))[: self._settings.registered]

    def _outdone(self, edge: Edge, found: Sequence[Edge], chains: EdgeChains) -> Edge:
        """Return an edge, rejected if there is about as much evidence for another place."""
        if not edge.accepted:
            return edge
        lead = float("inf")
        for other in found:
            chain = chains.predict(other.u, self._id, [edge]) if other is not edge else None
            if chain is not None and chain.deviations(other.S_v_u) > self._settings.elsewhere:
                lead = min(lead, edge.scores[_BELIEF] - other.scores[_BELIEF])
        if lead >= self._settings.least_lead:
            return edge
        why = f"another place fits about as well (log odds {lead:+.1f}); {edge.reason}"
        return replace(edge, accepted=False, weight=0.0, reason=why)

    def _near(self, tied: Sequence[int]) -> list[int]:
        """Return the chunks of the component whose instances are nearest to the new one's, by the neighbour's edge."""
        before = [e for e in self._store.edges.all() if e.v == self._id and e.kind == "adjacent" and e.accepted]
        if not before or not tied:
            return []
        S_world_v = self._rows[before[0].u].S_world_chunk @ before[0].S_v_u.inverse()
        middle, reach = self._middle(self._id, S_world_v)
        origins = np.array([self._rows[u].S_world_chunk.translation for u in tied])
        nearest = np.argsort(np.linalg.norm(origins - S_world_v.translation, axis=1), kind="stable")
        out = []
        for u in (tied[k] for k in nearest[: self._settings.most_checked].tolist()):
            other, also = self._middle(u, self._rows[u].S_world_chunk)
            off = float(np.linalg.norm(middle - other)) / (reach + also)
            if off <= self._settings.near / 2:
                out.append((off, u))
        return [u for _, u in sorted(out)[: self._settings.most_near]]

    def _middle(self, chunk_id: int, S_world_chunk: Sim3) -> tuple[Array, float]:
        """Return the centre of a chunk's samples, world, and its typical depth there."""
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

    def _members(self, chunk_id: int, without: Mapping[int, Sim3]) -> dict[int, Sim3]:
        """Return S_here_chunk of a chunk and of its neighbours, by their ids, itself first."""
        s = self._settings.neighbourhood
        out, edge = {chunk_id: Sim3.identity()}, [chunk_id]
        for _ in range(s.steps):
            step = [(k, n, S_k_n) for k in edge for n, S_k_n in self._neighbours.get(k, ()) if n not in out]
            out |= {n: out[k] @ S_k_n for k, n, S_k_n in step}
            edge = [n for _, n, _ in step]
        middle, depth = self._middle(chunk_id, Sim3.identity())
        off = {n: float(np.linalg.norm(self._middle(n, S)[0] - middle)) / depth for n, S in out.items()}
        size = self._rows[chunk_id].image_size
        near = [n for n in out if off[n] <= s.near and n not in without and self._rows[n].image_size == size]
        near = [n for n in near if n != chunk_id]
        return {n: out[n] for n in [chunk_id, *sorted(near, key=lambda n: (off[n], n))[: s.chunks - 1]]}

    def _constellation(self, members: Mapping[int, Sim3]) -> Constellation:
        key = tuple(members)
        state = tuple((self._checksums.get(n), self._store.local_instances.signature(n)) for n in key)
        held = self._known.by_chunk.get(key)
        if held is None or held[0] != state:
            held = self._known.by_chunk[key] = state, self._made(members)[0]
        return held[1]

    def _made(self, members: Mapping[int, Sim3]) -> tuple[Constellation, Side]:
        s = self._settings
        nodes = {n: self._store.local_instances.nodes([n]) for n in members}
        space = self._store.chunks.feature_space(next(iter(members)))
        parts = [Neighbour(S, nodes[n], self._side(n)) for n, S in members.items()]
        merged, side = gather(parts, space, s.neighbourhood)
        how = s.registration.constellation
        how = how if len(parts) == 1 else replace(how, most_instances=s.neighbourhood.most_instances)
        return make_constellation(merged, side, space, how), side

    def _place(self, members: Mapping[int, Sim3]) -> RegisteredChunk:
        c, side = self._made(members)
        return RegisteredChunk(c, ChunkSurfaces(side, c.unit, self._settings.registration.surfaces), side)

    def _middle_keyframe(self, chunk_id: int) -> int:
        keys, _ = self._store.keyframes.descriptors([chunk_id])
        return int(keys[len(keys) // 2, 1]) if len(keys) else self._rows[chunk_id].first_frame

    def _edge(
        self, u: int, old: RegisteredChunk, new: RegisteredChunk, found: Registration, against: str | None
    ) -> Edge:
        agree = f"{found.scores['pairs']:.0f} instances agree on their positions"
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
            reason=f"{agree}; {against}" if against else f"{agree}, and so do the surfaces",
            scores={f"things_{name}": value for name, value in found.scores.items()}
            | {_BELIEF: log_odds(found.scores, self._settings.registration.belief)},
            frames=(self._middle_keyframe(u), self._middle_keyframe(self._id)),
            covariance=covariance(old, self._metric(u), self._settings.registration),
        )


def _neighbours_in_time(edges: Sequence[Edge], last: int) -> dict[int, list[tuple[int, Sim3]]]:
    """Return the chunks just before and after each, up to the last one, in the camera's order, and S_chunk_other."""
    out: dict[int, list[tuple[int, Sim3]]] = {}
    for e in edges:
        if e.kind == "adjacent" and e.accepted and max(e.u, e.v) <= last:
            out.setdefault(e.u, []).append((e.v, e.S_v_u.inverse()))
            out.setdefault(e.v, []).append((e.u, e.S_v_u))
    return out
