"""Pictures and depth that are no files of their own: members of a zip, parts of a file, coded depth."""

from __future__ import annotations

import ctypes
import errno
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import FrameError, OptionError, install_hint
from list3r.memory.core.unpacking import open_archive

MOST_BYTES = 256 * 2**20
"""Largest member that is unpacked; a depth image of 30 megapixels is half of it."""


@dataclass(frozen=True)
class ZipMember:
    """A member of a zip archive; it has what is used of a `Path`."""

    archive: Path
    member: str

    @property
    def name(self) -> str:
        """The last part of the member's name."""
        return self.member.rsplit("/", 1)[-1]

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot."""
        return Path(self.name).suffix

    @property
    def size(self) -> int:
        """Unpacked bytes; -1 where there is no such member."""
        try:
            return _archive(self.archive).getinfo(self.member).file_size
        except KeyError:
            return -1

    def is_file(self) -> bool:
        """Return whether the archive has the member."""
        return self.size >= 0

    def read_bytes(self) -> bytes:
        """Raises `OSError` for a member that is missing, larger than `MOST_BYTES` or damaged."""
        if self.size < 0:
            raise OSError(errno.ENOENT, "it is missing")
        if self.size > MOST_BYTES:
            raise OSError(errno.EFBIG, f"it unpacks to {self.size} bytes")
        try:
            return _archive(self.archive).read(self.member)
        except (zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError, EOFError) as error:
            raise OSError(errno.EIO, f"the archive is damaged: {error}") from None


@lru_cache(maxsize=4)
def _archive(path: Path) -> zipfile.ZipFile:
    """Return the archive, its list read once in a process."""
    return open_archive(path)


@dataclass(frozen=True)
class FileSlice:
    """Some bytes of a file; it has what is used of a `Path`."""

    path: Path
    start: int
    size: int
    name: str

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot."""
        return Path(self.name).suffix

    def is_file(self) -> bool:
        """Return whether the file reaches as far."""
        return self.path.is_file() and self.path.stat().st_size >= self.start + self.size

    def read_bytes(self) -> bytes:
        """Raises `OSError` where the file ends before."""
        with self.path.open("rb") as file:
            file.seek(self.start)
            data = file.read(min(self.size, MOST_BYTES))
        if len(data) < self.size:
            raise OSError(errno.EIO, "the file ends before it")
        return data


Stored = Path | ZipMember | FileSlice


@dataclass(frozen=True)
class CodedArray:
    """Depth or confidence as bare numbers, compressed."""

    data: Stored
    codec: Literal["zlib", "deflate", "lz4", "lzfse"]
    dtype: str
    """Little-endian, as NumPy writes it: "<u2", "<f4", "|u1"."""
    shape: tuple[int, int]

    @property
    def name(self) -> str:
        """The name of what is stored."""
        return self.data.name

    def is_file(self) -> bool:
        """Return whether it is there."""
        return self.data.is_file()

    def decode(self) -> NDArray[Any]:
        """Return the numbers. Shape `shape`. Raises `FrameError`; `OptionError` without the extra."""
        try:
            data = self.data.read_bytes()
        except OSError as error:
            raise FrameError(f"{self.name} cannot be read ({error.strerror})") from None
        count = self.shape[0] * self.shape[1] * np.dtype(self.dtype).itemsize
        if len(data) > 2 * count + 1024:
            raise FrameError(
                f"{self.name} has {len(data)} bytes, more than {self.shape[1]}x{self.shape[0]} numbers take"
            )
        raw = _unpacked(data, count, self.codec)
        if raw is None or len(raw) != count:
            had = "damaged" if raw is None else f"{len(raw)} bytes"
            raise FrameError(f"{self.name} is {had}; {self.shape[1]}x{self.shape[0]} numbers are {count} bytes")
        return np.frombuffer(raw, self.dtype).reshape(self.shape)


def _unpacked(data: bytes, count: int, codec: str) -> bytes | None:
    """What is packed, hardly more than what is expected; None where it is damaged."""
    if codec == "lzfse":
        return _lzfse(data, count)
    return _lz4(data, count) if codec == "lz4" else _inflated(data, count, -zlib.MAX_WBITS * (codec == "deflate"))


def _lz4(data: bytes, count: int) -> bytes | None:
    try:
        from lz4.block import LZ4BlockError, decompress
    except ImportError:
        raise OptionError(
            f"depth of ScanNet++ is packed with LZ4, which needs a package: {install_hint('scannetpp')}"
        ) from None
    try:
        return bytes(decompress(data, uncompressed_size=count))
    except LZ4BlockError:
        return None


def _inflated(data: bytes, count: int, bits: int = 0) -> bytes | None:
    """At most one byte more than what is expected, so that a bomb does no harm; None where it is damaged."""
    try:
        return zlib.decompressobj(bits or zlib.MAX_WBITS).decompress(data, count + 1)
    except zlib.error:
        return None


def _lzfse(data: bytes, count: int) -> bytes | None:
    """At most one byte more than what is expected; None where it is damaged.

    What the package offers to Python unpacks all there is, so the function in its library is called that fills a
    buffer. Where the library hides it, the blocks are counted: each begins with 40,000 bytes that are new or 10,000
    that repeat, and unpacks to 24 MB at most, whatever it claims.
    """
    lzfse = import_lzfse()
    fill = _filling(str(lzfse.__file__))
    if fill is not None:
        out = ctypes.create_string_buffer(count + 1)
        written = int(fill(out, count + 1, data, len(data), None))
        return out.raw[:written] if written else None
    if sum(data.count(magic) for magic in (b"bvx1", b"bvx2", b"bvxn", b"bvx-")) > 4 + count // 40_000:
        return None
    try:
        return bytes(lzfse.decompress(data))
    except (lzfse.error, MemoryError):
        return None


def import_lzfse() -> Any:
    """Return the package that packs depth of Record3D. Raises `OptionError` without the extra."""
    try:
        import lzfse
    except ImportError:
        raise OptionError(
            f"depth of Record3D is packed with LZFSE, which needs a package: {install_hint('record3d')}"
        ) from None
    return lzfse


@lru_cache(maxsize=1)
def _filling(library: str) -> Callable[..., int] | None:
    """Return `lzfse_decode_buffer(out, size, data, size, scratch)` of a library; 0 is damage."""
    try:
        fill: Any = ctypes.CDLL(library).lzfse_decode_buffer
    except (OSError, AttributeError):
        return None
    fill.argtypes = (ctypes.c_char_p, ctypes.c_size_t, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_void_p)
    fill.restype = ctypes.c_size_t
    return cast(Callable[..., int], fill)


def stored_size(stored: Stored | CodedArray) -> int:
    """Bytes of what is stored, -1 where it is missing."""
    if isinstance(stored, CodedArray):
        return stored_size(stored.data)
    if not isinstance(stored, Path):
        return stored.size
    try:
        return stored.stat().st_size
    except OSError:
        return -1
