"""Scraps as instances: what is too unlikely to be one thing to be listed, made on demand of what chunks kept of it.

Nothing else is derived from scraps: what is listed, its relations and its changes are the same with and without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from list3r.memory.core.records import FIRST_SCRAP, Instance
from list3r.memory.library.instances import Member, derive_instance
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.summaries import chunk_summaries
from list3r.memory.library.overlap.voxels import ChunkShapes, GrownCells, chunk_shapes, coverage
from list3r.memory.library.rows import record_of
from list3r.memory.library.rules import WORLD, ConsolidationSettings, World, settings_of
from list3r.memory.library.scene import Scene
from list3r.memory.store.store import Store

_SHARED = 0.5
"""Share of its surface that lies on the other, of each of two, for a scrap to be what another chunk found."""


@dataclass(frozen=True)
class Scrap:
    """One of them, with the local instances that it is made of."""

    instance: Instance
    """`confidence` is the probability that a person would call it one thing."""
    members: tuple[Key, ...]
    feature: NDArray[np.float32]
    """Unit length. Shape (D,)."""


def derive_scraps(store: Store) -> list[Scrap]:
    """Return what the chunks kept and no instance is: by id, which is the same as long as the chunks are.

    A scrap that is an instance to another chunk is a view of that instance, and no scrap.
    """
    keys, world = store.local_instances.scraps(), store.facts[WORLD]
    if not keys or world is None:
        return []
    placed = _Placed(store, keys, settings_of(store, None))
    rank = {key: n for n, key in enumerate(keys)}
    pairs = np.array([[rank[a], rank[b]] for a, b in placed.alike()], np.int64).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    groups: dict[int, list[Key]] = {}
    for key, number in zip(keys, connected_components(graph, directed=False)[1].tolist(), strict=True):
        groups.setdefault(number, []).append(key)
    seen = placed.seen_as_things()
    made = [g for g in groups.values() if seen.isdisjoint(g) and all(k in placed.shapes for k, _ in g)]
    return [placed.scrap(FIRST_SCRAP + rank[g[0]], g, world) for g in made]


class _Placed:
    """The scraps of chunks where these lie."""

    def __init__(self, store: Store, keys: Sequence[Key], settings: ConsolidationSettings) -> None:
        self._store, self._settings = store, settings
        world = store.facts[WORLD]
        assert world is not None
        self._summaries = chunk_summaries(store, settings.shapes)
        self._scene = Scene(store, self._summaries, world, settings)
        self._grown = GrownCells()
        self.shapes = {k: self._shapes_of(k) for k in sorted({k for k, _ in keys})}
        """Scraps by chunk."""

    def _shapes_of(self, k: int) -> ChunkShapes:
        chunk, unit = self._store.chunks.get(k), self._summaries[k].unit
        nodes = self._store.local_instances.nodes([k], scraps=True)
        settings = self._settings.shapes
        return chunk_shapes(nodes, chunk.image_size, unit, settings, chunk_id=k, session_id=chunk.session_id)

    def _same(self, a: ChunkShapes, b: ChunkShapes) -> NDArray[np.int64]:
        """Return positions (i, j) of what of two chunks lies on each other. Shape (M, 2)."""
        u, v = (self._scene.pose(x.chunk_id) for x in (a, b))
        a_on_b = coverage(a, b, v.inverse() @ u, self._grown)
        b_on_a = coverage(b, a, u.inverse() @ v, self._grown)
        return np.argwhere(np.minimum(a_on_b, b_on_a.T) >= _SHARED)

    def alike(self) -> list[tuple[Key, Key]]:
        """Return pairs of scraps of different chunks that are one."""
        out: list[tuple[Key, Key]] = []
        for k, own in self.shapes.items():
            for v in (v for v in self._scene.near[k] if v > k and v in self.shapes):
                ids, others = own.local_id, self.shapes[v].local_id
                out += [((k, int(ids[i])), (v, int(others[j]))) for i, j in self._same(own, self.shapes[v])]
        return out

    def seen_as_things(self) -> set[Key]:
        """Return the scraps that are an instance to another chunk."""
        listed = {(o.chunk_id, o.local_id) for o in self._store.observations.all()}
        out: set[Key] = set()
        for k, own in self.shapes.items():
            for v in (v for v in self._scene.near[k] if v != k):
                things = self._summaries[v].shapes
                same = self._same(own, things)
                out |= {(k, int(own.local_id[i])) for i, j in same if (v, int(things.local_id[j])) in listed}
        return out

    def scrap(self, scrap_id: int, group: Sequence[Key], world: World) -> Scrap:
        """Return the scrap that some local ones are."""
        chunks = {k: self._store.chunks.get(k) for k, _ in group}
        members = [
            Member(x, int(np.searchsorted(x.local_id, n)), chunks[k].S_world_chunk, np.zeros(len(x.points), bool))
            for k, n, x in ((k, n, self.shapes[k]) for k, n in group)
        ]
        component = chunks[group[0][0]].component
        upright = world.stands(component)
        found = derive_instance(scrap_id, members, component, upright=upright, settings=self._settings.derive)
        whole = float(np.mean([m.shapes.stability[m.at] for m in members]))
        found = replace(found, geometry=replace(found.geometry, confidence=round(whole, 4)))
        times = {f: t for chunk in chunks.values() for f, t in self._store.frames.times(chunk).items()}
        metric = self._store.facts.scale_kind != "relative"
        return Scrap(record_of(found, None, times, world, metric=metric), tuple(group), found.feature)
