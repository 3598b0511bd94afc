"""An instance as a record, with the words for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from list3r.memory.core.description.colors import color_names, color_words, main_color
from list3r.memory.core.description.describe import describe
from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Instance
from list3r.memory.library.instances import DerivedInstance
from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.rules import World


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
