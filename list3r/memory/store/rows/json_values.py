"""Values of records as JSON and back, led by their type hints: dataclasses, tuples, sets, arrays, similarities."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3


def array_scalar(hint: Any) -> Any:
    """Return the type of the numbers of an array type; None for any other type.

    `NDArray[np.float32]` is `ndarray[..., dtype[float32]]`, from NumPy 2.5 on an alias with one argument.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin is np.ndarray:
        return get_args(inner[1])[0]
    return inner[0] if inner and origin is NDArray else None


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


_NUMBERS = frozenset((int, float))


def typed(hint: Any, value: object, *, lenient: bool = False) -> Any:
    """Return what `plain` made of a value of that type; a field that is not there keeps its default.

    Raises `ValueError` for anything else. Where it is `lenient`, fields that a record does not know are left out.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if hint in (Any, object):
        return value
    if (scalar := array_scalar(hint)) is not None:
        return np.array(value, scalar)
    if origin in (Union, types.UnionType):
        one = next(h for h in inner if h is not type(None))
        return None if value is None and type(None) in inner else typed(one, value, lenient=lenient)
    return _plain(hint, value, lenient) if origin is None else _generic(origin, inner, value, lenient)


def _plain(hint: Any, value: object, lenient: bool) -> Any:
    if hint is Sim3:
        return Sim3.from_matrix(np.array(value, np.float64).reshape(4, 4))
    if is_dataclass(hint):
        return _record(hint, _checked(Mapping, value), lenient)
    return _checked((int, float) if hint is float else hint, value)


def _generic(origin: Any, inner: tuple[Any, ...], value: object, lenient: bool) -> Any:
    if origin in (dict, Mapping):
        if inner == (str, float) and isinstance(value, dict) and _NUMBERS.issuperset(map(type, value.values())):
            return value
        return {_key(inner[0], k): typed(inner[1], v, lenient=lenient) for k, v in _checked(dict, value).items()}
    values = _checked((list, tuple), value)
    if origin is not tuple:
        return origin(typed(inner[0], v, lenient=lenient) for v in values)
    each = inner[:1] * len(values) if inner[1:] == (...,) else inner
    if len(values) != len(each):
        raise ValueError(f"{len(values)} values instead of {len(each)}")
    return tuple(typed(h, v, lenient=lenient) for h, v in zip(each, values, strict=True))


def _record(record: Any, values: Mapping[str, Any], lenient: bool) -> Any:
    hints = _hints(record)
    unknown = values.keys() - hints.keys()
    if unknown and not lenient:
        raise ValueError(f"{sorted(unknown)[0]!r} is not known")
    return record(**{name: typed(hints[name], values[name], lenient=lenient) for name in hints if name in values})


@cache
def _hints(record: Any) -> dict[str, Any]:
    hints = get_type_hints(record)
    return {f.name: hints[f.name] for f in fields(record) if f.init}


def _key(hint: Any, key: str) -> Any:
    return int(key) if hint is int else key


def _checked(kind: Any, value: object) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        names = {(int, float): "number", (list, tuple): "list", str: "text", int: "whole number", bool: "flag"}
        raise ValueError(f"{repr(value)[:40]} is not a {names.get(kind, 'record')}")
    return value
