"""The store: one SQLite file that is the only truth; nothing outside `memory` knows that it is SQLite."""

from __future__ import annotations

from collections.abc import Hashable
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from list3r.memory.core.errors import List3rError, MemoryFileError
from list3r.memory.store.connection import Connection, is_ours
from list3r.memory.store.derived import CurrentCache, Derived
from list3r.memory.store.facts import Facts
from list3r.memory.store.file import damaged
from list3r.memory.store.placed import PlacedTracks, PlacedTrajectory, Surfaces
from list3r.memory.store.tables.chunks import Chunks
from list3r.memory.store.tables.edges import Bends, Edges
from list3r.memory.store.tables.edits import Edits, MergeLog
from list3r.memory.store.tables.embeddings import Embeddings
from list3r.memory.store.tables.events import Events
from list3r.memory.store.tables.frames import Frames, Keyframes
from list3r.memory.store.tables.ids import Ids
from list3r.memory.store.tables.instances import Instances
from list3r.memory.store.tables.labels import DetectedLabels, LabelVotes
from list3r.memory.store.tables.local_instances import LocalInstances, Supports
from list3r.memory.store.tables.observations import Observations
from list3r.memory.store.tables.pair_scores import PairScoreTable
from list3r.memory.store.tables.relations import RelationTable
from list3r.memory.store.tables.rooms import RoomTable
from list3r.memory.store.tables.sessions import Sessions
from list3r.memory.store.tables.words import Words


class Store:
    """The memory file: `Store.open(path)` to read, `writable=True` to write, `Store.create(path)` for a new one.

    What it holds is asked for and written by one object for each table (`store.chunks.all()`). What writes is called
    inside `transaction()`.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection

    derived = cached_property(lambda _: Derived())
    """What is made of the memory and kept until it is closed."""
    current = cached_property(lambda s: CurrentCache[Hashable, Any](s.connection.stamp, 64, lambda _: 1))
    """What is made of the memory and kept until the file changes, by name."""
    facts = cached_property(lambda s: Facts(s.connection))
    sessions = cached_property(lambda s: Sessions(s.connection))
    frames = cached_property(lambda s: Frames(s.connection))
    keyframes = cached_property(lambda s: Keyframes(s.connection))
    supports = cached_property(lambda s: Supports(s.connection))
    local_instances = cached_property(lambda s: LocalInstances(s.connection, s.supports))
    chunks = cached_property(lambda s: Chunks(s.connection, s.frames, s.keyframes, s.local_instances))
    edges = cached_property(lambda s: Edges(s.connection))
    bends = cached_property(lambda s: Bends(s.connection))
    votes = cached_property(lambda s: LabelVotes(s.connection))
    trajectory = cached_property(lambda s: PlacedTrajectory(s.chunks, s.frames, s.bends))
    pair_scores = cached_property(lambda s: PairScoreTable(s.connection))
    merges = cached_property(lambda s: MergeLog(s.connection))
    edits = cached_property(lambda s: Edits(s.connection))
    ids = cached_property(lambda s: Ids(s.connection, s.facts))
    embeddings = cached_property(lambda s: Embeddings(s.connection))
    relations = cached_property(lambda s: RelationTable(s.connection, s.ids))
    events = cached_property(lambda s: Events(s.connection))
    rooms = cached_property(lambda s: RoomTable(s.connection))
    detected_labels = cached_property(lambda s: DetectedLabels(s.connection))
    words = cached_property(lambda s: Words(s.connection))
    instances = cached_property(lambda s: Instances(s.connection, s.ids, s.words))
    observations = cached_property(lambda s: Observations(s.connection, s.ids))
    surfaces = cached_property(lambda s: Surfaces(s.chunks, s.supports, s.instances, s.events))
    tracks = cached_property(
        lambda s: PlacedTracks((s.chunks, s.frames), (s.local_instances, s.supports), (s.instances, s.observations))
    )

    @classmethod
    def create(cls, path: str | Path) -> Self:
        """Create a memory, empty and open for writing. Raises `MemoryFileError` when the path is taken or not writable.

        The file appears under its name only when it is whole.
        """
        return cls(Connection.create(path))

    @classmethod
    def open(cls, path: str | Path, *, writable: bool = False) -> Self:
        """Open a memory. Raises `MemoryFileError` for anything else, and for a memory of a newer schema.

        See `Connection.open` for memories of older schemas.
        """
        return cls(Connection.open(path, writable=writable))

    @property
    def path(self) -> Path:
        """The file."""
        return self.connection.path

    @property
    def writable(self) -> bool:
        """Whether the file was opened for writing."""
        return self.connection.writable

    def beside(self) -> str | None:
        """Return what is to be known of a file that is not whole by itself; None where it is."""
        return self.connection.beside()

    def transaction(self) -> AbstractContextManager[None]:
        """Write all that is written inside together or not at all. Not re-entrant."""
        return self.connection.transaction()

    def snapshot(self) -> AbstractContextManager[None]:
        """Read all that is read inside of one state of the memory, whatever a writer commits meanwhile."""
        return self.connection.snapshot()

    def close(self) -> None:
        """Fold the write-ahead log into the one file, release the lock. A second call does nothing."""
        self.connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        unexplained = isinstance(error, Exception) and not isinstance(error, List3rError | OSError) and is_ours(trace)
        found = self.verify() if unexplained else []
        self.close()
        if found:
            raise MemoryFileError(damaged(self.path, found[0])) from error

    def verify(self) -> list[str]:
        """Return every damage found: pages, values that no row may hold, rows that point nowhere.

        Empty when the file is sound. One pass over the file; about 0.1 s for 25 MB.
        """
        return self.connection.damage()
