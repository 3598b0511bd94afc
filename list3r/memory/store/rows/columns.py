"""Columns of a table from the fields of its record: one field is one column of its name and type.

Numbers, texts and blobs are what they are in SQLite; a similarity, a box or an array whose shape is noted
(`core.records.Shape`) is a blob of little-endian numbers, a record of arrays a compressed blob, and all else JSON.
What older schemas cut otherwise is said by a `Column`: several fields in one column, or one field in several.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from itertools import accumulate
from operator import attrgetter
from typing import Any, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import OrientedBox, Sim3
from list3r.memory.core.records import Shape
from list3r.memory.core.unpacking import parse_json
from list3r.memory.store.rows.codec import pack, pack_sim3, raw_array, to_json, unpack, unpack_sim3
from list3r.memory.store.rows.json_values import array_scalar, plain, typed

R = TypeVar("R")
Value = str | int | float | bytes | None
"""What SQLite holds."""
UNREADABLE = (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError, MemoryFileError)
Encode = Callable[[Any], Value]
Decode = Callable[[Any], Any]


@dataclass(frozen=True, eq=False)
class Column:
    """Columns of a table that hold fields of a record; both ways take many rows at once, which is much faster."""

    names: tuple[str, ...]
    fields: tuple[str, ...]
    write: Callable[..., Sequence[Sequence[Value]]]
    """From one sequence for each field to one for each column."""
    read: Callable[..., Sequence[Sequence[Any]]]
    """The way back. Raises one of `UNREADABLE` for what is none."""
    same: frozenset[type] = frozenset()
    """Types of SQLite's that are values of the field as they are."""


class Columns(Generic[R]):
    """The columns that a record is kept in."""

    def __init__(self, record: type[R], *special: Column, omit: Iterable[str] = (), **renamed: str) -> None:
        """`renamed` are names of columns by field, `omit` fields that have their default when read."""
        hints = _hints(record)  # type: ignore[arg-type]
        omitted = set(omit)
        self._record = record
        known = tuple(f.name for f in fields(record))  # type: ignore[arg-type]
        of_field = {name: column for column in special for name in column.fields}
        columns: list[Column] = []
        for name in (f for f in known if f not in omitted):
            column = of_field.get(name) or plain_column(renamed.get(name, name), name, hints[name])
            if column not in columns:
                columns.append(column)
        self._columns = tuple(columns)
        self.names = tuple(n for column in columns for n in column.names)
        """Names of the columns, in the order of the fields."""
        stops = list(accumulate(len(column.names) for column in columns))
        self._spans = [(c, stop - len(c.names), stop) for c, stop in zip(columns, stops, strict=True)]
        held = tuple(n for column in columns for n in column.fields)
        self._by_name = None if held == known[: len(held)] else held

    @staticmethod
    def of(record: type[R], *special: Column, **renamed: str) -> Columns[R]:
        """Return the columns of a record, made once in a process: opening a memory asks for those of every table."""
        return _columns(record, special, tuple(renamed.items()))  # type: ignore[arg-type]

    def rows(self, records: Sequence[R]) -> list[tuple[Value, ...]]:
        """Return what the columns hold of records, in the order of `names`."""
        held: list[Sequence[Value]] = []
        for column in self._columns:
            held += column.write(*(list(map(attrgetter(f), records)) for f in column.fields))
        return list(zip(*held, strict=True))

    def some(self, **values: Any) -> dict[str, Value]:
        """Return what the columns hold of some fields, each of which is one column, by name."""
        found = {c.fields[0]: c for c in self._columns if len(c.names) == len(c.fields) == 1}
        return {found[f].names[0]: found[f].write([x])[0][0] for f, x in values.items()}

    def records(self, rows: Sequence[Sequence[Any]], where: str, key: Sequence[str] = ()) -> list[R]:
        """Return the records of rows, their columns in the order of `names`.

        Raises `MemoryFileError` that names the first row that cannot be read, by its table and the columns of its key.
        """
        if not rows:
            return []
        try:
            return self._read(rows)
        except UNREADABLE as error:
            self._name_unreadable(rows, where, key)
            raise MemoryFileError(f"{where} cannot be read ({error}); run `list3r verify` on the file") from error

    def _name_unreadable(self, rows: Sequence[Sequence[Any]], where: str, key: Sequence[str]) -> None:
        for row in rows:
            values = dict(zip(self.names, row, strict=True))
            for column in self._columns:
                try:
                    column.read(*([values[name]] for name in column.names))
                except UNREADABLE as error:
                    name = " ".join((where, ":".join(str(values[k]) for k in key)))
                    what = f"{name}: {', '.join(column.names)} cannot be read ({error})"
                    raise MemoryFileError(f"{what}; run `list3r verify` on the file") from error

    def _read(self, rows: Sequence[Sequence[Any]]) -> list[R]:
        held = list(zip(*rows, strict=True))
        values: list[Sequence[Any]] = []
        for column, start, stop in self._spans:
            if column.same.issuperset(map(type, held[start])):
                values.append(held[start])
            else:
                values += column.read(*held[start:stop])
        if self._by_name is None:
            return list(map(self._record, *values))
        names = self._by_name
        return [self._record(**dict(zip(names, row, strict=True))) for row in zip(*values, strict=True)]

    def column(self, field: str) -> Column:
        """Return the column of a field."""
        return next(c for c in self._columns if field in c.fields)


@cache
def _columns(record: type[Any], special: tuple[Column, ...], renamed: tuple[tuple[str, str], ...]) -> Columns[Any]:
    return Columns(record, *special, **dict(renamed))


@cache
def _hints(record: type[Any]) -> dict[str, Any]:
    """Return the types of the fields of a record; reading them takes longer than opening a small memory."""
    return get_type_hints(record, include_extras=True)


@cache
def plain_column(name: str, field: str, hint: Any) -> Column:
    """Return the column of one field by its type."""
    encode, decode = _kind(hint)
    kinds = set(get_args(hint)) if get_origin(hint) in (Union, types.UnionType) else {hint}
    same = frozenset(kinds if kinds <= {int, float, str, bytes, type(None)} else ())

    def write(values: Sequence[Any]) -> list[Sequence[Value]]:
        return [values if same.issuperset(map(type, values)) else list(map(encode, values))]

    return Column((name,), (field,), write, lambda values: [list(map(decode, values))], same)


def joined(
    names: tuple[str, ...],
    fields: tuple[str, ...],
    encode: Callable[..., Sequence[Value]],
    decode: Callable[..., Sequence[Any]],
) -> Column:
    """Return the columns of fields that are not one column each, by what takes values of one row to the others."""
    return Column(
        names,
        fields,
        lambda *values: list(zip(*map(encode, *values), strict=True)),
        lambda *values: list(zip(*map(decode, *values), strict=True)),
    )


@cache
def nested(field: str, columns: Columns[Any]) -> Column:
    """Return the columns of a field that is a record itself."""
    return Column(
        columns.names,
        (field,),
        lambda values: list(zip(*columns.rows(values), strict=True)),
        lambda *held: [columns.records(list(zip(*held, strict=True)), field)],
    )


def _kind(hint: Any) -> tuple[Encode, Decode]:
    """How a value of that type becomes one of SQLite, and back."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType) and type(None) in inner:
        encode, decode = _kind(next(h for h in inner if h is not type(None)))
        return (lambda v: None if v is None else encode(v)), (lambda v: None if v is None else decode(v))
    if hint in _KINDS:
        return _KINDS[hint]
    shape = next((n.sizes for n in getattr(hint, "__metadata__", ()) if isinstance(n, Shape)), None)
    if shape is not None:
        return _numbers(array_scalar(inner[0]), shape)
    if is_dataclass(hint) and all(array_scalar(h) is not None for h in get_type_hints(hint).values()):
        return arrays(hint)  # type: ignore[arg-type]
    return (lambda v: to_json(plain(v))), (lambda v: typed(hint, parse_json(v)))


def _exactly(kind: Any) -> Decode:
    def decode(value: Any) -> Any:
        if not isinstance(value, kind):
            raise ValueError(f"{type(value).__name__} instead of {getattr(kind, '__name__', 'a number')}")
        return value

    return decode


def _numbers(scalar: Any, shape: tuple[int, ...]) -> tuple[Encode, Decode]:
    """A blob of numbers of a known shape, of which one length may be open (-1)."""
    little = np.dtype(scalar).newbyteorder("<")

    def decode(blob: Any) -> Any:
        flat = np.frombuffer(_exactly(bytes)(blob), little)
        return flat.reshape(shape).astype(little.newbyteorder("="))

    return (lambda v: np.ascontiguousarray(v, dtype=little).tobytes()), decode


def arrays(record: type[Any], **missing: Callable[[dict[str, NDArray[Any]]], Any]) -> tuple[Encode, Decode]:
    """A record of arrays as one compressed blob; `missing` make what older ones do not hold."""
    types_of = {n: array_scalar(h) for n, h in get_type_hints(record).items()}

    def encode(value: Any) -> bytes:
        return pack({n: np.asarray(getattr(value, n)).astype(t, copy=False) for n, t in types_of.items()})

    def decode(blob: Any) -> Any:
        held = unpack(blob, "the arrays")
        return record(**{n: make(held) for n, make in missing.items() if n not in held}, **held)

    return encode, decode


def _pack_box(box: OrientedBox) -> bytes:
    return np.concatenate([box.center, box.size, box.rotation.ravel()]).astype("<f8").tobytes()


def _unpack_box(blob: Any) -> OrientedBox:
    values = raw_array(blob, "<f8", (15,), "the box").copy()
    return OrientedBox(values[:3], values[3:6], values[6:].reshape(3, 3))


_KINDS: dict[Any, tuple[Encode, Decode]] = {
    int: (int, _exactly(int)),
    float: (float, _exactly((int, float))),
    str: (lambda v: v, _exactly(str)),
    bytes: (lambda v: v, _exactly(bytes)),
    bool: (int, lambda v: bool(_exactly(int)(v))),
    Sim3: (pack_sim3, unpack_sim3),
    OrientedBox: (_pack_box, _unpack_box),
}
