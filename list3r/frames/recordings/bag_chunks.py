"""Chunks of ROS recordings unpacked within bounds: `rosbags` unpacks whatever comes out of one."""

from __future__ import annotations

import bz2
import os
from collections.abc import Callable
from functools import cache
from typing import Any, BinaryIO, Protocol, Self, cast

MOST_BYTES = 96 * 2**20
"""Of one chunk or message; recorders begin a new chunk after a megabyte, and a picture of 32 megapixels is as large."""
_MOST_RATIO = 100
"""How many times its own length a file unpacks to."""


class _Unpacker(Protocol):
    """What the packages of bzip2, LZ4 and Zstandard have in common."""

    eof: bool

    def decompress(self, data: bytes, max_length: int = -1) -> bytes:
        """Return at most this many bytes."""


def bounded(unpacker: Callable[[], _Unpacker]) -> Callable[..., bytes]:
    """Return what unpacks a whole chunk. It raises `ValueError` for one that is cut off or too large."""

    def unpack(data: bytes, *_: object) -> bytes:
        state = unpacker()
        try:
            out = state.decompress(data, MOST_BYTES)
        except (OSError, RuntimeError) as error:
            raise ValueError(f"a chunk is damaged: {error}") from None
        if not state.eof:
            raise ValueError(f"a chunk is cut off, or unpacks to more than {MOST_BYTES >> 20} MiB")
        return bytes(out)

    return unpack


@cache
def bound_rosbags() -> None:
    """Have `rosbags` unpack within bounds, in this process; the bytes stay the same."""
    from rosbags.rosbag1 import reader as first
    from rosbags.rosbag2 import reader as second
    from rosbags.rosbag2 import storage_mcap

    lz4 = getattr(first, "lz4_decompress", None)
    zstd: Any = getattr(storage_mcap, "zstd", None)
    known = {"bz2": bounded(cast(Any, bz2.BZ2Decompressor))}
    if lz4 is not None:
        from lz4.frame import LZ4FrameDecompressor

        known["lz4"] = bounded(LZ4FrameDecompressor)
    if zstd is not None:
        known["zstd"] = bounded(zstd.ZstdDecompressor)
        second.zstd = _Zstd(zstd, known["zstd"])  # type: ignore[assignment, attr-defined]
    storage_mcap.read_exact = _read_exact  # type: ignore[assignment]
    for table in (first.decompressors, storage_mcap.DECOMPRESSORS):
        table.update({name: unpack for name, unpack in known.items() if name in table})


def _read_exact(file: BinaryIO, size: int) -> bytes:
    """Return this many bytes. Raises `ValueError` for more than any record has, before it asks for them."""
    data = file.read(size) if size <= MOST_BYTES else b""
    if len(data) != size:
        raise ValueError(f"a record states {size} bytes, and {len(data)} are there")
    return data


class _Zstd:
    """The module of Zstandard, but that what it unpacks is bounded."""

    def __init__(self, module: Any, decompress: Callable[..., bytes]) -> None:
        self._module, self.decompress = module, decompress

    def open(self, file: BinaryIO, mode: str) -> _Limited:
        """Return a packed file that is read."""
        most = MOST_BYTES + _MOST_RATIO * os.fstat(file.fileno()).st_size
        return _Limited(self._module.open(file, mode), most)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _Limited:
    """A file that is read up to a length."""

    def __init__(self, file: Any, most_bytes: int) -> None:
        self._file, self._left = file, most_bytes

    def read(self, size: int) -> bytes:
        """Return at most `size` bytes. Raises `ValueError` beyond the length."""
        data = bytes(self._file.read(size))
        self._left -= len(data)
        if self._left < 0:
            raise ValueError(f"it unpacks to over {_MOST_RATIO} times its length")
        return data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
