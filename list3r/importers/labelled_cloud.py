"""Point clouds with a number of the object at each point, such as nerfstudio's exports with masks: a PLY file.

The number is a property named `instance`, `instance_id`, `object_id`, `objectId`, `segment` or `id`; 0 or less is
nothing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from list3r.importers.base import ImportedMap, ImportedObject
from list3r.importers.ply import points_of, read_vertices
from list3r.memory.core.errors import SourceError

_NAMES = ("instance", "instance_id", "object_id", "objectid", "segment", "id")


def matches(path: Path) -> bool:
    """Return whether a path is a PLY file."""
    return path.suffix.lower() == ".ply" and path.is_file()


def read(path: Path) -> ImportedMap:
    """Return the objects of the cloud. Raises `SourceError` for a cloud that names none."""
    rows = read_vertices(path)
    points, rgb = points_of(path, rows)
    key = next((k for k in rows if k.lower() in _NAMES), None)
    if key is None:
        raise SourceError(
            f"{path} does not say which object a point belongs to (a property {', '.join(_NAMES)}); a cloud without "
            "objects is for `list3r eval cloud`"
        )
    numbers = rows[key].astype(np.int64)
    good = np.isfinite(points).all(axis=1)
    objects = []
    for number in np.unique(numbers[good & (numbers > 0)]).tolist():
        mine = good & (numbers == number)
        objects.append(ImportedObject(str(number), None, points[mine], None if rgb is None else rgb[mine]))
    return ImportedMap("ply", tuple(objects))
