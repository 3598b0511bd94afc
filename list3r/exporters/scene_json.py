"""Write the scene graph as JSON: the fixed fields of `scene.schema.json`, readable without any of our code."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from list3r.exporters.components import Component, frames_per_second, has_box, read_components
from list3r.exporters.output import replacing, units
from list3r.memory.core.geometry import quat_wxyz_from_rotation
from list3r.memory.core.records import Instance, Relation
from list3r.memory.library.labels import label_source
from list3r.memory.library.rooms.naming import named_rooms
from list3r.memory.library.world.scale import lengths_of
from list3r.memory.store.store import Store
from list3r.queries.views.footprint import large_footprints

FORMAT = "list3r-scene-graph"
VERSION = 1
_METRIC_DECIMALS = 4
"""Lengths of a metric memory are written to 0.1 mm."""


def scene_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) that every scene keeps."""
    text = resources.files("list3r.exporters").joinpath("scene.schema.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def write_scene_json(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write `scene_dict` to a file, one instance or relation a line. Returns the file written."""
    scene = scene_dict(store)
    with replacing(path) as temporary:
        temporary.write_text(_lay_out(scene), encoding="utf-8")
    return (Path(path),)


def scene_dict(store: Store) -> dict[str, Any]:
    """Return the scene graph of a memory as plain JSON values, without NaN.

    `frame.up` is [0, 0, 1], and null where gravity is unknown; `frame.units` is "m" for a metric or anchored memory and
    "unit" for a relative one and a guessed one, where it is about a metre; geometry that an instance lacks is null.
    Coordinates of instances of different `component` are not comparable.
    """
    components = read_components(store)
    gravity = store.facts.gravity
    decimals = _length_decimals(store, components)
    instances = sorted((i for c in components for i in c.instances), key=lambda i: i.id)
    known = {i.id for i in instances}
    detected = store.detected_labels.all()
    outlines = {} if gravity == "unknown" else large_footprints(store, instances)
    relations = [r for r in store.relations.all() if r.subject in known and r.object in known]
    return {
        "format": FORMAT,
        "version": VERSION,
        "frame": {
            "up": None if gravity == "unknown" else [0, 0, 1],
            "units": units(store),
            "metric": (store.facts.scale_kind or "relative"),
            "metric_source": store.facts.scale_source,
            "gravity": gravity,
            **_deviations(store),
        },
        "sessions": _sessions(store),
        "components": [_component(c, len(components)) for c in components if c.chunks or c.instances],
        "instances": [
            {
                **instance_entry(i, decimals, store.tracks.of(i.id) if i.dynamic else None),
                **label_source(i, detected.get(i.id)),
                "footprint": [_vector(c, decimals) for c in outlines[i.id]] if i.id in outlines else None,
            }
            for i in instances
        ],
        "relations": [_relation(r, decimals) for r in relations],
        "floors": _floors(store, decimals),
        "doorways": [
            {
                "rooms": [d.a, d.b],
                "position": _vector(d.position, decimals),
                "width": _number(d.width, decimals),
            }
            for d in store.rooms.doorways()
        ],
        "aliases": [{"id": k, "instance": v} for k, v in store.ids.aliases().items()],
    }


def _floors(store: Store, decimals: int) -> list[dict[str, Any]]:
    """Return the storeys of the building from the lowest, each with its rooms and what is in these."""
    floors: dict[int, dict[str, Any]] = {}
    for room in named_rooms(store):
        entry = {
            "id": room.id,
            "name": room.name,
            "reason": room.reason,
            "partial": room.partial or None,
            "floor_z": _number(room.floor_z, decimals),
            "area": _number(room.area, decimals),
            "outline": [_vector(corner, decimals) for corner in room.outline],
            "instances": list(room.instances),
        }
        floor = floors.setdefault(room.floor, {"floor": room.floor, "z": entry["floor_z"], "rooms": []})
        floor["rooms"].append(entry)
    return [floors[n] for n in sorted(floors)]


def _deviations(store: Store) -> dict[str, float]:
    """Return how surely a guessed metre and up are known, where that is known."""
    deviations = {"metric_deviation": lengths_of(store).deviation}
    deviations["gravity_deviation_deg"] = store.facts.gravity_deviation_deg
    return {name: value for name, value in deviations.items() if value is not None}


def _length_decimals(store: Store, components: list[Component]) -> int:
    """Return decimals of lengths: 0.1 mm where metric, 1e-5 of the scene's extent where the unit is arbitrary."""
    centers = [i.center for c in components for i in c.instances if np.isfinite(i.center).all()]
    if units(store) == "m" or not centers:
        return _METRIC_DECIMALS
    extent = float(np.max(np.ptp(centers, axis=0))) or 1.0
    return int(np.clip(5 - np.floor(np.log10(extent)), _METRIC_DECIMALS, 15))


def _number(value: float, decimals: int) -> float | None:
    return round(float(value), decimals) + 0.0 if np.isfinite(value) else None


def _vector(values: ArrayLike, decimals: int) -> list[float] | None:
    """Return the rounded numbers, without negative zero; None where one is not finite."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    return [float(v) + 0.0 for v in np.round(flat, decimals)] if np.isfinite(flat).all() else None


def instance_entry(
    instance: Instance, decimals: int = _METRIC_DECIMALS, track: tuple[ArrayLike, ArrayLike] | None = None
) -> dict[str, Any]:
    """Return one entry of `instances`; lengths rounded to this many decimals.

    `track` are the seconds (V,) and places (V, 3) of an instance that moves; without them the entry has none.
    """
    box, view = instance.box, instance.best_view
    low, high = _vector(instance.aabb[0], decimals), _vector(instance.aabb[1], decimals)
    entry: dict[str, Any] = {
        "id": instance.id,
        "label": instance.label,
        "description": instance.description,
        "center": _vector(instance.center, decimals),
        "aabb": {"min": low, "max": high} if low and high else None,
        "box": {
            "center": _vector(box.center, decimals),
            "size": _vector(box.size, decimals),
            "quat_wxyz": _vector(quat_wxyz_from_rotation(box.rotation), 6),
        }
        if has_box(instance)
        else None,
        "confidence": _number(instance.confidence, 4),
        "observations": instance.observations,
        "first_seen": _number(instance.first_seen_s, 6),
        "last_seen": _number(instance.last_seen_s, 6),
        "state": instance.state,
        "structure": instance.structure is not None,
        "structure_kind": instance.structure,
        "color": {"name": instance.color_name, "rgb": [int(v) for v in instance.color_rgb]},
        "component": instance.component,
        "best_view": None
        if view is None
        else {"session": view.session_id, "frame": view.frame_index, "box_xyxy": _vector(view.box_xyxy, 1)},
        "dynamic": instance.dynamic,
        "position_sigma": None
        if instance.position_sigma_m is None
        else _number(instance.position_sigma_m, max(decimals, _METRIC_DECIMALS)),
    }
    if track is not None:
        places = zip(np.asarray(track[0], dtype=np.float64), np.asarray(track[1], dtype=np.float64), strict=True)
        rows = [(_number(float(t), 6), _vector(place, decimals)) for t, place in places]
        entry["track"] = [[t, *place] for t, place in rows if t is not None and place is not None]
    return entry


def _relation(relation: Relation, decimals: int) -> dict[str, Any]:
    return {
        "subject": relation.subject,
        "predicate": relation.predicate,
        "object": relation.object,
        "confidence": _number(relation.confidence, 4),
        "margin": _number(relation.margin, decimals),
    }


def _component(component: Component, count: int) -> dict[str, Any]:
    note = "the frame of reference of the memory" if component.main else "not placed against the main component"
    return {
        "id": component.id,
        "main": component.main,
        "chunks": [c.chunk_id for c in component.chunks],
        "posed_frames": len(component.poses),
        "note": note if count > 1 else "all of the memory shares one frame of reference",
    }


def _sessions(store: Store) -> list[dict[str, Any]]:
    found = []
    for session in store.sessions.all():
        frames = store.frames.all(session.session_id)
        states = [f.state for f in frames]
        cameras = dict.fromkeys((*c.intrinsics, *c.image_size) for c in store.chunks.all(session.session_id))
        rate = frames_per_second(frames)
        found.append(
            {
                "id": session.session_id,
                "source": session.source,
                "state": session.state,
                "frames": {k: states.count(k) for k in ("posed", "lost", "bad")},
                "fps": None if rate is None else _number(rate, 3),
                "cameras": [
                    {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": int(width), "height": int(height)}
                    for fx, fy, cx, cy, height, width in cameras
                ],
            }
        )
    return found


def _lay_out(scene: dict[str, Any]) -> str:
    """Return JSON with one item of each list a line: short enough to read, stable enough to compare."""
    parts = []
    for key, value in scene.items():
        if isinstance(value, list) and value:
            items = ",\n".join(f"  {json.dumps(v, allow_nan=False, ensure_ascii=False)}" for v in value)
            parts.append(f' "{key}": [\n{items}\n ]')
        else:
            parts.append(f' "{key}": {json.dumps(value, allow_nan=False, ensure_ascii=False)}')
    return "{\n" + ",\n".join(parts) + "\n}\n"
