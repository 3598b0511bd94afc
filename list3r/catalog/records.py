"""Records and answers of a catalogue."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import List3rError, check_choice, check_share
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import Shape
from list3r.queries.match import STATES


class CatalogError(List3rError):
    """A catalogue that cannot be reached, read or written, or lacks the requested content."""


class UnknownMemoryError(CatalogError):
    """A name that no memory of the catalogue has."""


@dataclass(frozen=True)
class MemoryEntry:
    """A memory file as the catalogue knows it."""

    name: str
    path: str
    """Path or URL of the file."""
    revision: int
    """Goes up by one whenever another file takes the name; 0 before the catalogue gave one."""
    sha256: str
    """Of the file."""
    bytes: int
    mtime_ns: int
    """When the file was last written; 0 where its store does not say."""
    scale_kind: str
    gravity: str
    instances: int
    sessions: int

    @property
    def units(self) -> str:
        """`m` when lengths are metres, `unit` when the memory has no known scale."""
        return "m" if self.scale_kind in ("metric", "anchored") else "unit"


@dataclass(frozen=True)
class CatalogInstance:
    """An instance in the catalogue."""

    memory: str
    id: int
    label: str | None
    description: str
    state: str
    structure: str | None
    confidence: float
    sigma: float | None
    """Standard deviation of its position, world units; None where it is not known."""
    component: int
    box: OrientedBox
    words: dict[str, int]
    """Words that it has, with how well each names it, in hundredths; empty in answers."""

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the lower and upper corner of its axis-aligned box, world units."""
        reach = np.abs(self.box.rotation) @ (self.box.size / 2.0)
        return (self.box.center - reach).tolist(), (self.box.center + reach).tolist()

    def aabb_distance(self, point: NDArray[np.float64]) -> float:
        """Return the distance of a point (3,) from the axis-aligned box, 0 inside, world units."""
        low, high = map(np.array, self.bounds())
        return float(np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0)))

    def box_numbers(self) -> list[float]:
        """Return centre, size and rotation of its box, 15 numbers."""
        return [*self.box.center.tolist(), *self.box.size.tolist(), *self.box.rotation.ravel().tolist()]


@dataclass(frozen=True)
class SpaceVectors:
    """Vectors of the instances of one memory in one space."""

    space: str
    ids: NDArray[np.int64]
    """Shape (N,)."""
    vectors: Annotated[NDArray[np.float32], Shape((-1, -1))]
    """Shape (N, D)."""


@dataclass(frozen=True)
class MemoryContent:
    """All that the catalogue takes from a memory file."""

    entry: MemoryEntry
    instances: list[CatalogInstance]
    relations: list[tuple[int, str, int, float, float]]
    """Subject, predicate, object, confidence, margin."""
    spaces: list[SpaceVectors]


@dataclass(frozen=True)
class CatalogFilters:
    """Which instances a question is about."""

    structure: bool = False
    min_confidence: float = 0.0
    state: str | None = None
    """present, moved, removed, added, unseen, or any; None for all that are not known to be gone."""

    def __post_init__(self) -> None:
        check_share("min_confidence", self.min_confidence)
        if self.state is not None:
            check_choice("state", self.state, STATES)


@dataclass(frozen=True)
class Wanted:
    """Instances that a question asks for: by words or an id, and by relations."""

    words: tuple[str, ...] = ()
    """Words that it must have, all."""
    instance_id: int | None = None
    where: tuple[tuple[tuple[str, ...], Wanted], ...] = ()
    """Alternative predicates, and the object."""


@dataclass(frozen=True)
class CatalogMatch:
    """One instance that answers a question, and where it is to be found."""

    memory: str
    revision: int
    path: str
    stale: bool | None
    """Whether the file has changed since; None where unchecked."""
    id: int
    label: str | None
    description: str
    state: str
    confidence: float
    center: tuple[float, ...]
    size: tuple[float, ...]
    units: str
    score: float
    distance: float | None
    """To the oriented box; None where the question has no place."""
    reason: str


@dataclass(frozen=True)
class CatalogRelation:
    """One relation that answers a question."""

    memory: str
    revision: int
    path: str
    stale: bool | None
    subject: int
    subject_name: str
    predicate: str
    object: int
    object_name: str
    confidence: float
    margin: float


class CatalogAnswers(list[Any]):
    """Answers, the best first, with notes on the question as a whole."""

    def __init__(self, found: Iterable[Any] = (), notes: Sequence[str] = ()) -> None:
        super().__init__(found)
        self.notes = tuple(dict.fromkeys(notes))
        self.counted: int | None = None
        """How many there are, for a question that asks so."""
        self.answer: str | None = None
        """yes or no, for a question that asks so."""

    def facts(self) -> dict[str, object]:
        """Return what is said of the answer as a whole; nothing where the question asks for neither."""
        facts = {"count": self.counted, "answer": self.answer}
        return {name: value for name, value in facts.items() if value is not None}
