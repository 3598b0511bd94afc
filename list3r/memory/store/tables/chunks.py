"""Chunks: what was measured, chunk by chunk, and where each of them lies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult, ChunkRow, Covariance, FrameSamples, Shape
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns, arrays, joined
from list3r.memory.store.rows.table import Table
from list3r.memory.store.tables.frames import Frames, Keyframes
from list3r.memory.store.tables.local_instances import LocalInstances

_INTRINSICS = joined(("fx", "fy", "cx", "cy"), ("intrinsics",), tuple, lambda *px: (px,))
_IMAGE_SIZE = joined(("height", "width"), ("image_size",), tuple, lambda *px: (px,))
_encode_samples, _decode_samples = arrays(
    FrameSamples,
    instance=lambda held: np.full(len(held["frame"]), -1, np.int32),
    camera_frames=lambda _: np.zeros(0, np.int64),
    T_chunk_cam=lambda _: np.zeros((0, 4, 4)),
)
_SAMPLES = joined(("overlap",), ("samples",), lambda s: (_encode_samples(s),), lambda blob: (_decode_samples(blob),))

_BLANK = """
    SELECT chunk_id FROM chunks c
    WHERE NOT EXISTS (SELECT 1 FROM keyframes k WHERE k.chunk_id = c.chunk_id)
      AND NOT EXISTS (SELECT 1 FROM local_instances i WHERE i.chunk_id = c.chunk_id)
      AND NOT EXISTS (SELECT 1 FROM frames f WHERE f.session_id = c.session_id AND f.chunk_id = c.chunk_id
                      AND f.frame_index BETWEEN c.first_frame AND c.last_frame AND f.state = 'posed')
"""


@dataclass(frozen=True)
class _Measured:
    """What a chunk measured, which nothing changes but further pairs of `cannot_link`."""

    session_id: int
    index: int
    first_frame: int
    last_frame: int
    intrinsics: tuple[float, float, float, float]
    image_size: tuple[int, int]
    scale_kind: str
    feature_space: str
    cannot_link: Annotated[NDArray[np.int32], Shape((-1, 2))]
    samples: FrameSamples
    seconds: dict[str, float]


@dataclass(frozen=True)
class _Placement:
    """Where a chunk lies: all that a loop closure moves."""

    chunk_id: int
    component: int
    S_world_chunk: Sim3
    covariance: Covariance | None


class Chunks:
    """The tables of chunks and of where they lie. What writes is called inside `transaction()`."""

    def __init__(
        self,
        connection: Connection,
        frames: Frames,
        keyframes: Keyframes,
        local_instances: LocalInstances,
    ) -> None:
        self._connection = connection
        self._frames = frames
        self._keyframes = keyframes
        self._local_instances = local_instances
        measured = Columns.of(_Measured, _INTRINSICS, _IMAGE_SIZE, _SAMPLES, index="chunk_index")
        self._measured = Table(connection, "chunks", measured, "chunk_id", summed=("cannot_link", "overlap"))
        self._placements = Table(connection, "placements", Columns.of(_Placement), "chunk_id")
        placed = Columns.of(ChunkRow, _INTRINSICS, _IMAGE_SIZE, index="chunk_index")
        both = "chunks JOIN placements USING (chunk_id)"
        self._placed = Table(connection, "chunks", placed, "chunk_id", source=both)
        self._version = -1
        self._known: dict[int, ChunkRow] | None = None
        self._crcs: dict[int, int] | None = None
        connection.on_forget(self._forget)

    def add(self, session_id: int, result: ChunkResult) -> int:
        """Store one chunk as its own component with the identity as `S_world_chunk`; its id.

        Of the frames that it shares with the chunk before, the second half comes to be placed by the new chunk. One of
        whose frames none could be used spans those.
        """
        seen = result.frame_indices.tolist() or [index for index, _ in result.bad_frames]
        chunk_id = self._measured.add(
            _Measured(
                session_id,
                result.index,
                seen[0],
                seen[-1],
                result.intrinsics,
                result.image_size,
                result.scale_kind,
                result.library.feature_space,
                result.library.cannot_link,
                result.samples,
                result.seconds,
            )
        )
        self._placements.put([_Placement(chunk_id, chunk_id, Sim3.identity(), None)])
        if self._known is not None:
            self._known = {**self._known, **{c.chunk_id: c for c in self._placed.all("chunk_id = ?", (chunk_id,))}}
        self._frames.add(session_id, chunk_id, result)
        self._keyframes.add(chunk_id, result.keyframes)
        for instance in result.library.instances:
            self._local_instances.add(chunk_id, instance)
        for scrap in result.library.scraps:
            self._local_instances.add(chunk_id, scrap, scrap=True)
        return chunk_id

    def all(self, session_id: int | None = None) -> list[ChunkRow]:
        """Return the chunks in order, of one session or of all."""
        return [c for c in self._by_id().values() if session_id is None or c.session_id == session_id]

    def get(self, chunk_id: int) -> ChunkRow:
        """Return one chunk. Raises `MemoryFileError` when the memory has none of that id."""
        found = self._by_id().get(chunk_id)
        if found is None:
            raise MemoryFileError(f"{self._connection.path} has no chunk {chunk_id}")
        return found

    def blank(self) -> frozenset[int]:
        """Return ids of the chunks that hold nothing: no frame with a pose, no keyframe, no local instance."""
        return frozenset(int(k) for (k,) in self._connection.rows(_BLANK))

    def place(
        self,
        poses: Mapping[int, Sim3],
        components: Mapping[int, int],
        covariances: Mapping[int, NDArray[np.float64]] | None = None,
    ) -> None:
        """Rewrite `S_world_chunk`, component and uncertainty of chunks: all that a loop closure moves.

        Chunks that are not named stay as they are, and so do the rows of those that lie there already.
        """
        known = covariances or {}
        rows = dict(self._by_id())
        fresh = []
        for k, S in poses.items():
            after = replace(rows[k], S_world_chunk=S, component=int(components[k]), covariance=known.get(k))
            if not _same_place(rows[k], after):
                fresh.append(k)
                rows[k] = after
        self._placements.put(_Placement(k, rows[k].component, rows[k].S_world_chunk, rows[k].covariance) for k in fresh)
        self._known = rows

    def place_unplaced(self) -> list[int]:
        """Give every chunk without a place one of its own, as repair needs it; their ids."""
        rows = self._connection.rows("SELECT chunk_id FROM chunks EXCEPT SELECT chunk_id FROM placements ORDER BY 1")
        missing = [int(k) for (k,) in rows]
        self._placements.put(_Placement(k, k, Sim3.identity(), None) for k in missing)
        self._forget()
        return missing

    def samples(self, chunk_id: int) -> FrameSamples:
        """Return the sampled points of a chunk's frames, chunk coordinates."""
        found: FrameSamples = self._field("samples", chunk_id)
        return found

    def feature_space(self, chunk_id: int) -> str:
        """Return the embedding space of a chunk's local features."""
        return str(self._field("feature_space", chunk_id))

    def cannot_links(self, chunk_id: int) -> NDArray[np.int32]:
        """Return pairs of local ids of a chunk that are two instances. Shape (P, 2)."""
        found: NDArray[np.int32] = self._field("cannot_link", chunk_id)
        return found

    def add_cannot_links(self, chunk_id: int, pairs: Sequence[tuple[int, int]]) -> None:
        """Say of pairs of a chunk's local instances that they are two instances."""
        links = np.concatenate([self.cannot_links(chunk_id), np.array(pairs, np.int32).reshape(-1, 2)])
        self._measured.set("chunk_id = ?", (chunk_id,), cannot_link=links)
        self._crcs = None

    def checksum(self, chunk_id: int) -> int:
        """Return a checksum of all that is known of one chunk; another one after a rollback, which may reuse its id."""
        key, rows = int(chunk_id), self._by_id()
        if self._crcs is None or (key in rows and key not in self._crcs):
            self.checksums()
        known = self._crcs or {}
        return hash((self._connection.rollbacks, known.get(key, 0), *self._local_instances.signature(key)))

    def stage_seconds(self) -> dict[str, float]:
        """Return the CPU seconds spent so far by stage, over all chunks."""
        total: dict[str, float] = {}
        for stages in self._measured.values("seconds", "1"):
            for stage, seconds in stages.items():
                total[stage] = total.get(stage, 0.0) + seconds
        return total

    def forget_seconds(self) -> None:
        """Forget the seconds spent by stage, in which two builds of one video differ."""
        self._measured.set("seconds != ?", ("{}",), seconds={})
        self._crcs = None

    def _field(self, field: str, chunk_id: int) -> Any:
        return self._measured.values(field, "chunk_id = ?", (chunk_id,))[0]

    def _by_id(self) -> dict[int, ChunkRow]:
        """All chunks by id, read again only when another process or a rollback may have changed them."""
        version = self._connection.data_version
        if self._known is None or self._version != version:
            self._known = {c.chunk_id: c for c in self._placed.all()}
            self._version, self._crcs = version, None
        return self._known

    def checksums(self) -> dict[int, int]:
        """Return a checksum of what each chunk measured, by id: tells whether what follows from it still holds."""
        rows = self._by_id()
        if self._crcs is None or self._crcs.keys() != rows.keys():
            known, query = self._crcs or {}, "SELECT crc FROM chunks WHERE chunk_id = ?"
            self._crcs = {k: known[k] if k in known else int(self._connection.rows(query, (k,))[0][0]) for k in rows}
        return dict(self._crcs)

    def _forget(self) -> None:
        self._known = self._crcs = None


def _same_place(a: ChunkRow, b: ChunkRow) -> bool:
    """Whether two rows of one chunk say the same of where it lies."""
    if a.component != b.component or (a.covariance is None) != (b.covariance is None):
        return False
    S, T = a.S_world_chunk, b.S_world_chunk
    same = np.array_equal(S.scale, T.scale) and np.array_equal(S.translation, T.translation)
    same = same and np.array_equal(S.rotation, T.rotation)
    return bool(same and (a.covariance is None or np.array_equal(a.covariance, np.asarray(b.covariance))))
