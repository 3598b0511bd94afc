"""Pictures of a live stream as they were kept: `frames.txt` has a line for each, seconds and the name of its file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from list3r.frames.layout import FolderLayout, Optics, inside, read_lines
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions
from list3r.memory.errors import SourceError

LIST = "frames.txt"


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None for another folder. A last line that is half written does not count."""
    path = root / LIST
    if not path.is_file():
        return None
    return FolderLayout("live", FrameFiles(_files(root, path)), Optics(options.intrinsics))


def _files(root: Path, path: Path) -> Iterator[FrameFile]:
    for number, line in enumerate(read_lines(path, whole=True), start=1):
        words = line.split()
        try:
            yield FrameFile(inside(root, words[1], path), time_s=float(words[0]))
        except (IndexError, ValueError):
            raise SourceError(f"{path}: line {number} is not seconds and a name; mend or remove it") from None
