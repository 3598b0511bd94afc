"""A map that another program made: objects with surface points, in a world with z up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import read_file
from list3r.memory.core.errors import SourceError
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.unpacking import parse_json
from list3r.memory.store.facts import Fact
from list3r.memory.store.store import Store

MOST_BYTES = 2**30
"""Largest file that is read."""
_MOST_POINTS = 4000
_LEAST_POINTS = 1000
_SPACING_M = 0.02
GRAY = (160, 160, 160)
"""Colour of points that have none."""


IMPORTED = Fact[dict[str, Any] | None]("imported", dict, None)
"""Where an imported map comes from: `format`, `path`, `notes`, and `names`, the map's name of each local instance."""


def imported_as(store: Store, instance_id: int) -> dict[str, Any] | None:
    """Return `format` and `path` of the map that an instance was imported from, and the `names` that it has there.

    None for an instance that was built.
    """
    stored = store.facts[IMPORTED]
    if stored is None:
        return None
    first = min(chunk.chunk_id for chunk in store.chunks.all())  # the map itself; later ones are of videos
    names = [stored["names"][o.local_id] for o in store.observations.of(instance_id) if o.chunk_id == first]
    return {"format": stored["format"], "path": stored["path"], "names": names} if names else None


@dataclass(frozen=True)
class ImportedObject:
    """One object of the map."""

    name: str
    """Its id in the map."""
    label: str | None
    points: NDArray[np.float32]
    """World coordinates of the map. Shape (N, 3)."""
    rgb: NDArray[np.uint8] | None = None
    """Colour. Shape (N, 3)."""
    feature: NDArray[np.float32] | None = None
    """Embedding of its appearance. Shape (D,)."""


@dataclass(frozen=True)
class ImportedMap:
    """All that was read."""

    format: str
    objects: tuple[ImportedObject, ...]
    metric: bool = True
    notes: tuple[str, ...] = ()
    """Missing or omitted content, one sentence each."""


def read_json_file(path: Path) -> Any:
    """Return parsed JSON. Raises `SourceError`."""
    try:
        return parse_json(read_file(path, MOST_BYTES))
    except OSError as error:
        raise SourceError(f"{path} cannot be read ({error.strerror}); check the file") from None
    except ValueError as error:
        raise SourceError(f"{path} is not valid JSON ({error}); is the copy complete?") from None


def box_surface(box: OrientedBox) -> NDArray[np.float32]:
    """Return 1000 to 4000 points scattered over a box's surface, the same each time. Shape (N, 3)."""
    size = np.maximum(box.size, 1e-4)
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    count = int(np.clip(2 * areas.sum() / _SPACING_M**2, _LEAST_POINTS, _MOST_POINTS))
    rng = np.random.default_rng(0)  # points in rows would tie where rules compare heights
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), rng.choice(3, count, p=areas / areas.sum())] = rng.choice([-0.5, 0.5], count)
    return np.asarray(box.center + (points * size) @ box.rotation.T, np.float32)


def vector(value: object, where: str) -> NDArray[np.float64]:
    """Return three finite numbers. Shape (3,). Raises `SourceError`."""
    try:
        out = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        out = np.zeros(0)
    if out.shape != (3,) or not np.isfinite(out).all():
        raise SourceError(f"{where} is not three numbers; fix or remove it")
    return out
