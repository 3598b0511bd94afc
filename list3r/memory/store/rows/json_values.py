"""Values of records as JSON and back, led by their type hints: dataclasses, tuples, sets, arrays, similarities."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from list3r.memory.geometry import Sim3


def plain(value: object) -> object:
    """Return a value as JSON holds it: a record as its fields, a set in order, a similarity as its matrix."""
    if is_dataclass(value) and not isinstance(value, type):
        if isinstance(value, Sim3):
            return value.as_matrix().tolist()
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, set | frozenset):
        return sorted(plain(v) for v in value)  # type: ignore[type-var]
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def typed(hint: Any, value: object) -> Any:
    """Return what `plain` made of a value of that type. Raises `ValueError` for anything else."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint in (Any, object):
        return value
    if origin in (Union, types.UnionType):
        return None if value is None else typed(next(h for h in inner if h is not type(None)), value)
    return _plain(hint, value) if origin is None else _generic(origin, inner, value)


def _plain(hint: Any, value: object) -> Any:
    if hint is Sim3:
        return Sim3.from_matrix(np.array(value, np.float64).reshape(4, 4))
    if is_dataclass(hint):
        return _record(hint, _checked(dict, value))
    return _checked((int, float) if hint is float else hint, value)


def _generic(origin: Any, inner: tuple[Any, ...], value: object) -> Any:
    if origin is np.ndarray:
        return np.array(value, get_args(inner[1])[0])
    if origin in (dict, Mapping):
        return {_key(inner[0], k): typed(inner[1], v) for k, v in _checked(dict, value).items()}
    if origin is tuple:
        return _tuple(inner, _checked(list, value))
    return origin(typed(inner[0], v) for v in _checked(list, value))


def _tuple(inner: tuple[Any, ...], values: list[Any]) -> tuple[Any, ...]:
    if len(inner) == 2 and inner[1] is ...:
        return tuple(typed(inner[0], v) for v in values)
    if len(values) != len(inner):
        raise ValueError(f"{len(values)} values instead of {len(inner)}")
    return tuple(typed(h, v) for h, v in zip(inner, values, strict=True))


def _record(record: Any, values: dict[str, Any]) -> Any:
    hints = _hints(record)
    unknown = values.keys() - hints.keys()
    if unknown:
        raise ValueError(f"{sorted(unknown)[0]!r} is not known")
    return record(**{name: typed(hints[name], v) for name, v in values.items()})


@cache
def _hints(record: Any) -> dict[str, Any]:
    hints = get_type_hints(record)
    return {f.name: hints[f.name] for f in fields(record)}


def _key(hint: Any, key: str) -> Any:
    return int(key) if hint is int else key


def _checked(kind: Any, value: object) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{type(value).__name__} instead of {getattr(kind, '__name__', 'a number')}")
    return value
