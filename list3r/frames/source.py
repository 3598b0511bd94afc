"""Opens whatever is at a path: an explicit table of readers, tried in order."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from list3r.frames import seven_scenes
from list3r.frames.base import FrameSource
from list3r.frames.folder import FolderSource
from list3r.frames.layout import Layout
from list3r.frames.options import SourceOptions
from list3r.memory.errors import SourceError

FOLDERS: dict[str, Callable[[Path, SourceOptions], Layout | None]] = {
    "7scenes": seven_scenes.find,
}
"""Readers of folders, the most particular first: the layout of a folder, or None for one of another kind."""

_WANTED = (
    "a video file, or a folder in 7-Scenes (frame-000000.color.png), TUM RGB-D (rgb.txt) or Replica layout "
    "(results/frame000000.jpg), or of images"
)


def open_source(path: str | Path, options: SourceOptions | None = None) -> FrameSource:
    """The frames at `path`, which can be opened again in another process with the same arguments.

    Raises `SourceError` for what is not a source, `OptionError` for options that do not fit it.
    """
    options = options or SourceOptions()
    root = Path(path).expanduser()
    try:
        if not root.exists():
            raise SourceError(f"{root} does not exist; give {_WANTED}")
        if root.is_dir():
            return _open_folder(root, options)
    except PermissionError as error:
        raise SourceError(f"{error.filename or root} may not be read; check its permissions") from None
    raise SourceError(f"{root} is not a folder of frames; give {_WANTED}")


def _open_folder(root: Path, options: SourceOptions) -> FrameSource:
    if not os.access(root, os.R_OK | os.X_OK):
        raise SourceError(f"{root} may not be read; check its permissions")
    if not any(root.iterdir()):
        raise SourceError(f"{root} is empty; give {_WANTED}")
    for kind, find in FOLDERS.items():
        if options.kind in ("auto", kind):
            layout = find(root, options)
            if layout is not None and layout.files:
                return FolderSource(root, layout, options)
    said = "no layout that is known" if options.kind == "auto" else f"not the {options.kind} layout"
    raise SourceError(f"{root} has {said}; give {_WANTED}")
