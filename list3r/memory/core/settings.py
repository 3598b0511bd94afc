"""Settings as plain JSON and back, and those that a memory was made with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar, cast

from list3r.memory.core.errors import List3rError, MemoryFileError
from list3r.memory.store.rows.json_values import typed

if TYPE_CHECKING:
    from list3r.memory.store.store import Store

T = TypeVar("T")


def as_plain(settings: Any) -> dict[str, Any]:
    """Return settings, a dataclass of numbers, words, tuples and further settings, as what JSON can hold."""
    return asdict(settings)


def from_plain(kind: type[T], plain: object) -> T:
    """Return the settings of a class that `as_plain` wrote. A field that is not there keeps its default.

    What the class does not know, of another version, is left out. Raises `ValueError` for what does not fit.
    """
    made: T = _made(cast(Any, kind), json.dumps(plain, sort_keys=True))
    return made


@lru_cache(maxsize=64)
def _made(kind: Any, text: str) -> Any:
    """Make settings of their JSON, once: a memory is asked for them many times with every chunk."""
    try:
        return typed(kind, json.loads(text), lenient=True)
    except List3rError as error:
        raise ValueError(str(error)) from error


def stored_settings(store: Store, kind: type[T], *path: str) -> T:
    """Return the settings that a memory was begun with, of the class that lies at `path`; defaults in an old memory.

    What is derived from all sessions goes by those of the first. Raises `MemoryFileError`.
    """
    sessions = store.sessions.all()
    plain: object = sessions[0].settings if sessions else {}
    for name in path:
        plain = plain.get(name, {}) if isinstance(plain, Mapping) else plain
    try:
        return from_plain(kind, plain)
    except (ValueError, TypeError) as error:
        raise MemoryFileError(f"the settings in {store.path} cannot be read: {error}") from error
