"""What consolidation writes: instances as records, the merge log, overlaps of chunks as blobs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.description.colors import Swatch, color_words, main_color
from list3r.memory.description.describe import describe
from list3r.memory.errors import MemoryFileError
from list3r.memory.geometry import Array, Sim3
from list3r.memory.library.identities import Identities
from list3r.memory.library.instances import DerivedInstance
from list3r.memory.library.rules import World
from list3r.memory.overlap.pair_scores import Key, PairScores
from list3r.memory.records import Instance, MergeDecision
from list3r.memory.relations.instance_geometry import InstanceGeometry
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import Looks

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
        raise MemoryFileError(f"overlaps: {len(blob)} bytes are no whole scores; run `list3r verify` on the file")
    found = np.frombuffer(blob, _SCORES)
    i, j, shared = (found[name].astype(np.int64) for name in ("i", "j", "shared"))
    return PairScores(i, j, found["i_on_j"].copy(), found["j_on_i"].copy(), shared, found["frame_iou"].copy())


def record_of(
    found: DerivedInstance, label: str | None, times: Mapping[tuple[int, int], float], world: World, *, metric: bool
) -> Instance:
    """Return the record of an instance, where its chunks are settled."""
    geometry: InstanceGeometry = found.geometry
    seen = [times[s, f] for s, f in found.frames.tolist() if (s, f) in times] or [0.0]
    name, rgb = main_color(found.swatches, world.light)
    return Instance(
        id=geometry.id,
        label=label,
        description=_description(found, geometry.box.size, geometry.structure, world, metric=metric),
        center=geometry.box.center,
        aabb=geometry.aabb,
        box=geometry.box,
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
    found: DerivedInstance | _Look, size: Array, structure: str | None, world: World, *, metric: bool
) -> str:
    color = color_words(found.swatches, world.light)
    words = describe(found.shape, color, size, world.unit, metric=metric, structure=structure)
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


def in_light(instance: Instance, looks: Looks, world: World, *, metric: bool) -> Instance:
    """Return an instance with the words for it in the light of the world."""
    rows = looks.swatches.tolist()
    swatches = tuple(Swatch((int(r), int(g), int(b)), (x, y, z), share) for r, g, b, x, y, z, share in rows)
    look = _Look(looks.shape, looks.resting, swatches)
    name, rgb = main_color(swatches, world.light)
    words = _description(look, instance.box.size, instance.structure, world, metric=metric)
    return replace(instance, description=words, color_name=name, color_rgb=rgb)


def moved(instance: Instance, S: Sim3) -> Instance:
    """Return the instance where its chunk lies to the last digit, not where it was settled; or the way back."""
    by = S.apply(instance.center[None])[0] - instance.center
    box = replace(instance.box, center=instance.box.center + by)
    return replace(instance, center=instance.center + by, aabb=instance.aabb + by, box=box)


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
