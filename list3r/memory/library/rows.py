"""An instance as a record, with the words for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.colors import color_names, color_words, main_color
from list3r.memory.core.description.describe import describe
from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Instance
from list3r.memory.library.instances import DerivedInstance, derived_instance
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.voxels import ChunkShapes
from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.relations.structure import flagged_only
from list3r.memory.library.scene import Scene
from list3r.memory.library.world.world import World


def record_of(
    found: DerivedInstance,
    label: str | None,
    times: Mapping[tuple[int, int], float],
    world: World,
    more: Sequence[tuple[int, int]] = (),
    *,
    metric: bool,
) -> Instance:
    """Return the record of an instance. `times` are seconds by (session id, Frame.index); `more` are frames in which
    it is seen besides.
    """
    geometry: InstanceGeometry = found.geometry
    frames = {*map(tuple, found.frames.tolist()), *more}
    seen = [times[f] for f in frames if f in times] or [0.0]
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
        observations=len(frames),
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


def record_alone(
    scene: Scene,
    instance_id: int,
    group: Sequence[Key],
    shapes: Mapping[int, ChunkShapes],
    confidence: float,
    *,
    bounds: bool = False,
) -> tuple[Instance, NDArray[np.float32]]:
    """Return the record of an instance whose surface nothing else claims, and its feature; with `bounds` it may be
    structure. `shapes` are those of its chunks.
    """
    store, world, component = scene.store, scene.world, scene.component(group[0][0])
    of = {k: (shapes[k], scene.pose(k), np.zeros(len(shapes[k].points), bool)) for k, _ in group}
    upright = world.stands(component)
    settings = scene.settings.derive
    found = derived_instance(instance_id, group, of, component, upright=upright, settings=settings)
    kind = flagged_only([found.geometry])[0] if bounds else None
    found = replace(found, geometry=replace(found.geometry, structure=kind, confidence=round(confidence, 4)))
    metric = store.facts.scale_kind != "relative"
    return record_of(found, None, scene.times_of({k for k, _ in group}), world, metric=metric), found.feature


def _description(
    found: DerivedInstance,
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
