"""What was derived, written into a memory: only what is otherwise than it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from list3r.memory.core.records import MergeDecision, Observation
from list3r.memory.library.change.detection import as_events
from list3r.memory.library.derivation import Known, Library
from list3r.memory.library.identities import Identities
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.rooms.derivation import Rooms
from list3r.memory.library.scene import Scene
from list3r.memory.store.store import Store


def read_known(store: Store) -> Known:
    """Return what was there before."""
    owners = {(o.chunk_id, o.local_id): o.instance_id for o in store.observations.all()}
    rooms = Rooms(store.rooms.all(), store.rooms.doorways(), store.facts.last_room)
    return Known(owners, {i.id: i.label for i in store.instances.all()}, store.ids.next(), rooms)


def write_library(scene: Scene, library: Library, known: Known, chunk_id: int) -> None:
    """Bring a memory up to a library; `chunk_id` names the entries of the merge log. Call inside `transaction()`."""
    store = scene.store
    scene.scores.write(every=True)
    for n in sorted(known.labels.keys() - library.instances.keys()):
        store.instances.drop(n, dict(library.ids.aliases).get(n))
    _write_instances(store, library, scene.world.space)
    store.observations.forget(known.owners.keys() - library.owners.keys())
    store.observations.set(Observation(n, *key) for key, n in library.owners.items() if known.owners.get(key) != n)
    store.facts.last_id = max(library.ids.last_id, store.facts.last_id)
    _write_relations(store, library)
    events = as_events([(library.of_first.get(first), event) for first, event in library.changes.events])
    if not _same(events, store.events.all()):
        store.events.replace(events)
    if library.rooms is not None:
        store.facts.last_room = library.rooms.last_id
        if not _same(*([*r.rooms, *r.doorways] for r in (library.rooms, known.rooms))):
            store.rooms.replace(library.rooms.rooms, library.rooms.doorways)
    _log_decisions(store, chunk_id, library.decisions, known.owners, library.ids)


def _write_instances(store: Store, library: Library, space: str) -> None:
    before = {i.id: i for i in store.instances.all()}
    store.instances.put(i for n, i in library.instances.items() if n not in before or not _same(i, before[n]))
    if space:
        ids, vectors = store.embeddings.all(space)
        held = dict(zip(ids.tolist(), vectors, strict=True))
        fresh = {n: f for n, f in library.features.items() if n not in held or not np.array_equal(held[n], f)}
        if fresh:
            store.embeddings.put(space, list(fresh), np.array([*fresh.values()], np.float32))


def _same(a: Any, b: Any) -> bool:
    """Return whether two records, or fields of records, are equal."""
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if hasattr(a, "__dataclass_fields__") and type(a) is type(b):
        return all(_same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(a == b)


def _write_relations(store: Store, library: Library) -> None:
    before, now = set(store.relations.all()), set(library.relations)
    turned = {n for r in before ^ now for n in (r.subject, r.object)}
    if turned:
        kept = (r for r in library.relations if r.subject in turned or r.object in turned)
        store.relations.replace(sorted(turned), kept)


def _log_decisions(
    store: Store, chunk_id: int, decisions: Sequence[MergeDecision], before: Mapping[Key, int], ids: Identities
) -> None:
    """Append what is new: unions that did not hold before, refusals never written, ids that retired or split."""
    fresh = []
    for d in decisions:
        a, b = _key(d.a), _key(d.b)
        held = d.kind == "merge" and a in before and before[a] == before.get(b)
        if not held and not store.merges.has_decided(d.kind, d.a, d.b):
            fresh.append(d)
    for old, new in ids.aliases:
        reason = f"#{old} and #{new} are one instance; the older id stays"
        fresh.append(MergeDecision("alias", f"#{old}", f"#{new}", {}, reason))
    for old, new in ids.splits:
        reason = f"what was #{old} is more than one instance; the larger part keeps the id"
        fresh.append(MergeDecision("split", f"#{old}", f"#{new}", {}, reason))
    store.merges.add_all(chunk_id, fresh)


def _key(name: str) -> Key:
    chunk, local = name.split(":")
    return int(chunk), int(local)
