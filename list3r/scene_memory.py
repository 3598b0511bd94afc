"""The face of a memory for Python: opening, asking, exporting."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.registry import export as export_memory
from list3r.memory.records import Instance, Relation, Support
from list3r.memory.store import Store
from list3r.memory_edits import MemoryEdits
from list3r.queries.match import Match
from list3r.queries.nearest import nearest
from list3r.queries.relations import relations
from list3r.queries.similar import similar
from list3r.queries.within import within

if TYPE_CHECKING:
    import networkx

    from list3r.chunk_stage import BuildSettings
    from list3r.frames.options import SourceOptions


def open(path: str | Path, *, writable: bool = False) -> SceneMemory:
    """Open a memory, for reading or for editing too. Raises `MemoryFileError` for anything that is not one.

    Many may read while one writes; a second writer is refused.
    """
    return SceneMemory(Store.open(path, writable=writable))


def build(
    source: str | Path,
    memory: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | None = None,
    workers: int | None = None,
    resume: bool = False,
    force: bool = False,
) -> SceneMemory:
    """Build the memory of a video or folder and open it.

    `options` says what is known of the source (intrinsics, depth scale, ...), `settings` how it is worked on.
    `resume` goes on with a build that was interrupted; `force` replaces an existing memory.
    Raises `SourceError`, `OptionError`, `MemoryFileError` or `TrackingError`, each with the way to mend it.
    """
    from list3r import pipeline

    pipeline.build(source, memory, options=options, settings=settings, workers=workers, resume=resume, force=force)
    return open(memory)


class SceneMemory(MemoryEdits):
    """A memory that is open; use it as a context manager or call `close`."""

    def __init__(self, store: Store) -> None:
        self.store = store

    @property
    def path(self) -> Path:
        """The file."""
        return self.store.path

    @property
    def units(self) -> str:
        """`m` when lengths are metres, `unit` when the memory has no known scale."""
        return "unit" if self.store.get_value("scale_kind") == "relative" else "m"

    @property
    def gravity(self) -> str:
        """known, estimated (z is up in both) or unknown."""
        return str(self.store.get_value("gravity", "unknown"))

    def instances(self, *, structure: bool | None = False) -> list[Instance]:
        """All things by id; the structure of the room with `structure=True`, both with None."""
        return self.store.instances(structure=structure)

    def instance(self, instance_id: int) -> Instance:
        """One instance, by its id or by any id it ever had. Raises `UnknownIdError`."""
        return self.store.instance(instance_id)

    def support(self, instance_id: int) -> Support:
        """Surface points of an instance, world coordinates."""
        return self.store.support(instance_id)

    def track(self, instance_id: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where a moving (`dynamic`) instance was: seconds (V,) and places in the world (V, 3); nothing for others."""
        return self.store.track(instance_id)

    def nearest(self, target: str | int | Sequence[float] | NDArray[Any], k: int = 5, **filters: Any) -> list[Match]:
        """The k things nearest to a point (x, y, z) or to an instance (its id), or those that words name best.

        Filters: see `list3r.queries.nearest.nearest`.
        """
        if isinstance(target, str):
            return nearest(self.store, words=target, k=k, **filters)
        if isinstance(target, int | np.integer):
            return nearest(self.store, instance_id=int(target), k=k, **filters)
        return nearest(self.store, point=target, k=k, **filters)

    def within(self, **region: Any) -> list[Match]:
        """Things in a box (`lower`, `upper`) or a sphere (`center`, `radius`); see `list3r.queries.within.within`."""
        return within(self.store, **region)

    def similar(self, instance_id: int, k: int = 5) -> list[Match]:
        """The things that look most like an instance."""
        return similar(self.store, instance_id=instance_id, k=k)

    def relations(
        self, subject: int | None = None, predicate: str | None = None, object: int | None = None
    ) -> list[Relation]:
        """Relations that match what is given. Raises `OptionError` for a predicate that there is not."""
        return relations(self.store, subject=subject, predicate=predicate, object=object)

    def relation_graph(self) -> networkx.MultiDiGraph:
        """Instances and relations as a graph."""
        from list3r.memory.graphs import relation_graph

        return relation_graph(self.store)

    def merge_graph(self) -> networkx.Graph:
        """Local instances, and the decisions that joined them, as a graph."""
        from list3r.memory.graphs import merge_graph

        return merge_graph(self.store)

    def export(self, format: str, path: str | Path) -> tuple[Path, ...]:
        """Write the memory in a format: json, usd, ply, glb, tum, plan. Raises `OptionError` and `ExportError`.

        Returns the files written: `path`, and more beside it where parts of the memory could not be joined.
        """
        with self.store.snapshot():
            return export_memory(self.store, format, path)

    def close(self) -> None:
        """Close the file."""
        self.store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
