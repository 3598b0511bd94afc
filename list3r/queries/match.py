"""The answer of every query, and the filters that all of them share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import ParamSpec, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import OptionError, UnknownIdError, check_choice, check_share
from list3r.memory.core.records import BestView, Instance
from list3r.memory.store.store import Store
from list3r.queries.answers import Answers
from list3r.queries.finding.words import is_colored, is_named, wanted_words
from list3r.queries.rooms import rooms_of

STATES = ("present", "moved", "removed", "added", "unseen", "any")
"""What may be asked for; without a state all things answer but those that are known to be gone."""


@dataclass(frozen=True)
class Match:
    """One instance that answers a question.

    Distances are metres; in a memory whose scale is relative they are that memory's own units.
    """

    instance: Instance
    score: float
    """How well it answers, larger is better; what it means depends on the query and stands in `reason`."""
    distance_m: float | None
    """Between surfaces as they were seen, 0 where two things touch; None where the question has no place."""
    center_distance_m: float | None
    """Between centres of boxes (or from the point asked about to the centre)."""
    reason: str
    """Why it is here, in words."""
    view: BestView | None = None
    """The frame that the question was about, with the thing's box in it; None for questions about no frame."""

    @property
    def best_view(self) -> BestView | None:
        """The picture to look at: of the frame asked about, else where the thing is seen best."""
        return self.view or self.instance.best_view

    def __repr__(self) -> str:
        far = "" if self.distance_m is None else f"{self.distance_m:.2f} away, "
        return f"<Match {self.score:.2f}: {repr(self.instance)[1:-1]}; {far}{self.reason}>"


class Matches(Answers[Match]):
    """Answers, the best first, with what can be said of the question as a whole."""

    def __init__(self, matches: Iterable[Match] = (), notes: Sequence[str] = (), total: int | None = None) -> None:
        super().__init__(matches)
        self.notes = tuple(dict.fromkeys(notes))
        """What a reader should know, such as what was left out."""
        self.total = total
        """How many answer in all, those that are not in the list too; None where the question stops at the k-th."""


P = ParamSpec("P")
R = TypeVar("R")


def of_one_state(query: Callable[P, R]) -> Callable[P, R]:
    """Return a query of a store, its first argument, that reads one state of it, whatever is written meanwhile. One
    look at the file for all statements takes less time, too.
    """

    @wraps(query)
    def asked(*args: P.args, **options: P.kwargs) -> R:
        store = args[0]
        assert isinstance(store, Store)
        with store.snapshot():
            return query(*args, **options)

    return asked


class FilterOptions(TypedDict, total=False):
    """The filters that every query takes by name, see `Filters`."""

    structure: bool
    min_confidence: float
    state: str | None
    label: str | None
    color: str | None
    min_size: float | None
    max_size: float | None
    component: int | None
    dynamic: bool | None
    room: int | str | None


@dataclass(frozen=True)
class Filters:
    """Which instances a question is about."""

    structure: bool = False
    """Whether floor, walls and the like are included."""
    min_confidence: float = 0.0
    state: str | None = None
    """present, moved, removed, added, unseen, or any; None for all but removed."""
    label: str | None = None
    """Words that must all be in the label, the description or the kind of structure."""
    color: str | None = None
    """A colour; "red" includes dark red."""
    min_size: float | None = None
    """Longest edge at least this, world units."""
    max_size: float | None = None
    """Longest edge at most this, world units."""
    component: int | None = None
    """Only this connected component, see `Instance.component`."""
    dynamic: bool | None = None
    """Only what was seen moving (True), or what was not (False)."""
    among: frozenset[int] | None = None
    """Only these ids: what is in a room."""

    @staticmethod
    def of(store: Store, options: FilterOptions) -> Filters:
        """Return the filters of a question. Raises `OptionError` for a room that there is not."""
        chosen = dict(options)
        room = chosen.pop("room", None)
        inside = None if room is None else frozenset(n for r in rooms_of(store, room) for n in r.instances)  # type: ignore[arg-type]
        return Filters(**chosen, among=inside)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        check_share("min_confidence", self.min_confidence)
        if self.state is not None:
            check_choice("state", self.state, STATES)
        for words in (self.label, self.color):
            if words is not None:
                wanted_words(words)
        for name, length in (("min_size", self.min_size), ("max_size", self.max_size)):
            if length is not None:
                checked_length(length, name)
        if self.min_size is not None and self.max_size is not None and self.min_size > self.max_size:
            raise OptionError(f"min_size {self.min_size:g} above max_size {self.max_size:g} leaves nothing; swap them")

    @property
    def stored_state(self) -> str | None:
        """The one state that may answer, None for several."""
        return None if self.state == "any" else self.state

    def select(self, instances: Iterable[Instance]) -> list[Instance]:
        """Return those that pass."""
        return [i for i in instances if self.passes(i)]

    def passes(self, i: Instance) -> bool:
        """Tell whether a question is about this one."""
        sized = self.min_size is not None or self.max_size is not None
        size = float(np.max(i.box.size)) if sized else 0.0
        return (
            (self.structure or i.structure is None)
            and i.confidence >= self.min_confidence
            and (i.state != "removed" if self.state is None else self.state in ("any", i.state))
            and (self.label is None or is_named(i, self.label))
            and (self.color is None or is_colored(i, self.color))
            and (self.min_size is None or size >= self.min_size)
            and (self.max_size is None or size <= self.max_size)
            and (self.component is None or i.component == self.component)
            and (self.dynamic is None or i.dynamic == self.dynamic)
            and (self.among is None or i.id in self.among)
        )


_MOST = 1_000_000_000
"""Answers that anybody can want."""
_FARTHEST = 1e100
"""A coordinate whose square is still a number."""
_LARGEST_ID = 2**63 - 1
"""Of what a file holds."""


def checked_instance(store: Store, instance_id: int) -> Instance:
    """Return the instance of an id or of an alias. Raises `UnknownIdError`, also for a number that no id can be."""
    if not 0 <= int(instance_id) <= _LARGEST_ID:
        raise UnknownIdError(f"{store.path} has no instance {instance_id}; `list3r list {store.path}` shows the ids")
    return store.instances.get(int(instance_id))


def checked_count(k: int) -> int:
    """Return the count of answers, at least 1. Raises `OptionError`."""
    if k < 1:
        raise OptionError(f"k = {k}: ask for at least 1 answer")
    return min(int(k), _MOST)


def checked_point(value: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return a point of three finite numbers. Raises `OptionError`."""
    try:
        point = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{name} must be three numbers x, y, z, not {value!r}") from error
    if point.shape != (3,) or not np.isfinite(point).all():
        raise OptionError(f"{name} must be three finite numbers x, y, z, not {str(point.tolist())[:80]}")
    if np.abs(point).max() > _FARTHEST:
        raise OptionError(f"{name} {point.tolist()} is too far away; distances up to {_FARTHEST:g} can be computed")
    return point


def checked_length(value: float, name: str) -> float:
    """Return a finite length that is not negative. Raises `OptionError`."""
    if not np.isfinite(value) or value < 0:
        raise OptionError(f"{name} {value} must be a finite length, 0 or more")
    return float(value)
