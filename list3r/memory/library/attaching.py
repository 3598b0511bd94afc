"""What a new chunk saw, brought to the instances by overlap alone until the library is next derived."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from list3r.memory.core.records import Instance, Observation
from list3r.memory.library.evidence import Evidence, weigh
from list3r.memory.library.overlap.pair_scores import Key, PairScores
from list3r.memory.library.redundancy import most_like
from list3r.memory.library.rows import record_alone
from list3r.memory.library.rules import ConsolidationReport
from list3r.memory.library.scene import Scene
from list3r.memory.library.uncertainty import position_sigmas

_COMPARED = 12
"""A new chunk is compared with the chunks that saw most of the instances in its view."""


def attach(scene: Scene, chunk_id: int) -> ConsolidationReport:
    """Let each local instance of a chunk be a view of the instance that it is most like, where there is one; what meets
    nothing that was seen before becomes an instance of its own. Boxes, relations and what moves follow when the library
    is derived. Call inside a transaction.
    """
    store, near = scene.store, _near(scene, chunk_id)
    overlaps = scene.overlaps((min(k, chunk_id), max(k, chunk_id)) for k in near)
    scene.scores.write()
    like = most_like(scene, chunk_id, overlaps, scene.constraints.links.forbids)
    owners = store.observations.owners([*like.values(), *((k, n) for k in near for n in scene.shapes(k).local_id)])
    seen = {key: owners[other] for key, other in like.items() if other in owners}
    alone = [(chunk_id, n) for n in scene.shapes(chunk_id).local_id.tolist() if (chunk_id, n) not in like]
    found = {key: e for key, e in _weighed(scene, alone, overlaps, owners).items() if key not in scene.motions}
    fresh = dict(zip(found, range(store.ids.next(), store.ids.next() + len(found)), strict=True))
    store.instances.put(_seen_again(scene, chunk_id, seen))
    _add(scene, {n: (key, found[key]) for key, n in fresh.items()})
    store.observations.set(Observation(n, *key) for key, n in (seen | fresh).items())
    store.facts.last_id = max([*fresh.values(), store.facts.last_id])
    instances, structure = store.instances.count()
    written = frozenset({*seen.values(), *fresh.values()})
    return ConsolidationReport(instances, structure, tuple(fresh.values()), (), 0, written)


def _near(scene: Scene, chunk_id: int) -> list[int]:
    """Return the chunk and the chunks that saw the instances in its view, in order."""
    low, high = scene.extent(chunk_id)
    if not np.isfinite(low).all():
        return [chunk_id]
    seen = scene.store.observations.chunks_of(scene.store.instances.ids_in_box(low, high))
    count: dict[int, int] = {}
    for _, k in seen:
        if scene.component(k) == scene.component(chunk_id):
            count[k] = count.get(k, 0) + 1
    most = sorted(count, key=lambda k: (-count[k], -k))[:_COMPARED]
    return sorted({chunk_id, *most})


def _weighed(
    scene: Scene, alone: list[Key], overlaps: Mapping[tuple[int, int], PairScores], owners: Mapping[Key, int]
) -> dict[Key, Evidence]:
    """Return those that there is enough evidence for to be shown, among the instances that are near."""
    groups: dict[object, list[Key]] = {}
    chunks = {k: scene.shapes(k) for pair in overlaps for k in pair}
    for key in sorted((k, n) for k, shapes in chunks.items() for n in shapes.local_id.tolist()):
        groups.setdefault(owners.get(key, key), []).append(key)
    names, wanted = list(groups), set(alone)
    at = [n for n, name in enumerate(names) if name in wanted]
    weighed = weigh(list(groups.values()), chunks, overlaps, scene.settings.evidence, at)
    enough = {names[n]: weighed[n] for n in at if weighed[n].shown(scene.settings.evidence, scene.world.posed)}
    return {key: enough[key] for key in alone if key in enough}


def _seen_again(scene: Scene, chunk_id: int, seen: Mapping[Key, int]) -> Iterable[Instance]:
    """Return the records of instances that a chunk sees again, with when that was."""
    times, by_id = scene.times_of([chunk_id]), dict[int, set[float]]()
    for key, n in seen.items():
        frames = ((scene.session(chunk_id), f) for f in scene.frames_of(key).tolist())
        by_id.setdefault(n, set()).update(times[f] for f in frames if f in times)
    for i in scene.store.instances.of(sorted(by_id)):
        later = {t for t in by_id[i.id] if t > i.last_seen_s}
        last = max([i.last_seen_s, *later])
        yield replace(i, observations=i.observations + len(later), last_seen_s=last, state="present")


def _add(scene: Scene, fresh: Mapping[int, tuple[Key, Evidence]]) -> None:
    """Write instances of one local instance each."""
    store, world, records, features = scene.store, scene.world, list[Instance](), list[np.ndarray]()
    for n, (key, evidence) in fresh.items():
        k = key[0]
        record, feature = record_alone(scene, n, (key,), {k: scene.shapes(k)}, evidence.confidence, bounds=True)
        at = np.zeros(1, np.int64)
        (sigma,) = position_sigmas(record.center[None], at, at, [scene.rows[k]])
        records.append(replace(record, position_sigma_m=sigma))
        features.append(feature)
    store.instances.put(records)
    if world.space and records and store.chunks.feature_space(next(iter(fresh.values()))[0][0]) == world.space:
        store.embeddings.put(world.space, list(fresh), np.array(features, np.float32))
