"""Settings as plain JSON and back, and those that a memory was made with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from functools import lru_cache
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from list3r.memory.errors import List3rError, MemoryFileError

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
    if not isinstance(plain, Mapping):
        raise ValueError(f"{kind.__name__} from {plain!r}")
    types = _types(kind)  # type: ignore[arg-type]
    try:
        return kind(**{name: _typed(types[name], plain[name]) for name in types if name in plain})
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


@lru_cache(maxsize=256)
def _types(kind: type[Any]) -> dict[str, Any]:
    """Return the types of the fields of a dataclass that can be given."""
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind) if f.init}


def _typed(kind: Any, value: object) -> object:
    """Return a value of JSON as what a field declares."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        if value is None and NoneType in inner:
            return None
        (kind,) = (k for k in inner if k is not NoneType)
        return _typed(kind, value)
    if is_dataclass(kind) and isinstance(kind, type):
        return from_plain(kind, value)
    if origin is tuple:
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise ValueError(f"{value!r} is no list")
        each = inner[:1] * len(value) if inner[1:] == (...,) else inner
        return tuple(_typed(k, v) for k, v in zip(each, value, strict=True))
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{value!r} is no {kind.__name__}")
    return value
