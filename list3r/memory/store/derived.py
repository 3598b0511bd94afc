"""What is derived from an open memory and kept until it is closed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Derived:
    """Caches that belong to one open store: one object of each class, dropped together with the store."""

    def __init__(self) -> None:
        self._objects: dict[type, object] = {}

    def of(self, kind: type[T]) -> T:
        """Return the store's object of a class, made without arguments when it is first asked for."""
        if kind not in self._objects:
            self._objects.setdefault(kind, kind())
        found = self._objects[kind]
        assert isinstance(found, kind)
        return found


class LruCache(Generic[K, V]):
    """Values that were asked for last; those used longest ago are dropped when all together exceed a limit."""

    def __init__(self, limit: int, size: Callable[[V], int] | None = None) -> None:
        self._limit, self._size = limit, size or (lambda value: 1)
        self._values: OrderedDict[K, tuple[int, V]] = OrderedDict()
        self._held = 0

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: K) -> V | None:
        """Return a value that is kept, else None."""
        if key not in self._values:
            return None
        self._values.move_to_end(key)
        return self._values[key][1]

    def put(self, key: K, value: V) -> V:
        """Keep a value, at least until the next one comes, and return it."""
        self._held -= self._values.pop(key, (0, value))[0]
        self._values[key] = (self._size(value), value)
        self._held += self._values[key][0]
        while self._held > self._limit and len(self._values) > 1:
            self._held -= self._values.popitem(last=False)[1][0]
        return value
