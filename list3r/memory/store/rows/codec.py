"""Arrays to bytes and back. Nothing here can execute what it reads, and a lying header cannot take all memory."""

from __future__ import annotations

import io
import json
import math
import zlib
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.unpacking import open_archive
from list3r.memory.store.rows.npz import read_members, write_npz

MAX_BLOB_BYTES = 256 * 2**20
"""No array of one row is larger than this; a blob that claims more is damaged or hostile."""

MAX_ARRAYS = 256
"""No row keeps more arrays under names of their own than this."""


def checksum(*blobs: bytes) -> int:
    """CRC-32 over blobs in order."""
    value = 0
    for blob in blobs:
        value = zlib.crc32(blob, value)
    return value


def pack(arrays: Mapping[str, ArrayLike]) -> bytes:
    """Named arrays as a compressed `.npz`; the same arrays give the same bytes."""
    return write_npz({k: np.asarray(v) for k, v in arrays.items()})


def unpack(blob: bytes, where: str) -> dict[str, NDArray[Any]]:
    """Named arrays of `pack`. `where` names the row in the `MemoryFileError` raised for damaged bytes.

    Only numbers and booleans are read, and an array takes no more memory than the bytes that are really there.
    """
    try:
        members = read_members(blob, MAX_BLOB_BYTES, MAX_ARRAYS)
        if members is not None:
            return {name.removesuffix(".npy"): _read_npy(data) for name, data in members.items()}
        with open_archive(io.BytesIO(blob)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > MAX_BLOB_BYTES or len(entries) > MAX_ARRAYS:
                raise MemoryFileError(f"{where} claims more than {MAX_BLOB_BYTES >> 20} MiB; the file is damaged")
            return {e.filename.removesuffix(".npy"): _read_npy(archive.read(e)) for e in entries}
    except MemoryFileError:
        raise
    except Exception as error:  # what zipfile and NumPy raise on damaged bytes is not a closed list
        raise MemoryFileError(f"{where} cannot be read ({error}); run `list3r verify` on the file") from error


def _read_npy(data: bytes) -> NDArray[Any]:
    """An array in NumPy's format 1 or 2. Raises `ValueError` when it is not one, or its header does not fit."""
    major = int(data[6]) if len(data) > 10 and data[:6] == b"\x93NUMPY" else 0
    start = {1: 10 + int.from_bytes(data[8:10], "little"), 2: 12 + int.from_bytes(data[8:12], "little")}.get(major, 0)
    shape, fortran, dtype = _npy_header(data[:start])
    if dtype.kind not in "biuf" or dtype.fields is not None or any(n < 0 for n in shape):
        raise ValueError(f"an array of {dtype}")
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError(f"{len(data) - start} bytes for an array of shape {shape}")
    flat: NDArray[Any] = np.frombuffer(bytearray(data[start:]), dtype=dtype)
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)


@lru_cache(maxsize=512)
def _npy_header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type; most arrays of a memory have one of a few headers."""
    buffer = io.BytesIO(header)
    version = np.lib.format.read_magic(buffer)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an array in format {version}")
    return readers[version](buffer)


def pack_sim3(transform: Sim3) -> bytes:
    """Scale, rotation row by row, translation: 13 little-endian doubles, exact."""
    parts = [np.ravel(transform.scale), np.ravel(transform.rotation), np.ravel(transform.translation)]
    return np.concatenate(parts).astype("<f8").tobytes()


def unpack_sim3(blob: bytes) -> Sim3:
    """The inverse of `pack_sim3`."""
    values = raw_array(blob, "<f8", (13,), "transform")
    return Sim3(values[0].reshape(()), values[1:10].reshape(3, 3).copy(), values[10:].copy())


def raw_array(blob: bytes, dtype: str, shape: tuple[int, ...], where: str) -> NDArray[Any]:
    """A raw little-endian blob as an array. Raises `MemoryFileError` when its length does not fit dtype and shape."""
    expected = math.prod(shape) * np.dtype(dtype).itemsize
    if len(blob) != expected:
        raise MemoryFileError(f"{where} holds {len(blob)} bytes instead of {expected}; run `list3r verify` on the file")
    return np.frombuffer(blob, dtype=dtype).reshape(shape)


def quantise(points: NDArray[np.float32]) -> tuple[bytes, bytes]:
    """Points as 16-bit steps over their own extent: (origin and step as 4 doubles, steps). Shape (N, 3)."""
    p = points.astype(np.float64)
    low = p.min(axis=0) if len(p) else np.zeros(3)
    step = float((p - low).max() / 65535.0) if len(p) else 0.0
    steps = np.round((p - low) / step) if step > 0 else np.zeros_like(p)
    return np.append(low, step).astype("<f8").tobytes(), steps.astype("<u2").tobytes()


def dequantise(grid: bytes, steps: bytes, count: int, where: str) -> NDArray[np.float32]:
    """The inverse of `quantise`, exact to half a step (extent / 131,070). Shape (N, 3)."""
    frame = raw_array(grid, "<f8", (4,), where)
    values = raw_array(steps, "<u2", (count, 3), where)
    return np.asarray(frame[:3] + values * frame[3], dtype=np.float32)


def to_json(value: object) -> str:
    """Compact JSON with sorted keys."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))
