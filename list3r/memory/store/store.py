"""The store: one SQLite file that is the only truth; nothing outside `memory` knows that it is SQLite."""

from __future__ import annotations

from contextlib import AbstractContextManager
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
        self.facts = Facts(connection)
        self.sessions = Sessions(connection)
        self.frames = Frames(connection)
        self.keyframes = Keyframes(connection)
        self.supports = Supports(connection)
        self.local_instances = LocalInstances(connection, self.supports)
        self.chunks = Chunks(connection, self.frames, self.keyframes, self.local_instances)
        self.edges = Edges(connection)
        self.bends = Bends(connection)
        self.votes = LabelVotes(connection)
        self.trajectory = PlacedTrajectory(self.chunks, self.frames, self.bends)
        self.pair_scores = PairScoreTable(connection)
        self.merges = MergeLog(connection)
        self.edits = Edits(connection)
        self.ids = Ids(connection, self.facts)
        self.embeddings = Embeddings(connection)
        self.relations = RelationTable(connection, self.ids)
        self.events = Events(connection)
        self.rooms = RoomTable(connection)
        self.detected_labels = DetectedLabels(connection)
        self.words = Words(connection)
        self.instances = Instances(connection, self.ids, self.words)
        self.observations = Observations(connection, self.ids)
        self.surfaces = Surfaces(self.chunks, self.supports, self.instances, self.events)
        self.tracks = PlacedTracks(
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
