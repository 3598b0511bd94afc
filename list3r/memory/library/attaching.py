"""What a new chunk saw, brought to the instances by overlap alone until the library is next derived."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from list3r.memory.core.records import Instance, Observation
from list3r.memory.library.evidence import Evidence, weigh
from list3r.memory.library.grouping import Group
from list3r.memory.library.instances import Members, derived_instance
from list3r.memory.library.merging.edges import NONE, links_of
from list3r.memory.library.merging.nodes import Nodes
from list3r.memory.library.overlap.pair_scores import Key, Numbering, PairScores, PairTable
from list3r.memory.library.relations.structure import flagged_only
from list3r.memory.library.rows import record_of
from list3r.memory.library.rules import ConsolidationReport
from list3r.memory.library.scene import Scene
from list3r.memory.library.uncertainty import position_sigma

_COMPARED = 12
"""Chunks with which a new one is compared: those that saw most of the instances that lie where it looked."""


def attach(scene: Scene, chunk_id: int) -> ConsolidationReport:
    """Let each local instance of a chunk be a view of the instance that it is most like, where there is one; what meets
    nothing that was seen before becomes an instance of its own. Boxes, relations and what moves follow when the library
    is derived. Call inside a transaction.
    """
    store, near = scene.store, _near(scene, chunk_id)
    overlaps = scene.overlaps((min(k, chunk_id), max(k, chunk_id)) for k in near)
    scene.scores.write()
    like = _most_like(scene, chunk_id, overlaps)
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
    """Return the chunk and those that saw the instances that lie where it looked, in order."""
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


def _most_like(scene: Scene, chunk_id: int, overlaps: Mapping[tuple[int, int], PairScores]) -> dict[Key, Key]:
    """Return what of other chunks each local instance is most like, of those that are like any."""
    shapes = {k: scene.shapes(k) for pair in sorted(overlaps) for k in pair}
    numbering, order = Numbering(shapes), sorted(shapes)
    nodes = Nodes.of([shapes[k] for k in order], {k: scene.pose(k) for k in order})
    links = links_of(nodes, PairTable.of(overlaps, numbering), scene.settings.merging)
    best: dict[Key, tuple[float, Key]] = {}
    for n in np.flatnonzero(links.kind != NONE).tolist():
        a, b = numbering.keys[links.a[n]], numbering.keys[links.b[n]]
        own, other = (a, b) if a[0] == chunk_id else (b, a)
        if other[0] != chunk_id and not scene.constraints.links.forbids(own, other):
            found = float(links.score[n]), other
            best[own] = max(found, best.get(own, found))
    return {own: other for own, (_, other) in best.items()}


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
    metric = store.facts.scale_kind != "relative"
    for n, (key, evidence) in fresh.items():
        row, shapes, group = scene.rows[key[0]], scene.shapes(key[0]), Group((key,))
        of = {key[0]: (shapes, row.S_world_chunk, np.zeros(len(shapes.points), bool))}
        upright = world.stands(row.component)
        found = derived_instance(n, Members(group, group, of, row.component, upright), scene.settings.derive)
        kind, sure = flagged_only([found.geometry])[0], round(evidence.confidence, 4)
        found = replace(found, geometry=replace(found.geometry, structure=kind, confidence=sure))
        record = record_of(found, None, scene.times_of([key[0]]), world, metric=metric)
        records.append(replace(record, position_sigma_m=position_sigma(record.center, [row])))
        features.append(found.feature)
    store.instances.put(records)
    if world.space and records and store.chunks.feature_space(next(iter(fresh.values()))[0][0]) == world.space:
        store.embeddings.put(world.space, list(fresh), np.array(features, np.float32))
