"""Facts of a whole memory: a key-value table behind typed fields.

`store.facts.gravity` reads one, `store.facts.gravity = "estimated"` writes it, inside `transaction()`. What an upper
layer keeps of a type of its own is a `Fact` declared beside that type: `store.facts[LIBRARY]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Generic, Self, TypeVar, overload

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import UpEstimate
from list3r.memory.core.unpacking import parse_json
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.codec import to_json
from list3r.memory.store.rows.json_values import plain, typed

T = TypeVar("T")


class Fact(Generic[T]):
    """One fact: its key in the table, its type, and what holds where nothing is written down."""

    def __init__(self, key: str, kind: Any, default: T) -> None:
        self.key = key
        self.kind = kind
        self.default = default

    @overload
    def __get__(self, facts: None, owner: type[Facts]) -> Self: ...

    @overload
    def __get__(self, facts: Facts, owner: type[Facts]) -> T: ...

    def __get__(self, facts: Facts | None, owner: type[Facts]) -> Self | T:
        return self if facts is None else facts[self]

    def __set__(self, facts: Facts, value: T) -> None:
        facts[self] = value


class Facts:
    """What is known of a memory as a whole."""

    created_by = Fact[str | None]("created_by", str, None)
    """The program that made it, with its version."""
    scale_kind = Fact[str | None]("scale_kind", str, None)
    """metric, anchored, guessed or relative; None before anything said so."""
    scale_source = Fact[str | None]("scale_source", str, None)
    """Who says how long a unit is."""
    metres_per_graph_unit = Fact[float | None]("metres_per_graph_unit", float, None)
    """Metres in a unit of the pose graph; None where it is one unit of the world."""
    gravity = Fact[str]("gravity", str, "unknown")
    """known, estimated by surfaces, assumed by how the camera was held (z is up in all three), or unknown. It holds for
    the first part of a memory; of the others see `upright_parts`."""
    upright_parts = Fact[tuple[int, ...]]("upright_parts", tuple[int, ...], ())
    """Components but the first in which z is up too, by their own surfaces."""
    gravity_deviation_deg = Fact[float | None]("gravity_deviation_deg", float, None)
    """Of z from up; None where a recorder knew it or nobody does."""
    gravity_estimate = Fact[UpEstimate | None]("gravity_estimate", UpEstimate, None)
    """Which way is up and where the floor is, in the frame of the pose graph."""
    poses = Fact[str | None]("poses", str, None)
    """given, prior or estimate: where the camera poses of the first session come from."""
    S_world_graph = Fact[Sim3]("T_world_graph", Sim3, Sim3.identity())
    """From the frame of the pose graph to the world."""
    last_id = Fact[int]("last_id", int, 0)
    """The largest id that an instance ever had."""
    last_room = Fact[int]("last_room", int, 0)
    """The largest id that a room ever had."""
    text_models = Fact[Mapping[str, str]]("text_models", dict[str, str], MappingProxyType({}))
    """By embedding space, the weights of the text and image model that made its vectors."""
    replaces = Fact[tuple[int, ...] | None]("replaces", tuple[int, ...], None)
    """Of a new memory that takes the place of an old one: what tells that file from any other of its name."""
    label_classes = Fact[dict[str, list[str] | None] | None]("label classes", dict[str, list[str] | None], None)
    """By source of votes, the classes that it knows, None for one that knows every class; None before any vote."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def __getitem__(self, fact: Fact[T]) -> T:
        """Return a fact. Raises `MemoryFileError` for damaged text."""
        found = self._connection.rows("SELECT value FROM memory WHERE key = ?", (fact.key,))
        try:
            value = parse_json(found[0][0]) if found else None
            return fact.default if value is None else typed(fact.kind, value)  # type: ignore[no-any-return]
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            what = f"{self._connection.path}: the value {fact.key} cannot be read ({error})"
            raise MemoryFileError(f"{what}; run `list3r verify` on the file") from error

    def __setitem__(self, fact: Fact[T], value: T) -> None:
        """Write a fact down, inside `transaction()`; None forgets it."""
        if value is None:
            self._connection.execute("DELETE FROM memory WHERE key = ?", (fact.key,))
            return
        row = fact.key, to_json(plain(value))
        if self._connection.rows("SELECT key, value FROM memory WHERE key = ?", row[:1]) != [row]:
            self._connection.execute("INSERT OR REPLACE INTO memory VALUES (?, ?)", row)
