"""Object memory for long videos: a library of 3D instances in one file that can be asked, updated and exported.

    >>> import list3r
    >>> memory = list3r.build("walk/", "house.l3r")          # or list3r.open("house.l3r")
    >>> for match in memory.nearest((0.0, 0.0, 1.0), k=3):
    ...     print(match.instance.id, match.instance.name, match.distance_m)
    >>> memory.relations(subject=12, predicate="on")

Nothing heavy is imported before it is needed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from list3r.api import SceneMemory, build, open, update
    from list3r.frames.options import SourceOptions
    from list3r.memory.core.errors import List3rError
    from list3r.pipeline.request import BuildRequest
    from list3r.pipeline.settings import BuildSettings

__version__ = "0.2.0"
__all__ = [
    "BuildRequest",
    "BuildSettings",
    "List3rError",
    "SceneMemory",
    "SourceOptions",
    "__version__",
    "build",
    "open",
    "update",
]

_HOMES = {
    "BuildRequest": "list3r.pipeline.request",
    "BuildSettings": "list3r.pipeline.settings",
    "SourceOptions": "list3r.frames.options",
    "List3rError": "list3r.memory.core.errors",
    "SceneMemory": "list3r.api",
    "build": "list3r.api",
    "open": "list3r.api",
    "update": "list3r.api",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'list3r' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
