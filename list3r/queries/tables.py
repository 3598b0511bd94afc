"""The memory as plain tables: lists of flat dicts, for whatever library a user has."""

from __future__ import annotations

from typing import Literal

from list3r.memory.geometry import quat_wxyz_from_rotation
from list3r.memory.records import Instance
from list3r.memory.store.store import Store

Table = Literal["instances", "relations", "frames"]
Value = int | float | str | bool | None


def records_of(store: Store, table: Table = "instances") -> list[dict[str, Value]]:
    """One flat dict of numbers and texts for each row; all rows have the same keys in the same order.

    Raises `KeyError` for a table that there is not.
    """
    if table == "instances":
        return [_instance(i) for i in store.instances()]
    if table == "relations":
        return [
            {
                "subject": r.subject,
                "predicate": r.predicate,
                "object": r.object,
                "confidence": float(r.confidence),
                "margin": float(r.margin),
            }
            for r in store.relations()
        ]
    if table == "frames":
        return _frames(store)
    raise KeyError(f"no table {table!r}; choose one of: instances, relations, frames")


def _instance(i: Instance) -> dict[str, Value]:
    view = i.best_view
    return {
        "id": i.id,
        "label": i.label,
        "description": i.description,
        **_named("center", i.center.tolist(), "xyz"),
        **_named("min", i.aabb[0].tolist(), "xyz"),
        **_named("max", i.aabb[1].tolist(), "xyz"),
        **_named("box_center", i.box.center.tolist(), "xyz"),
        **_named("box_size", i.box.size.tolist(), "xyz"),
        **_named("box_quat", quat_wxyz_from_rotation(i.box.rotation).tolist(), "wxyz"),
        "confidence": float(i.confidence),
        "observations": i.observations,
        "first_seen_s": float(i.first_seen_s),
        "last_seen_s": float(i.last_seen_s),
        "state": i.state,
        "structure": i.structure,
        "dynamic": i.dynamic,
        "color_name": i.color_name,
        **_named("color", list(i.color_rgb), "rgb"),
        "component": i.component,
        "position_sigma_m": None if i.position_sigma_m is None else float(i.position_sigma_m),
        "best_view_session": None if view is None else view.session_id,
        "best_view_frame": None if view is None else view.frame_index,
    }


def _frames(store: Store) -> list[dict[str, Value]]:
    poses = {(f.session_id, f.frame_index): S for f, S in store.camera_poses()}
    out: list[dict[str, Value]] = []
    for f in store.frames():
        S = poses.get((f.session_id, f.frame_index))
        place = [None] * 3 if S is None else S.translation.tolist()
        turn = [None] * 4 if S is None else quat_wxyz_from_rotation(S.rotation).tolist()
        row: dict[str, Value] = {"session": f.session_id, "frame": f.frame_index, "time_s": float(f.time_s)}
        out.append({**row, "state": f.state, **_named("t", place, "xyz"), **_named("q", turn, "wxyz")})
    return out


def _named(name: str, values: list[Value] | list[float] | list[int] | list[None], letters: str) -> dict[str, Value]:
    return {f"{name}_{letter}": value for letter, value in zip(letters, values, strict=True)}
