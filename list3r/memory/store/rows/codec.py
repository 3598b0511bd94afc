"""Arrays to bytes and back. Nothing here can execute what it reads, and a lying header cannot take all memory."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.unpacking import parse_json

MAX_BLOB_BYTES = 256 * 2**20
"""No array of one row is larger than this; a blob that claims more is damaged or hostile."""

_LEVEL = 4
"""Of compression: a third of the time of the usual 6, files 3 % larger."""


def checksum(*blobs: bytes) -> int:
    """CRC-32 over blobs in order."""
    value = 0
    for blob in blobs:
        value = zlib.crc32(blob, value)
    return value


def pack(arrays: Mapping[str, ArrayLike]) -> bytes:
    """Named arrays of numbers and booleans, compressed: a line of JSON with names, types and shapes, then the arrays
    one after the other. The same arrays give the same bytes.
    """
    held = {k: np.asarray(v) for k, v in arrays.items()}
    assert all(v.dtype.kind in "biuf" for v in held.values())
    line = json.dumps([(k, v.dtype.newbyteorder("<").str, v.shape) for k, v in held.items()], separators=(",", ":"))
    parts = (v.astype(v.dtype.newbyteorder("<"), copy=False).tobytes() for v in held.values())
    return zlib.compress(b"".join((line.encode(), b"\n", *parts)), _LEVEL)


def unpack(blob: bytes, where: str) -> dict[str, NDArray[Any]]:
    """Named arrays of `pack`. `where` names the row in the `MemoryFileError` raised for damaged bytes.

    Only numbers and booleans are read, and an array takes no more memory than the bytes that are really there.
    """
    try:
        stream = zlib.decompressobj()
        data = stream.decompress(blob, MAX_BLOB_BYTES)
        if not stream.eof:
            raise ValueError(f"cut off, or more than {MAX_BLOB_BYTES >> 20} MiB")
        out, at = {}, data.index(b"\n") + 1
        for name, kind, shape in parse_json(data[:at]):
            dtype, count = np.dtype(kind), math.prod(shape)
            if dtype.kind not in "biuf" or dtype.fields is not None or any(n < 0 for n in shape):
                raise ValueError(f"an array of {dtype}")
            out[name] = np.frombuffer(bytearray(data[at : at + count * dtype.itemsize]), dtype).reshape(shape)
            at += count * dtype.itemsize
        if at != len(data):
            raise ValueError(f"{len(data)} bytes instead of {at}")
        return out
    except (ValueError, TypeError, SyntaxError, OverflowError, zlib.error) as error:
        raise MemoryFileError(f"{where} cannot be read ({error}); run `list3r verify` on the file") from error


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
