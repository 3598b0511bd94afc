"""Write a recording for the Rerun viewer: points, boxes, names, relations and the camera on a time line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from list3r.exporters.components import Component, has_box, read_components, thinned_support
from list3r.exporters.output import replacing, units
from list3r.exporters.palette import instance_color, structure_color
from list3r.memory.geometry import quat_wxyz_from_rotation
from list3r.memory.records import Instance
from list3r.memory.store.store import Store

_POINTS = 5000
"""Of one instance, at most."""


def write_rerun(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write `world/instances/12` (points and a named box), `world/relations` and `world/camera` as an .rrd file.

    The camera and its pictures lie on the time line `time_s` of their session. A component that was not placed against
    the main one is `component_7` beside `world`. Returns the file written.
    """
    import rerun as rr

    path = Path(path)
    with replacing(path) as temporary:
        log = rr.RecordingStream("list3r", recording_id=_recording_id(store), send_properties=False)
        log.save(temporary)
        log.log("about", rr.TextDocument(f"{store.path.name}, lengths in {units(store)}"), static=True)
        for component in read_components(store):
            root = component.name or "world"
            if store.facts.gravity != "unknown":
                log.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            for instance in component.instances:
                _log_instance(rr, log, root, instance, store)
            _log_relations(rr, log, root, component, store)
            _log_camera(rr, log, root, component, store)
        log.flush()
        log.disconnect()
    return (path,)


def _recording_id(store: Store) -> str:
    return f"{store.path.stem}-{store.ids.largest()}"


def _log_instance(rr: Any, log: Any, root: str, instance: Instance, store: Store) -> None:
    kind = "structure" if instance.structure else "instances"
    where = f"{root}/{kind}/{instance.id}"
    support = thinned_support(store, instance, _POINTS)
    if len(support.points):
        log.log(f"{where}/points", rr.Points3D(support.points, colors=support.rgb), static=True)
    if has_box(instance) and not instance.structure:
        box, name = instance.box, instance.label or instance.description.split(",")[0]
        shape = rr.Boxes3D(
            centers=[box.center],
            half_sizes=[box.size / 2],
            quaternions=[np.roll(quat_wxyz_from_rotation(box.rotation), -1)],
            colors=[(structure_color if instance.structure else instance_color)(instance.id)],
            labels=[f"{instance.id} {name}"],
            show_labels=False,
        )
        log.log(f"{where}/box", shape, static=True)


def _log_relations(rr: Any, log: Any, root: str, component: Component, store: Store) -> None:
    centers = {i.id: i.center for i in component.instances if not i.structure and np.isfinite(i.center).all()}
    found = [r for r in store.relations.all() if r.subject in centers and r.object in centers]
    found = [r for r in found if r.predicate in ("on", "in", "under", "next_to") and r.subject != r.object]
    if found:
        strips = [[centers[r.subject], centers[r.object]] for r in found]
        names = [f"{r.subject} {r.predicate} {r.object}" for r in found]
        log.log(f"{root}/relations", rr.LineStrips3D(strips, labels=names, show_labels=False), static=True)


def _log_camera(rr: Any, log: Any, root: str, component: Component, store: Store) -> None:
    chunks = {c.chunk_id: c for c in component.chunks}
    jpegs = {(c.session_id, k.frame_index): k.jpeg for c in component.chunks for k in store.keyframes.of(c.chunk_id)}
    for frame, S_world_cam in component.poses:
        where = f"{root}/camera/session_{frame.session_id}"
        log.set_time(f"time_s_{frame.session_id}", duration=float(frame.time_s))
        pose = rr.Transform3D(translation=S_world_cam.translation, mat3x3=S_world_cam.rotation)
        log.log(where, pose)
        jpeg = jpegs.get((frame.session_id, frame.frame_index), b"")
        if jpeg:
            chunk = chunks[frame.chunk_id]
            fx, fy, cx, cy = chunk.intrinsics
            K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
            height, width = chunk.image_size
            pinhole = rr.Pinhole(image_from_camera=K, resolution=[width, height], camera_xyz=rr.ViewCoordinates.RDF)
            log.log(f"{where}/picture", pinhole)
            log.log(f"{where}/picture", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
    log.reset_time()
