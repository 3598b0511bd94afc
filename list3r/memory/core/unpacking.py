"""Packed data of unknown origin, within bounds: JSON of a sane size, zip archives whose members do not explode."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

MOST_JSON_BYTES = 320 * 2**20
"""Of the values of one JSON text once they are read: ten million numbers."""
_BYTES_OF = {",": 32, "[": 88, "{": 200, ":": 80, '"': 15}
"""What the values take that a sign begins or ends: numbers, lists, tables, entries of tables and texts."""
MOST_LISTING_BYTES = 2**24
"""Of the list of an archive's members; 60,000 frames of a phone take as much."""
_STEADY = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Ways of packing that unpack by at most a thousand and as slowly as they are read; bzip2 takes a million."""


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text. Raises `ValueError` for one that is none, or whose values take much memory."""
    signs = _BYTES_OF.items()
    takes = sum(b * (text.count(c) if isinstance(text, str) else text.count(c.encode())) for c, b in signs)
    if takes > MOST_JSON_BYTES:
        raise ValueError(f"its values take about {takes >> 20} MiB; at most {MOST_JSON_BYTES >> 20} are read")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def open_archive(file: Path | BinaryIO) -> zipfile.ZipFile:
    """Return a zip archive. Raises `zipfile.BadZipFile` for none, a list too long, and members that unpack in leaps."""
    if isinstance(file, Path):
        with file.open("rb") as stream:
            _check_listing(stream)
    else:
        _check_listing(file)
    archive = zipfile.ZipFile(file)
    strange = next((m for m in archive.infolist() if m.compress_type not in _STEADY), None)
    if strange is not None:
        archive.close()
        raise zipfile.BadZipFile(f"{strange.filename} is not packed with deflate; pack it again")
    return archive


def _check_listing(stream: BinaryIO) -> None:
    """Raise `zipfile.BadZipFile` for a list of members that takes much memory to be read."""
    end = zipfile._EndRecData(stream)  # type: ignore[attr-defined]
    if end and end[zipfile._ECD_SIZE] > MOST_LISTING_BYTES:  # type: ignore[attr-defined]
        raise zipfile.BadZipFile(f"its list of members takes over {MOST_LISTING_BYTES >> 20} MiB")
    stream.seek(0)
