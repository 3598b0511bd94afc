"""The memory with what it keeps but does not list, for every question: what is too unlikely to be one thing
(low-confidence segments), and groups for which there is too little evidence.

They are made on demand of what chunks kept. What is listed, its relations and its changes are the same without them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import FIRST_SCRAP, FIRST_UNLISTED, Instance, Observation
from list3r.memory.library.derivation import form
from list3r.memory.library.maintenance.temporary_views import put_before, store_shown
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.summaries import chunk_summaries
from list3r.memory.library.overlap.voxels import ChunkShapes, GrownCells, chunk_shapes, coverage
from list3r.memory.library.rows import record_alone
from list3r.memory.library.rules import settings_of
from list3r.memory.library.scene import Scene
from list3r.memory.library.world.world import WORLD
from list3r.memory.store.rows.columns import UNREADABLE
from list3r.memory.store.store import Store

_SHARED = 0.5
"""Share of the surface of each of two segments that must be on the other, for both to be one."""


@dataclass(frozen=True)
class Unlisted:
    """An instance that is not listed, with the local instances that it is made of."""

    instance: Instance
    members: tuple[Key, ...]
    feature: NDArray[np.float32]
    """Unit length. Shape (D,)."""


def store_with_unlisted(store: Store, min_confidence: float) -> Store:
    """Return a store to read that holds all that is at least so sure to be one thing; close it like any other. What is
    not listed has no relations and no changes.
    """
    return store_shown(store.path, partial(_take_in, min_confidence=min_confidence))


def _take_in(shown: Store, *, min_confidence: float) -> None:
    """Show the file as it is now, with what it does not list."""
    try:
        derived = [*derive_segments(shown), *derive_unlisted(shown)]
    except MemoryFileError:
        raise
    except UNREADABLE as error:
        what = f"what the chunks of {shown.path} found cannot be put together ({error})"
        raise MemoryFileError(f"{what}; run `list3r verify` on the file") from error
    more = [u for u in derived if u.instance.confidence >= min_confidence]
    listed = [i for i in shown.instances.all() if i.confidence >= min_confidence]
    world, connection = shown.facts[WORLD], shown.connection
    put_before(shown, [*listed, *(u.instance for u in more)], "observations", "embeddings")
    ids = "(SELECT id FROM temp.instances)"
    with connection.temporary():
        for table in ("observations", "embeddings"):
            connection.execute(f"INSERT INTO temp.{table} SELECT * FROM main.{table} WHERE instance IN {ids}")
        shown.observations.set(Observation(u.instance.id, *key) for u in more for key in u.members)
        if world is not None and world.space and more:
            features = np.array([u.feature for u in more], np.float32)
            shown.embeddings.put(world.space, [u.instance.id for u in more], features)
        for table in ("relations", "events", "detected_labels"):
            condition = f"subject IN {ids} AND object IN {ids}" if table == "relations" else f"instance IN {ids}"
            connection.execute(f"CREATE TEMP VIEW {table} AS SELECT * FROM main.{table} WHERE {condition}")


def derive_unlisted(store: Store) -> list[Unlisted]:
    """Return the groups that are not listed: by id, which is the same as long as the chunks are.

    What is within a listed instance is a view of that one, what the chunks take for structure in the main is that, and
    what an operator deleted stays away.
    """
    scene = _scene(store)
    if scene is None:
        return []
    formed = form(scene, ended=all(session.state == "complete" for session in store.sessions.all()))
    groups = list(formed.weighed)
    owners = store.observations.owners([key for g in groups for key in g])
    allowed = scene.constraints.shown(groups, [True] * len(groups))
    rank = {key: n for n, key in enumerate(sorted(key for g in groups for key in g))}
    out = []
    for (g, evidence), may in zip(formed.weighed.items(), allowed, strict=True):
        if not may or any(key in owners for key in g) or any(formed.shown[groups[w]] for w in evidence.within):
            continue
        shapes = {k: scene.shapes(k) for k, _ in g}
        if np.mean([_at(shapes, key, "structure") for key in g]) <= 0.5:
            out.append(_unlisted(scene, FIRST_UNLISTED + rank[g[0]], g, shapes, evidence.confidence))
    return sorted(out, key=lambda u: u.instance.id)


def derive_segments(store: Store) -> list[Unlisted]:
    """Return the low-confidence segments: by id, which is the same as long as the chunks are; `confidence` is the
    probability that a person would call one a thing.

    A segment that is an instance to another chunk is a view of that instance.
    """
    keys, scene = store.local_instances.scraps(), _scene(store)
    if not keys or scene is None:
        return []
    segments = _Segments(scene, keys)
    rank = {key: n for n, key in enumerate(keys)}
    pairs = np.array([[rank[a], rank[b]] for a, b in segments.alike()], np.int64).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    groups: dict[int, list[Key]] = {}
    for key, number in zip(keys, connected_components(graph, directed=False)[1].tolist(), strict=True):
        groups.setdefault(number, []).append(key)
    seen = segments.seen_as_instances()
    out = []
    for g in (g for g in groups.values() if seen.isdisjoint(g)):
        whole = float(np.mean([_at(segments.shapes, key, "stability") for key in g]))
        out.append(_unlisted(scene, FIRST_SCRAP + rank[g[0]], g, segments.shapes, whole))
    return out


def _scene(store: Store) -> Scene | None:
    world, settings = store.facts[WORLD], settings_of(store, None)
    return None if world is None else Scene(store, chunk_summaries(store, settings.shapes), world, settings)


def _at(shapes: Mapping[int, ChunkShapes], key: Key, what: str) -> float:
    """Return what the shapes of chunks say of one local instance."""
    return float(getattr(shapes[key[0]], what)[int(np.searchsorted(shapes[key[0]].local_id, key[1]))])


def _unlisted(
    scene: Scene, instance_id: int, group: Sequence[Key], shapes: Mapping[int, ChunkShapes], confidence: float
) -> Unlisted:
    record, feature = record_alone(scene, instance_id, group, shapes, confidence)
    return Unlisted(record, tuple(group), feature)


class _Segments:
    """The low-confidence segments of chunks where these are."""

    def __init__(self, scene: Scene, keys: Sequence[Key]) -> None:
        self._scene, self._grown = scene, GrownCells()
        self.shapes = {k: self._shapes_of(k) for k in sorted({k for k, _ in keys})}
        """By chunk."""

    def _shapes_of(self, k: int) -> ChunkShapes:
        scene, chunk = self._scene, self._scene.rows[k]
        nodes = scene.store.local_instances.nodes([k], scraps=True)
        unit, settings = scene.summaries[k].unit, scene.settings.shapes
        return chunk_shapes(nodes, chunk.image_size, unit, settings, chunk_id=k, session_id=chunk.session_id)

    def _same(self, a: ChunkShapes, b: ChunkShapes) -> NDArray[np.int64]:
        """Return positions (i, j) of what of two chunks is on each other. Shape (M, 2)."""
        u, v = (self._scene.pose(x.chunk_id) for x in (a, b))
        a_on_b = coverage(a, b, v.inverse() @ u, self._grown)
        b_on_a = coverage(b, a, u.inverse() @ v, self._grown)
        return np.argwhere(np.minimum(a_on_b, b_on_a.T) >= _SHARED)

    def alike(self) -> list[tuple[Key, Key]]:
        """Return pairs of segments of different chunks that are one."""
        out: list[tuple[Key, Key]] = []
        for k, own in self.shapes.items():
            for v in (v for v in self._scene.near[k] if v > k and v in self.shapes):
                ids, others = own.local_id, self.shapes[v].local_id
                out += [((k, int(ids[i])), (v, int(others[j]))) for i, j in self._same(own, self.shapes[v])]
        return out

    def seen_as_instances(self) -> set[Key]:
        """Return the segments that are an instance to another chunk."""
        listed = {(o.chunk_id, o.local_id) for o in self._scene.store.observations.all()}
        out: set[Key] = set()
        for k, own in self.shapes.items():
            for v in (v for v in self._scene.near[k] if v != k):
                other = self._scene.shapes(v)
                same = self._same(own, other)
                out |= {(k, int(own.local_id[i])) for i, j in same if (v, int(other.local_id[j])) in listed}
        return out
