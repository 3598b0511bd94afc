"""A memory of a map that another program made: its objects as one chunk, related and named by our own rules."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r import __version__
from list3r.importers.base import GRAY, IMPORTED, ImportedMap, ImportedObject
from list3r.importers.registry import read_map
from list3r.importers.up_axis import up_axis_notes
from list3r.memory.core.errors import MemoryFileError, OptionError, check_choice
from list3r.memory.core.records import (
    ChunkResult,
    FrameSamples,
    JsonFields,
    LocalInstance,
    LocalLibrary,
    MaskTrack,
    Support,
)
from list3r.memory.library.evidence import EvidenceSettings
from list3r.memory.library.rules import ConsolidationSettings
from list3r.memory.store.connection import remove_memory
from list3r.memory.store.file import taken
from list3r.memory.store.store import Store
from list3r.pipeline.mapping import add_chunk, finish_session
from list3r.pipeline.settings import BuildSettings

_MOST_OBJECTS = 100_000
_TURNS = {"x": (0, 1), "y": (1, 1), "z": (2, 1), "-x": (0, -1), "-y": (1, -1), "-z": (2, -1)}
_SURE = 0.98


@dataclass(frozen=True)
class ImportReport(JsonFields):
    """Result of an import."""

    format: str
    objects: int
    """Objects of the map."""
    instances: int
    """Instances that they became."""
    structure: int
    relations: int
    ids: dict[str, int]
    """Instance by the map's own name of the object."""
    notes: tuple[str, ...]


def import_map(path: str | Path, memory: str | Path, *, kind: str = "auto", up: str = "z") -> ImportReport:
    """Make a memory of a map of another program. `up` is the axis of its world that points up: x, y, z, -x, -y or -z.

    Raises `SourceError` for another kind of file, `OptionError`, and `MemoryFileError` for a memory that exists.
    """
    source, target = Path(path).expanduser(), Path(memory)
    check_choice("--up", up, _TURNS)
    if target.exists():
        raise MemoryFileError(taken(target))
    found = read_map(source, kind)
    if len(found.objects) > _MOST_OBJECTS:
        raise OptionError(f"{source} holds {len(found.objects)} objects; at most {_MOST_OBJECTS} are imported")
    store = Store.create(target)
    try:
        report = _write(store, source, found, up)
    except BaseException:
        store.close()
        remove_memory(target)
        raise
    store.close()
    return report


def upright(up: str) -> NDArray[np.float64]:
    """Return the rotation that turns an axis to z. Shape (3, 3)."""
    axis, sign = _TURNS[up]
    others = [k for k in range(3) if k != axis]
    R = np.zeros((3, 3))
    R[2, axis] = sign
    R[0, others[0]], R[1, others[1]] = 1.0, 1.0
    R[1] *= np.linalg.det(R)
    return R


def _write(store: Store, source: Path, found: ImportedMap, up: str) -> ImportReport:
    library = ConsolidationSettings(evidence=EvidenceSettings(min_frames=0, least_confidence=0.0))
    settings = BuildSettings(reconstruction="precomputed", poses="given", up="source", library=library)
    with store.transaction():
        store.facts.created_by = f"list3r {__version__}"
        store.facts.scale_kind = "metric" if found.metric else "relative"
        store.facts.scale_source = f"imported from {found.format}"
        store.facts.gravity = "unknown"
        store.facts.poses = settings.poses
        store.facts[IMPORTED] = {
            "format": found.format,
            "path": str(source.resolve()),
            "notes": list(found.notes),
            "names": [t.name for t in found.objects],
        }
        session = store.sessions.add(str(source.resolve()), found.format, settings.as_plain(), 1)
    add_chunk(store, session, _chunk(found, upright(up)), settings=settings.association)
    finish_session(store, session, settings.association)
    names = {t.name for t in found.objects}
    ids = {found.objects[o.local_id].name: o.instance_id for o in store.observations.all()}
    notes = (*found.notes, *up_axis_notes([t.points for t in found.objects], up))
    if len(names) < len(found.objects):
        notes = (*notes, "several objects of the map have the same name")
    left = len(found.objects) - len(store.observations.all())
    if left:
        notes = (*notes, f"{left} objects of the map became no instance of their own")
    instances, structure = store.instances.count()
    relations = len(store.relations.all())
    return ImportReport(found.format, len(found.objects), instances, structure, relations, ids, notes)


def _chunk(found: ImportedMap, R: NDArray[np.float64]) -> ChunkResult:
    size = max((len(t.feature) for t in found.objects if t.feature is not None), default=1)
    library = LocalLibrary(
        tuple(_local(n, t, R, size) for n, t in enumerate(found.objects)),
        np.zeros((0, 2), np.int32),
        f"imported-{found.format}@1/{size}",
    )
    return ChunkResult(
        index=0,
        frame_indices=np.zeros(1, np.int64),
        times_s=np.zeros(1),
        posed=np.zeros(1, bool),
        T_chunk_cam=np.eye(4)[None],
        T_source_cam=None,
        intrinsics=(1.0, 1.0, 0.0, 0.0),
        image_size=(1, 1),
        scale_kind="metric" if found.metric else "relative",
        keyframes=(),
        samples=FrameSamples.empty(),
        library=library,
    )


def _local(number: int, obj: ImportedObject, R: NDArray[np.float64], size: int) -> LocalInstance:
    finite = np.isfinite(obj.points).all(axis=1)
    points = obj.points[finite] @ R.T.astype(np.float32)
    rgb = np.tile(np.array(GRAY, np.uint8), (len(points), 1)) if obj.rgb is None else obj.rgb[finite]
    feature = np.ones(size, np.float32) if obj.feature is None or len(obj.feature) != size else obj.feature
    return LocalInstance(
        local_id=number,
        track=_unseen(),
        feature=np.asarray(feature / np.linalg.norm(feature), np.float32),
        support=Support(points.astype(np.float32), np.ones(len(points), np.float32), rgb),
        stability=1.0,
        names=() if obj.label is None else ((obj.label, _SURE),) * 4,
    )


def _unseen() -> MaskTrack:
    """A track without frames: the map does not say in which pictures an object is."""
    return MaskTrack(
        frames=np.zeros(0, np.int64),
        boxes_xyxy=np.zeros((0, 4), np.float32),
        centers_xy=np.zeros((0, 2), np.float32),
        areas_px=np.zeros(0, np.int32),
        visible_fraction=np.zeros(0, np.float32),
        masks=(),
        image_size=(1, 1),
    )
