"""The memory as plain tables: rows of numbers and texts, for a data frame or a file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from list3r.memory.core.errors import check_choice
from list3r.memory.core.geometry import quat_wxyz_from_rotation
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store

Table = Literal["instances", "relations", "frames"]
Value = int | float | str | bool | None


def _parts(name: str, letters: str) -> tuple[str, ...]:
    return tuple(f"{name}_{letter}" for letter in letters)


COLUMNS: dict[Table, tuple[str, ...]] = {
    "instances": (
        "id",
        "label",
        "description",
        *_parts("center", "xyz"),
        *_parts("min", "xyz"),
        *_parts("max", "xyz"),
        *_parts("box_center", "xyz"),
        *_parts("box_size", "xyz"),
        *_parts("box_quat", "wxyz"),
        "confidence",
        "observations",
        "first_seen_s",
        "last_seen_s",
        "state",
        "structure",
        "dynamic",
        "color_name",
        *_parts("color", "rgb"),
        "component",
        "position_sigma_m",
        "best_view_session",
        "best_view_frame",
    ),
    "relations": ("subject", "predicate", "object", "confidence", "margin"),
    "frames": ("session", "frame", "time_s", "state", *_parts("t", "xyz"), *_parts("q", "wxyz")),
}
"""Names of the columns of each table, in order. Lengths are in world units, colours in [0, 255]."""


def records_of(store: Store, table: Table = "instances") -> list[dict[str, Value]]:
    """Return one flat dict of numbers and texts for each row; all rows have the keys `COLUMNS[table]`, in that order.

    Raises `OptionError` for a table that does not exist.
    """
    check_choice("table", table, COLUMNS)
    return [dict(zip(COLUMNS[table], row, strict=True)) for row in rows_of(store, table)]


def rows_of(store: Store, table: Table) -> Iterator[Sequence[Value]]:
    """Yield the rows of a table as tuples in the order of `COLUMNS`."""
    if table == "instances":
        return map(_instance, store.instances.all())
    if table == "relations":
        return ((r.subject, r.predicate, r.object, float(r.confidence), float(r.margin)) for r in store.relations.all())
    return _frames(store)


def _instance(i: Instance) -> tuple[Value, ...]:
    view = i.best_view
    return (
        i.id,
        i.label,
        i.description,
        *i.center.tolist(),
        *i.aabb[0].tolist(),
        *i.aabb[1].tolist(),
        *i.box.center.tolist(),
        *i.box.size.tolist(),
        *quat_wxyz_from_rotation(i.box.rotation).tolist(),
        float(i.confidence),
        i.observations,
        float(i.first_seen_s),
        float(i.last_seen_s),
        i.state,
        i.structure,
        i.dynamic,
        i.color_name,
        *i.color_rgb,
        i.component,
        None if i.position_sigma_m is None else float(i.position_sigma_m),
        None if view is None else view.session_id,
        None if view is None else view.frame_index,
    )


def _frames(store: Store) -> Iterator[tuple[Value, ...]]:
    poses = {(f.session_id, f.frame_index): S for f, S in store.trajectory.poses()}
    for f in store.frames.all():
        S = poses.get((f.session_id, f.frame_index))
        place = [None] * 3 if S is None else S.translation.tolist()
        turn = [None] * 4 if S is None else quat_wxyz_from_rotation(S.rotation).tolist()
        yield (f.session_id, f.frame_index, float(f.time_s), f.state, *place, *turn)
