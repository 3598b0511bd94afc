"""What the index of an MP4 or MOV file claims, looked at before FFmpeg makes room for all of it (ISO/IEC 14496-12)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from list3r.memory.core.errors import SourceError

MOST_ENTRIES = 8_000_000
"""Of the tables of all tracks together: three days of pictures at 30 a second. FFmpeg takes 40 bytes for each."""
_MOST_BOXES, _DEEPEST = 1_000_000, 12
_HOLDING = {b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"moof", b"traf"}
_COUNT_AT = {name: 4 for name in (b"stts", b"ctts", b"stsc", b"stco", b"co64", b"stss", b"elst", b"trun")}
_COUNT_AT |= {b"stsz": 8, b"stz2": 8}
"""Where a table says how many entries it has, from behind the name of its box."""


def check_index(path: Path) -> None:
    """Raise `SourceError` for a video whose index claims more entries than any has; other kinds of files pass."""
    with path.open("rb") as file:
        file.seek(4)
        if file.read(4) not in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"styp"):
            return
        entries = 0
        for number, claimed in enumerate(_claims(file, 0, path.stat().st_size, _DEEPEST)):
            entries += claimed
            if entries > MOST_ENTRIES or number > _MOST_BOXES:
                raise SourceError(
                    f"{path}: its index claims over {MOST_ENTRIES:,} entries; it is damaged, or too long: cut it"
                )


def _claims(file: BinaryIO, start: int, stop: int, depth: int) -> Iterator[int]:
    """Yield what each box between two places claims: how many entries, 0 where it is no table."""
    at = start
    while at + 8 <= stop:
        file.seek(at)
        head = file.read(28)
        size, name = struct.unpack(">I4s", head[:8].ljust(8, b"\0"))
        inner = at + 8
        if size == 1 and len(head) >= 16:
            size, inner = int.from_bytes(head[8:16], "big"), at + 16
        end = stop if size == 0 else min(at + size, stop)
        if end < inner:
            return
        yield _entries(name, head[inner - at :])
        if name in _HOLDING and depth:
            yield from _claims(file, inner, end, depth - 1)
        at = end


def _entries(name: bytes, body: bytes) -> int:
    at = _COUNT_AT.get(name)
    return 0 if at is None else int.from_bytes(body[at : at + 4], "big")
