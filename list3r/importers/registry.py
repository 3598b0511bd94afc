"""All maps of others that can be read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from list3r.importers import colmap_masks, conceptgraphs, hovsg, hydra, labelled_cloud
from list3r.importers.base import ImportedMap
from list3r.memory.core.errors import SourceError, check_choice

FORMATS: dict[str, tuple[Callable[[Path], bool], Callable[[Path], ImportedMap]]] = {
    "conceptgraphs": (conceptgraphs.matches, conceptgraphs.read),
    "hovsg": (hovsg.matches, hovsg.read),
    "hydra": (hydra.matches, hydra.read),
    "colmap": (colmap_masks.matches, colmap_masks.read),
    "ply": (labelled_cloud.matches, labelled_cloud.read),
}
"""By name: whether a path is such a map, and its reader; tried in order."""


def read_map(path: Path, name: str = "auto") -> ImportedMap:
    """Return the map at a path. Raises `SourceError` for none, `OptionError` for a format that is not known."""
    check_choice("--format", name, ("auto", *FORMATS))
    if not path.exists():
        raise SourceError(f"{path} does not exist; name a map of {', '.join(FORMATS)}")
    for kind, (matches, read) in FORMATS.items():
        if name == kind or (name == "auto" and matches(path)):
            found = read(path)
            if not found.objects:
                raise SourceError(f"{path} holds no objects ({'; '.join(found.notes) or kind})")
            return found
    raise SourceError(f"{path} is not a map of {', '.join(FORMATS)}; predictions of networks go through `precomputed`")
