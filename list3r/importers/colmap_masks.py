"""A COLMAP model whose pictures have masks of objects: every point belongs to the object of most of its pictures.

`sparse/0` is the model, `masks/` holds a PNG for each picture (its name with `.png`) with the number of the object in
each pixel, the same number in all pictures, 0 for nothing. The model has a unit of its own.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from list3r.frames.decoding.decode import read_raw_depth
from list3r.importers.base import ImportedMap, ImportedObject
from list3r.memory.core.errors import FrameError, SourceError, first_line

_LEAST_POINTS = 10


def matches(path: Path) -> bool:
    """Return whether a folder is a model with masks."""
    return _model(path) is not None and (path / "masks").is_dir()


def read(path: Path) -> ImportedMap:
    """Return the objects that masks make of the model's points. Raises `SourceError`."""
    from pycolmap import Reconstruction

    model = _model(path)
    try:
        found: Any = Reconstruction(str(model))
    except Exception as error:
        raise SourceError(f"{model} cannot be read as a model of COLMAP: {first_line(error)}") from None
    votes: dict[int, Counter[int]] = {}
    unmasked = 0
    for image in found.images.values():
        mask = next((m for m in _masks(path, image.name) if m.is_file()), None)
        if mask is None:
            unmasked += 1
            continue
        _vote(image, mask, votes)
    owners = {point: c.most_common(1)[0][0] for point, c in votes.items()}
    objects = []
    for number in sorted({n for n in owners.values() if n > 0}):
        mine = [found.points3D[k] for k, n in sorted(owners.items()) if n == number]
        if len(mine) >= _LEAST_POINTS:
            points = np.array([p.xyz for p in mine], np.float32)
            objects.append(ImportedObject(str(number), None, points, np.array([p.color for p in mine], np.uint8)))
    notes = ["the model has a unit of its own: list3r edit scale makes it metres"]
    if unmasked:
        notes.append(f"{unmasked} of {len(found.images)} pictures have no mask")
    return ImportedMap("colmap", tuple(objects), metric=False, notes=tuple(notes))


def _model(path: Path) -> Path | None:
    for model in (path / "sparse/0", path / "sparse", path):
        if any((model / f"points3D.{end}").is_file() for end in ("bin", "txt")):
            return model
    return None


def _masks(path: Path, name: str) -> tuple[Path, Path]:
    return path / "masks" / f"{name}.png", (path / "masks" / name).with_suffix(".png")


def _vote(image: Any, mask: Path, votes: dict[int, Counter[int]]) -> None:
    try:
        numbers = read_raw_depth(mask)
    except FrameError as error:
        raise SourceError(f"{mask}: {error}") from None
    for seen in image.points2D:
        if not seen.has_point3D():
            continue
        x, y = (int(v) for v in seen.xy)
        if 0 <= x < numbers.shape[1] and 0 <= y < numbers.shape[0]:
            votes.setdefault(int(seen.point3D_id), Counter())[int(numbers[y, x])] += 1
