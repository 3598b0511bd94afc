"""Write a recording for the Rerun viewer: points, boxes, names, relations and the camera on a time line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from list3r.exporters.components import Component, has_box, read_components, thinned_support
from list3r.exporters.output import replacing, units
from list3r.exporters.palette import instance_color
from list3r.memory.core.geometry import quat_wxyz_from_rotation
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store

_POINTS = 5000
"""Of one instance, at most."""
_ALONE = 1000
"""Instances that have an entity each, at most: the viewer's tree and the file take no more of them."""
_TOGETHER = 1000
"""Instances of one entity where there are more."""


def write_rerun(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write `world/instances/12` (points and a named box), `world/relations` and `world/camera` as an .rrd file.

    Of more than 1,000 instances a thousand share an entity, `world/instances/1_to_1000`; the box or the point that is
    clicked says its id. The camera and its pictures are on the time line `time_s` of their session. A component that
    was not placed against the main one is `component_7` next to `world`. Returns the file written.
    """
    import rerun as rr

    path = Path(path)
    with replacing(path) as temporary:
        name = f"{store.path.stem}-{store.ids.largest()}"
        log = rr.RecordingStream("list3r", recording_id=name, send_properties=False)
        log.save(temporary)
        log.log("about", rr.TextDocument(f"{store.path.name}, lengths in {units(store)}"), static=True)
        for component in read_components(store):
            root = component.name or "world"
            if store.facts.gravity != "unknown":
                log.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            for name, group in _groups([i for i in component.instances if not i.structure]).items():
                _log_group(rr, log, f"{root}/instances/{name}", group, store)
            for name, group in _groups([i for i in component.instances if i.structure]).items():
                _log_group(rr, log, f"{root}/structure/{name}", group, store)
            _log_relations(rr, log, root, component, store)
            _log_camera(rr, log, root, component, store)
        log.flush()
        log.disconnect()
    return (path,)


def _groups(instances: Sequence[Instance]) -> dict[str, Sequence[Instance]]:
    """Return instances by the name of their entity: one each, or consecutive groups where they are many."""
    if len(instances) <= _ALONE:
        return {str(i.id): [i] for i in instances}
    blocks = [instances[n : n + _TOGETHER] for n in range(0, len(instances), _TOGETHER)]
    return {f"{block[0].id}_to_{block[-1].id}": block for block in blocks}


def _log_group(rr: Any, log: Any, where: str, group: Sequence[Instance], store: Store) -> None:
    """Log the points and the boxes of instances, with the id of each as `instance`."""
    supports = [thinned_support(store, i, _POINTS) for i in group]
    ids = np.repeat([i.id for i in group], [len(s.points) for s in supports])
    if len(ids):
        points, rgb = (np.concatenate([getattr(s, part) for s in supports]) for part in ("points", "rgb"))
        log.log(f"{where}/points", rr.Points3D(points, colors=rgb), rr.AnyValues(instance=ids), static=True)
    boxed = [i for i in group if has_box(i) and not i.structure]
    if boxed:
        shape = rr.Boxes3D(
            centers=[i.box.center for i in boxed],
            half_sizes=[i.box.size / 2 for i in boxed],
            quaternions=[np.roll(quat_wxyz_from_rotation(i.box.rotation), -1) for i in boxed],
            colors=[instance_color(i.id) for i in boxed],
            labels=[f"{i.id} {i.label or i.description.split(',')[0]}" for i in boxed],
            show_labels=False,
        )
        log.log(f"{where}/box", shape, rr.AnyValues(instance=[i.id for i in boxed]), static=True)


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
