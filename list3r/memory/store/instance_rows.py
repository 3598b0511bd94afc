"""Instances as rows of the store and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from list3r.memory.geometry import OrientedBox
from list3r.memory.records import BestView, Instance
from list3r.memory.store.codec import raw_array

COLUMNS = (
    "id, label, description, geometry, confidence, observations, first_seen_s, last_seen_s, state, structure,"
    " color_rgb, color_name, component, view_session, view_frame, view_box, dynamic,"
    " position_sigma_m"
)


def instance_row(instance: Instance) -> tuple[object, ...]:
    box = instance.box
    geometry = np.concatenate([instance.center, instance.aabb.ravel(), box.center, box.size, box.rotation.ravel()])
    r, g, b = instance.color_rgb
    view = instance.best_view
    return (
        instance.id,
        instance.label,
        instance.description,
        geometry.astype("<f8").tobytes(),
        float(instance.confidence),
        int(instance.observations),
        float(instance.first_seen_s),
        float(instance.last_seen_s),
        instance.state,
        instance.structure,
        int(r) << 16 | int(g) << 8 | int(b),
        instance.color_name,
        int(instance.component),
        None if view is None else view.session_id,
        None if view is None else int(view.frame_index),
        None if view is None else np.asarray(view.box_xyxy, dtype="<f8").tobytes(),
        int(instance.dynamic),
        instance.position_sigma_m,
    )


def read_instance(row: tuple[Any, ...]) -> Instance:
    where = f"the geometry of instance {row[0]}"
    g = raw_array(row[3], "<f8", (24,), where).copy()
    view = None
    if row[13] is not None:
        x0, y0, x1, y1 = (float(x) for x in raw_array(row[15], "<f8", (4,), where))
        view = BestView(row[13], row[14], (x0, y0, x1, y1))
    return Instance(
        id=row[0],
        label=row[1],
        description=row[2],
        center=g[:3],
        aabb=g[3:9].reshape(2, 3),
        box=OrientedBox(g[9:12], g[12:15], g[15:24].reshape(3, 3)),
        confidence=row[4],
        observations=row[5],
        first_seen_s=row[6],
        last_seen_s=row[7],
        state=row[8],
        structure=row[9],
        color_rgb=(row[10] >> 16 & 255, row[10] >> 8 & 255, row[10] & 255),
        color_name=row[11],
        component=row[12],
        best_view=view,
        dynamic=bool(row[16]),
        position_sigma_m=row[17],
    )
