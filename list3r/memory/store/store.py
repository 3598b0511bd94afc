"""The store: one SQLite file that is the only truth; nothing outside `memory` knows that it is SQLite."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Self

from list3r.memory.core.errors import List3rError, MemoryFileError
from list3r.memory.store.connection import Connection, is_ours
from list3r.memory.store.derived import Derived
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
        self.derived = Derived()
        """What is made of the memory and kept until it is closed."""

    @cached_property
    def facts(self) -> Facts:
        """What is known of the memory as a whole."""
        return Facts(self.connection)

    # ------------------------------------------------------------------ what chunks measured, and where they lie

    @cached_property
    def sessions(self) -> Sessions:
        """The videos."""
        return Sessions(self.connection)

    @cached_property
    def frames(self) -> Frames:
        """The frames of the trajectory."""
        return Frames(self.connection)

    @cached_property
    def keyframes(self) -> Keyframes:
        """Frames by which places are found again."""
        return Keyframes(self.connection)

    @cached_property
    def supports(self) -> Supports:
        """Surfaces of local instances."""
        return Supports(self.connection)

    @cached_property
    def local_instances(self) -> LocalInstances:
        """What one chunk measured of one thing."""
        return LocalInstances(self.connection, self.supports)

    @cached_property
    def chunks(self) -> Chunks:
        """Chunks, and where each lies."""
        return Chunks(self.connection, self.frames, self.keyframes, self.local_instances)

    @cached_property
    def edges(self) -> Edges:
        """Relations of chunks."""
        return Edges(self.connection)

    @cached_property
    def bends(self) -> Bends:
        """How chunks bend."""
        return Bends(self.connection)

    @cached_property
    def votes(self) -> LabelVotes:
        """Votes for labels."""
        return LabelVotes(self.connection)

    @cached_property
    def trajectory(self) -> PlacedTrajectory:
        """Where the cameras were."""
        return PlacedTrajectory(self.chunks, self.frames, self.bends)

    # ------------------------------------------------------------------ what is derived, and what operators said of it

    @cached_property
    def pair_scores(self) -> PairScoreTable:
        """How pairs of chunks overlap."""
        return PairScoreTable(self.connection)

    @cached_property
    def merges(self) -> MergeLog:
        """Decisions of merging."""
        return MergeLog(self.connection)

    @cached_property
    def edits(self) -> Edits:
        """What operators changed."""
        return Edits(self.connection)

    @cached_property
    def ids(self) -> Ids:
        """What ids stand for today."""
        return Ids(self.connection, self.facts)

    @cached_property
    def embeddings(self) -> Embeddings:
        """Vectors of instances."""
        return Embeddings(self.connection)

    @cached_property
    def relations(self) -> RelationTable:
        """Relations of instances."""
        return RelationTable(self.connection, self.ids)

    @cached_property
    def events(self) -> Events:
        """What changed between sessions."""
        return Events(self.connection)

    @cached_property
    def rooms(self) -> RoomTable:
        """Rooms and the doorways between them."""
        return RoomTable(self.connection)

    @cached_property
    def detected_labels(self) -> DetectedLabels:
        """Labels of detectors."""
        return DetectedLabels(self.connection)

    @cached_property
    def words(self) -> Words:
        """Words that name instances."""
        return Words(self.connection)

    @cached_property
    def instances(self) -> Instances:
        """The instances of the library."""
        return Instances(self.connection, self.ids, self.words)

    @cached_property
    def observations(self) -> Observations:
        """Which local instances an instance is."""
        return Observations(self.connection, self.ids)

    @cached_property
    def surfaces(self) -> Surfaces:
        """Surfaces of instances in the world."""
        return Surfaces(self.chunks, self.supports, self.instances, self.events)

    @cached_property
    def tracks(self) -> PlacedTracks:
        """Where moving instances were."""
        return PlacedTracks(
            (self.chunks, self.frames), (self.local_instances, self.supports), (self.instances, self.observations)
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
