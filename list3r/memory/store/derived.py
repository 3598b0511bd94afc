"""What is derived from an open memory and kept until it is closed."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Generic, TypeVar

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

KEPT_TURNS = 8
"""Chunks that come until what none of them asked for is dropped: a walk leaves most of a house behind."""


def cache_folder(kind: str) -> Path:
    """Return where files that can be made again are kept: in `$LIST3R_CACHE`, else in the user's cache."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    return Path(os.environ.get("LIST3R_CACHE") or home / "list3r") / kind


class Derived:
    """Caches that belong to one open store: one object of each class, dropped together with the store."""

    def __init__(self) -> None:
        self._objects: dict[type, object] = {}

    def end_turn(self) -> None:
        """Let caches that have turns drop what was not asked for in the last ones."""
        for found in self._objects.values():
            if isinstance(found, LruCache):
                found.end_turn()

    def of(self, kind: type[T]) -> T:
        """Return the store's object of a class, made without arguments when it is first asked for."""
        if kind not in self._objects:
            self._objects.setdefault(kind, kind())
        found = self._objects[kind]
        assert isinstance(found, kind)
        return found


class CurrentCache(Generic[K, V]):
    """What was read of a file, those values that were asked for last; dropped when the file has changed."""

    def __init__(self, stamp: Callable[[], object], limit: int, size: Callable[[V], int]) -> None:
        """`stamp` tells the state of the file; see `LruCache` for the others."""
        self._stamp, self._limit, self._size = stamp, limit, size
        self._values: LruCache[K, V] = LruCache(limit, size)
        self._state: object = None

    def get(self, key: K, read: Callable[[], V]) -> V:
        """Return what is kept, else what `read` returns."""
        state = self._stamp()
        if state != self._state:
            self._values, self._state = LruCache(self._limit, self._size), state
        held = self._values.get(key)
        return self._values.put(key, read()) if held is None else held


class LruCache(Generic[K, V]):
    """Values that were asked for last; those used longest ago are dropped when all together exceed a limit, and at the
    end of a turn, where there are turns, those that nobody asked for in the last `turns`."""

    def __init__(self, limit: int, size: Callable[[V], int] | None = None, turns: int = 0) -> None:
        self._limit, self._size, self._turns = limit, size or (lambda value: 1), turns
        self._values: OrderedDict[K, tuple[int, V]] = OrderedDict()
        self._asked: dict[K, int] = {}
        """In which turn each value was asked for last."""
        self._held = self._turn = 0

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, key: K) -> bool:
        return key in self._values

    def get(self, key: K) -> V | None:
        """Return a value that is kept, else None."""
        if key not in self._values:
            return None
        self._values.move_to_end(key)
        self._asked[key] = self._turn
        return self._values[key][1]

    def put(self, key: K, value: V) -> V:
        """Keep a value, at least until the next one comes, and return it."""
        self._held -= self._values.pop(key, (0, value))[0]
        self._values[key] = (self._size(value), value)
        self._asked[key] = self._turn
        self._held += self._values[key][0]
        while self._held > self._limit and len(self._values) > 1:
            self._drop_oldest()
        return value

    def end_turn(self) -> None:
        """Drop what was not asked for in the last turns."""
        self._turn += 1
        while self._turns and self._values and self._asked[next(iter(self._values))] < self._turn - self._turns:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        key, (size, _) = self._values.popitem(last=False)
        del self._asked[key]
        self._held -= size
