"""A list of answers that becomes a table: a data frame, arrays, or HTML for a notebook."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MissingPackageError
from list3r.memory.core.records import Instance, Relation

if TYPE_CHECKING:
    import pandas

T = TypeVar("T")
_MOST_ROWS = 20
"""Rows of an answer that a notebook shows; each has a picture of a few kB."""


class Rows(list[T]):
    """A list of answers, of which each is a row of a table."""

    picture_of: Callable[[int], bytes | None] | None = None
    """Returns a small JPEG of an instance, None where no picture shows it; set by the memory that answers."""

    def __repr__(self) -> str:
        more = [f"... {len(self) - _MOST_ROWS} more"] if len(self) > _MOST_ROWS else []
        return "[" + ",\n ".join([*map(repr, self[:_MOST_ROWS]), *more]) + "]"

    def to_dataframe(self) -> pandas.DataFrame:
        """Return one row for each answer. Raises `MissingPackageError` without pandas.

        >>> memory.find("chair").to_dataframe()
        """
        return dataframe(row_of(answer) for answer in self)

    def _repr_html_(self) -> str:
        rows = []
        for answer in self[:_MOST_ROWS]:
            cells = {k: _cell(v) for k, v in row_of(answer).items()}
            instance = instance_of(answer)
            if instance is not None:
                jpeg = self.picture_of(instance.id) if self.picture_of else None
                code = base64.b64encode(jpeg).decode("ascii") if jpeg else ""
                cells = {"": f'<img src="data:image/jpeg;base64,{code}">' if code else "", **cells}
            rows.append(cells)
        if not rows:
            return "<p>nothing</p>"
        head = "".join(f"<th>{name}</th>" for name in rows[0])
        body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row.values()) + "</tr>" for row in rows)
        more = f"<p>{len(self) - _MOST_ROWS} more</p>" if len(self) > _MOST_ROWS else ""
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"


class Answers(Rows[T]):
    """A list of instances, or of what names an instance: matches, changes."""

    @property
    def boxes(self) -> NDArray[np.float64]:
        """Lower and upper corner of each, world. Shape (N, 2, 3).

        >>> memory.find("chair").boxes[0]
        """
        boxes = [i.aabb for i in map(instance_of, self) if i is not None]
        return np.array(boxes, np.float64).reshape(-1, 2, 3)


def instance_of(answer: object) -> Instance | None:
    """Return the instance that an answer is or names; None for a relation."""
    found = answer if isinstance(answer, Instance) else getattr(answer, "instance", None)
    return found if isinstance(found, Instance) else None


def row_of(answer: object) -> dict[str, Any]:
    """Return an answer as a flat row; lengths are world units."""
    if isinstance(answer, Relation):
        return {k: getattr(answer, k) for k in ("subject", "predicate", "object", "confidence", "margin")}
    i = instance_of(answer)
    assert i is not None, f"no row is known for {type(answer).__name__}"
    row: dict[str, Any] = {"id": i.id, "name": i.name}
    if (event := getattr(answer, "event", None)) is not None:
        row["change"] = event.kind
    row |= {k: getattr(answer, k) for k in ("score", "distance_m", "reason") if hasattr(answer, k)}
    row |= dict(zip("xyz", i.center.tolist(), strict=True))
    row |= dict(zip(("size_x", "size_y", "size_z"), i.box.size.tolist(), strict=True))
    return {**row, "confidence": float(i.confidence), "state": i.state}


def dataframe(rows: Iterable[dict[str, Any]]) -> pandas.DataFrame:
    """Return rows as a data frame. Raises `MissingPackageError` without pandas."""
    try:
        import pandas
    except ModuleNotFoundError:
        raise MissingPackageError("a data frame needs pandas, which is not installed: pip install pandas") from None
    return pandas.DataFrame(list(rows))


def _cell(value: object) -> str:
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else html.escape(str(value))
