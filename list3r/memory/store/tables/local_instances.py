"""Local instances: what one chunk measured of one thing, and its surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import Feature, LocalInstance, MaskTrack, MotionTrack, Plane, Support
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.codec import dequantise, pack, quantise, raw_array, unpack
from list3r.memory.store.rows.columns import Columns, joined, nested
from list3r.memory.store.rows.table import Table, batches


@dataclass(frozen=True)
class LocalNode:
    """A local instance without its masks: what merging looks at."""

    chunk_id: int
    local_id: int
    session_id: int
    stability: float
    structure: bool
    dynamic: bool
    plane: Plane | None
    """Chunk coordinates. Shape (4,)."""
    feature: Feature
    """Shape (D,)."""
    support: Support
    """Chunk coordinates."""
    frames: NDArray[np.int64]
    """Frame.index of the visible frames. Shape (V,)."""
    boxes_xyxy: NDArray[np.float32]
    """Shape (V, 4)."""
    areas_px: NDArray[np.int32]
    """Shape (V,)."""
    visible_fraction: NDArray[np.float32]
    """Shape (V,)."""


@dataclass(frozen=True)
class LocalSupport:
    """The surface of a local instance."""

    chunk_id: int
    local_id: int
    support: Support
    """Chunk coordinates."""


@dataclass(frozen=True)
class _LocalRow:
    chunk_id: int
    instance: LocalInstance
    scrap: bool


def _support_columns(support: Support) -> tuple[int, bytes, bytes, bytes, bytes]:
    grid, points = quantise(support.points)
    confidence = np.round(np.clip(support.confidence, 0, 1) * 255).astype(np.uint8).tobytes()
    return len(support.points), grid, points, confidence, support.rgb.astype(np.uint8).tobytes()


def _support(count: int, grid: bytes, points: bytes, confidence: bytes, rgb: bytes) -> tuple[Support]:
    support = Support(
        dequantise(grid, points, count, "the surface"),
        raw_array(confidence, "u1", (count,), "the confidence").astype(np.float32) / 255.0,
        raw_array(rgb, "u1", (count, 3), "the colours").copy(),
    )
    return (support,)


def _track_column(track: MaskTrack) -> tuple[bytes]:
    lengths = np.array([len(m) for m in track.masks], dtype=np.int32)
    runs = np.concatenate(track.masks) if track.masks else np.zeros(0, np.uint32)
    arrays: dict[str, NDArray[Any]] = {
        "frames": track.frames,
        "boxes_xyxy": track.boxes_xyxy.astype(np.float32),
        "centers_xy": track.centers_xy.astype(np.float32),
        "areas_px": track.areas_px.astype(np.int32),
        "visible_fraction": track.visible_fraction.astype(np.float32),
        "image_size": np.asarray(track.image_size, dtype=np.int32),
        "lengths": lengths,
        "runs": runs.astype(np.uint32),
    }
    return (pack(arrays),)


def _track(blob: bytes) -> tuple[MaskTrack]:
    held: dict[str, Any] = unpack(blob, "the masks")
    runs, lengths, size = (held.pop(name) for name in ("runs", "lengths", "image_size"))
    masks = tuple(np.split(runs, np.cumsum(lengths)[:-1])) if len(lengths) else ()
    height, width = (int(n) for n in size)
    return (MaskTrack(**held, masks=masks, image_size=(height, width)),)


_OF_TRACK = ("frames", "boxes_xyxy", "areas_px", "visible_fraction")


def _sightings(blob: bytes) -> list[Any]:
    held = unpack(blob, "the masks")
    return [held[name] for name in _OF_TRACK]


_SUPPORT = joined(("count", "grid", "points", "confidence", "rgb"), ("support",), _support_columns, _support)
_INSTANCE = Columns(
    LocalInstance, joined(("track",), ("track",), _track_column, _track), omit=("support", "names", "named")
)
_NODE = Columns(LocalNode, _SUPPORT, joined(("track",), _OF_TRACK, lambda *_: (), _sightings))


_ONE = "chunk_id = ? AND local_id = ?"


class Supports:
    """The table of surfaces of local instances. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        order, columns = "chunk_id, local_id", Columns.of(LocalSupport, _SUPPORT)
        self._rows = Table(connection, "supports", columns, order)
        of_instances = "observations JOIN supports USING (chunk_id, local_id)"
        self._observed = Table(connection, "supports", columns, order, source=of_instances)

    def add(self, chunk_id: int, local_id: int, support: Support) -> None:
        """Store the surface of a local instance, chunk coordinates."""
        self._rows.add(LocalSupport(chunk_id, local_id, support))

    def get(self, chunk_id: int, local_id: int) -> Support | None:
        """Return the surface of a local instance, chunk coordinates."""
        found = self._rows.first("chunk_id = ? AND local_id = ?", (chunk_id, local_id))
        return None if found is None else found.support

    def of(self, instance_id: int) -> list[LocalSupport]:
        """Return the surfaces of all local instances of an instance (no alias)."""
        return self._observed.all("instance = ?", (int(instance_id),))

    def of_each(self, ids: Sequence[int]) -> dict[int, list[LocalSupport]]:
        """Return `of` for some instances, by id; nothing for those of which nothing was observed."""
        query = "SELECT chunk_id, local_id, instance FROM observations WHERE instance IN ({})"
        with self._connection.snapshot():
            rows = [row for part, marks in batches(ids) for row in self._connection.rows(query.format(marks), part)]
            owner = {(chunk_id, local_id): instance for chunk_id, local_id, instance in rows}
            supports = self._observed.among("instance", sorted(set(owner.values())))
        found: dict[int, list[LocalSupport]] = {}
        for s in sorted(supports, key=lambda s: (s.chunk_id, s.local_id)):
            found.setdefault(owner[s.chunk_id, s.local_id], []).append(s)
        return found


class LocalInstances:
    """The table of local instances. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection, supports: Supports) -> None:
        self._connection = connection
        self._supports = supports
        order = "chunk_id, local_id"
        columns = Columns.of(_LocalRow, nested("instance", _INSTANCE))
        self._rows = Table(connection, "local_instances", columns, order)
        self._measured = Table(connection, "local_instances", _INSTANCE, order)
        nodes = "local_instances JOIN chunks USING (chunk_id) JOIN supports USING (chunk_id, local_id)"
        self._nodes = Table(connection, "local_instances", _NODE, order, source=nodes)

    def add(self, chunk_id: int, instance: LocalInstance, *, scrap: bool = False) -> None:
        """Store one more local instance or scrap of a chunk, under a local id that the chunk does not have yet."""
        self._rows.add(_LocalRow(chunk_id, instance, scrap))
        self._supports.add(chunk_id, instance.local_id, instance.support)

    def nodes(self, chunk_ids: Sequence[int] | None = None, *, scraps: bool = False) -> list[LocalNode]:
        """Return local instances, or the `scraps`, without masks, of some chunks or of all, by (chunk, local id).

        A feature of another length than the first one of the memory, of another embedding space, is given as zeros.
        """
        which = "" if chunk_ids is None else f" AND chunk_id IN ({','.join('?' * len(chunk_ids))})"
        found = self._nodes.all(f"scrap = ?{which}", (scraps, *(chunk_ids or ())))
        query = "SELECT length(feature) / 4 FROM local_instances ORDER BY chunk_id, local_id LIMIT 1"
        blank = np.zeros(self._connection.rows(query)[0][0] if found else 0, np.float32)
        return [n if len(n.feature) == len(blank) else replace(n, feature=blank) for n in found]

    def scraps(self) -> list[tuple[int, int]]:
        """Return (chunk id, local id) of all scraps, in order."""
        query = "SELECT chunk_id, local_id FROM local_instances WHERE scrap ORDER BY chunk_id, local_id"
        return [(int(k), int(n)) for k, n in self._connection.rows(query)]

    def next_id(self, chunk_id: int) -> int:
        """Return a local id that no local instance of a chunk has, larger than all."""
        query = "SELECT coalesce(max(local_id), -1) FROM local_instances WHERE chunk_id = ?"
        return int(self._connection.rows(query, (chunk_id,))[0][0]) + 1

    def mask_track(self, chunk_id: int, local_id: int) -> MaskTrack:
        """Return the masks of one local instance. Raises `MemoryFileError` when it is not there."""
        found: list[MaskTrack] = self._measured.values("track", _ONE, (chunk_id, local_id))
        if not found:
            raise MemoryFileError(f"{self._connection.path} has no local instance {local_id} in chunk {chunk_id}")
        return found[0]

    def motion_track(self, chunk_id: int, local_id: int) -> MotionTrack | None:
        """Return where a moving local instance was, chunk coordinates; None for one that does not move."""
        found: list[MotionTrack | None] = self._measured.values("motion", _ONE, (chunk_id, local_id))
        return found[0] if found else None

    def flag_dynamic(self, chunk_id: int, motions: Mapping[int, MotionTrack | None]) -> None:
        """Say of local instances, by local id, that they move, and where they were."""
        (packed,) = _INSTANCE.column("motion").write(list(motions.values())) if motions else ((),)
        self._connection.execute_many(
            "UPDATE local_instances SET dynamic = 1, motion = coalesce(?, motion) WHERE chunk_id = ? AND local_id = ?",
            [(motion, chunk_id, n) for n, motion in zip(motions, packed, strict=True)],
        )

    def dynamic(self, chunk_id: int) -> list[int]:
        """Return the local ids of a chunk's instances that move."""
        query = "SELECT local_id FROM local_instances WHERE chunk_id = ? AND dynamic ORDER BY local_id"
        return [int(n) for (n,) in self._connection.rows(query, (chunk_id,))]

    def structure(self, chunk_ids: Sequence[int]) -> set[tuple[int, int]]:
        """Return (chunk id, local id) of those of some chunks that are flagged as structure."""
        query = "SELECT chunk_id, local_id FROM local_instances WHERE structure AND chunk_id IN ({})"
        parts = [self._connection.rows(query.format(marks), part) for part, marks in batches(chunk_ids)]
        return {(int(k), int(n)) for rows in parts for k, n in rows}

    def any_dynamic(self) -> bool:
        """Return whether any local instance was seen moving."""
        return bool(self._connection.rows("SELECT 1 FROM local_instances WHERE dynamic LIMIT 1"))

    def signature(self, chunk_id: int) -> tuple[object, ...]:
        """Return what changes when local instances of a chunk come in or are seen to move."""
        query = "SELECT local_id, length(motion) FROM local_instances WHERE dynamic AND chunk_id = ? ORDER BY local_id"
        count = self._connection.rows("SELECT count(*) FROM local_instances WHERE chunk_id = ?", (chunk_id,))
        return count[0][0], *self._connection.rows(query, (chunk_id,))
