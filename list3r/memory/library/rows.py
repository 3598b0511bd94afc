"""What consolidation writes: instances as records, the merge log, overlaps of chunks as blobs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.description.colors import Swatch, color_names, color_words, main_color
from list3r.memory.description.describe import describe
from list3r.memory.errors import MemoryFileError
from list3r.memory.geometry import Array, OrientedBox, Sim3, rotation_exp, stack
from list3r.memory.library.identities import Identities
from list3r.memory.library.instances import DerivedInstance
from list3r.memory.library.rules import World
from list3r.memory.library.uncertainty import position_sigmas
from list3r.memory.overlap.pair_scores import Key, PairScores
from list3r.memory.records import Instance, MergeDecision
from list3r.memory.relations.instance_geometry import InstanceGeometry
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import Anchor, Looks

_SCORES = np.dtype(
    [("i", "<i4"), ("j", "<i4"), ("i_on_j", "<f8"), ("j_on_i", "<f8"), ("shared", "<i4"), ("frame_iou", "<f8")]
)


def pack_scores(p: PairScores) -> bytes:
    """Return scores of a pair of chunks as one blob."""
    out: NDArray[np.void] = np.zeros(len(p.i), _SCORES)
    for name in _SCORES.names or ():
        out[name] = getattr(p, name)
    return out.tobytes()


def unpack_scores(blob: bytes) -> PairScores:
    """Return the inverse of `pack_scores`. Raises `MemoryFileError` for a blob of another length."""
    if len(blob) % _SCORES.itemsize:
        raise MemoryFileError(f"overlaps: {len(blob)} bytes do not hold whole scores; run `list3r verify` on the file")
    found = np.frombuffer(blob, _SCORES)
    i, j, shared = (found[name].astype(np.int64) for name in ("i", "j", "shared"))
    return PairScores(i, j, found["i_on_j"].copy(), found["j_on_i"].copy(), shared, found["frame_iou"].copy())


def record_of(
    found: DerivedInstance, label: str | None, times: Mapping[tuple[int, int], float], world: World, *, metric: bool
) -> Instance:
    """Return the record of an instance, where its chunks are settled."""
    geometry: InstanceGeometry = found.geometry
    seen = [times[s, f] for s, f in found.frames.tolist() if (s, f) in times] or [0.0]
    names = color_names(found.swatches, world.light)
    name, rgb = main_color(found.swatches, names)
    return Instance(
        id=geometry.id,
        label=label,
        description=_description(found, names, found.box.size, geometry.structure, world, metric=metric),
        center=found.box.center,
        aabb=geometry.aabb,
        box=found.box,
        confidence=geometry.confidence,
        observations=len(found.frames),
        first_seen_s=min(seen),
        last_seen_s=max(seen),
        state="present",
        structure=geometry.structure,
        color_rgb=rgb,
        color_name=name,
        component=geometry.component,
        best_view=found.best_view,
        dynamic=found.dynamic,
    )


def _description(
    found: DerivedInstance | _Look,
    names: Sequence[str],
    size: Array,
    structure: str | None,
    world: World,
    *,
    metric: bool,
) -> str:
    color = color_words(found.swatches, names)
    words = describe(found.shape, color, size, world.unit, metric=metric, structure=structure, guessed=world.guessed)
    return words if found.resting else f"moving {words}"


@dataclass(frozen=True)
class _Look:
    """The looks of an instance as they were derived."""

    shape: str
    resting: bool
    swatches: tuple[Swatch, ...]


def looks_of(found: DerivedInstance) -> Looks:
    """Return what is kept of the looks of an instance."""
    colors = np.array([(*s.rgb, *s.lab, s.share) for s in found.swatches], np.float64)
    return Looks(found.geometry.id, found.shape, found.resting, colors)


def in_light(instance: Instance, looks: Looks, world: World, *, metric: bool) -> Instance | None:
    """Return an instance with the words for it in the light of the world; None where it has them."""
    rows = looks.swatches.tolist()
    swatches = tuple(Swatch((int(r), int(g), int(b)), (x, y, z), share) for r, g, b, x, y, z, share in rows)
    look = _Look(looks.shape, looks.resting, swatches)
    names = color_names(swatches, world.light)
    name, rgb = main_color(swatches, names)
    words = _description(look, names, instance.box.size, instance.structure, world, metric=metric)
    if (words, name) == (instance.description, instance.color_name):
        return None
    return replace(instance, description=words, color_name=name, color_rgb=rgb)


def moved(instance: Instance, S: Sim3) -> Instance:
    """Return the instance where its chunk lies to the last digit, not where it was settled; or the way back."""
    by = S.apply(instance.center[None])[0] - instance.center
    box = replace(instance.box, center=instance.box.center + by)
    return replace(instance, center=instance.center + by, aabb=instance.aabb + by, box=box)


def put_exactly(store: Store, settled: Mapping[int, Sim3], written: Collection[int]) -> None:
    """Move the boxes of instances that were not `written` anew to where their chunks lie to the last digit, which is
    less far than makes them be derived anew. `settled` are S_world_chunk of where chunks are settled.
    """
    exact: dict[int, Sim3] = {}
    for anchors in store.library.anchors.all():
        known = {n: a for n, a in anchors.items() if n not in written}
        for k in {a.chunk_id for a in known.values()} - exact.keys():
            exact[k] = store.chunks.get(k).S_world_chunk @ settled[k].inverse()
        lie = np.array([exact[a.chunk_id].as_matrix() for a in known.values()]).reshape(-1, 4, 4)
        lay = np.array([a.S_exact_settled.as_matrix() for a in known.values()]).reshape(-1, 4, 4)
        elsewhere = (np.abs(lie - lay) > _ROUNDED).any(axis=(1, 2)).tolist()
        others = {n: a for (n, a), move in zip(known.items(), elsewhere, strict=True) if move}
        if not others:
            continue
        some = list(others)
        instances = store.instances.of(some)
        before = stack([others[i.id].S_exact_settled for i in instances])
        now = stack([exact[others[i.id].chunk_id] for i in instances])
        center = _centers(instances)
        by = now.apply(before.inverse().apply(center[:, None]))[:, 0] - center
        sigma = _sigmas(store, some, center + by)
        there = [
            replace(
                i,
                center=i.center + d,
                aabb=i.aabb + d,
                box=replace(i.box, center=i.box.center + d),
                position_sigma_m=s,
            )
            for i, d, s in zip(instances, by, sigma, strict=True)
        ]
        store.instances.set_places(there)
        store.library.anchors.put({n: Anchor(a.chunk_id, exact[a.chunk_id]) for n, a in others.items()})


def carry_instances(store: Store, moves: Mapping[int, Sim3], upright: int | None) -> None:
    """Carry instances along with the chunks that they hang on: `moves` lead by chunk from where it was settled in the
    world to where it lies. Boxes in the component that is `upright` stay so; a box along the axes grows or shrinks as
    the one round the turned box does. What hangs on another chunk, which was measured anew, is left to be derived.
    """
    for some_anchors in store.library.anchors.all():
        anchors = {n: a for n, a in some_anchors.items() if a.chunk_id in moves}
        if not anchors:
            continue
        some = list(anchors)
        instances = store.instances.of(some)
        exact = stack([anchors[i.id].S_exact_settled for i in instances])
        by = stack([moves[anchors[i.id].chunk_id] for i in instances])
        center, aabb = _centers(instances)[:, None], np.array([i.aabb for i in instances])
        size, rotation = np.array([i.box.size for i in instances]), np.array([i.box.rotation for i in instances])
        derived = exact.inverse().apply(center)
        stands = np.array([i.component == upright for i in instances])[:, None, None]
        turned = np.where(stands, _about_z(by.rotation), by.rotation) @ rotation
        before, now = ((np.abs(R) @ size[..., None])[..., 0] for R in (rotation, turned))
        half = by.scale[:, None] * np.ptp(aabb, axis=1) / 2.0 * now / np.maximum(before, 1e-12)
        middle = by.apply(aabb.mean(axis=1)[:, None] + derived - center)
        boxes = np.concatenate([middle - half[:, None], middle + half[:, None]], axis=1)
        there = by.apply(derived)[:, 0]
        rows = zip(instances, there, boxes, by.scale[:, None] * size, turned, _sigmas(store, some, there), strict=True)
        store.instances.set_places(
            replace(i, center=c, aabb=a, box=OrientedBox(c, edges, R), position_sigma_m=s)
            for i, c, a, edges, R, s in rows
        )
        store.library.anchors.put({n: Anchor(a.chunk_id, Sim3.identity()) for n, a in anchors.items()})


def _sigmas(store: Store, ids: Sequence[int], centers: Array) -> list[float | None]:
    """Return how well it is known where instances are, by all chunks that saw them and take part."""
    at, redundant = {i: n for n, i in enumerate(ids)}, store.library.redundant.chunks()
    seen = [(at[i], k) for i, k in store.observations.chunks_of(sorted(at)) if k not in redundant]
    owner, chunk = np.array(seen, np.int64).reshape(-1, 2).T
    numbers, number = np.unique(chunk, return_inverse=True)
    return position_sigmas(centers, owner, number, [store.chunks.get(int(k)) for k in numbers])


_ROUNDED = 1e-9
"""What products of poses round, and nothing is moved for."""


def _centers(instances: Sequence[Instance]) -> Array:
    """Shape (N, 3)."""
    return np.array([i.center for i in instances]).reshape(-1, 3)


def _about_z(rotation: Array) -> Array:
    """Return the part of rotations that is about z. Shape (N, 3, 3) -> (N, 3, 3)."""
    yaw = np.arctan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1])
    return rotation_exp(np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1))


def log_decisions(
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
