"""The `.npz` layout in which a model that runs elsewhere provides its geometry (docs/precomputed.md).

A folder holds `precomputed.json` and `.npz` files, each of some frames in one gauge. Only numbers and booleans are
read, nothing is unpickled, and a header that claims more than its bytes is refused.
"""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from list3r.frames.files import check_ordinary, read_file
from list3r.memory.core.errors import OptionError, first_line
from list3r.memory.core.unpacking import open_archive, parse_json

MANIFEST = "precomputed.json"
FORMAT = "list3r-precomputed"
VERSION = 1
_FREE_BYTES, _MOST_RATIO = 64 * 2**20, 200
"""Limits of an archive: its size, and the ratio to its packed size; depth and points shrink to a tenth at best."""
MAX_BYTES = 8 * 2**30
"""No file unpacks to more: 1,000 frames of 1,000 x 1,000 pixels."""
_MAX_MANIFEST = 2**20
_NEEDED = {"frames": "iu", "T_world_cam": "f", "intrinsics": "f", "depth": "f", "confidence": "f"}
_OPTIONAL = {"masks": "iu", "features": "f", "depth_noise": "f"}


@dataclass(frozen=True)
class Manifest:
    """Facts of all files of a folder."""

    scale: str = "relative"
    """metric or relative."""
    model: str = ""
    """Who made it, for people."""
    length: int | None = None
    """Frames of a file, where it holds chunks."""
    overlap: int | None = None
    """Frames that neighbouring files share."""

    def as_json(self) -> dict[str, object]:
        """Return the contents of `precomputed.json`."""
        chunks = {} if self.length is None else {"chunk_length": self.length, "chunk_overlap": self.overlap}
        return {"format": FORMAT, "version": VERSION, "scale": self.scale, "model": self.model, **chunks}


@dataclass(frozen=True)
class Piece:
    """The contents of one file: F frames, in one gauge."""

    frames: NDArray[np.int64]
    """Numbers of the frames in their source, ascending. Shape (F,)."""
    T_world_cam: NDArray[np.float64]
    """Poses, OpenCV axes, in the file's own frame; NaN where there is none. Shape (F, 4, 4)."""
    intrinsics: NDArray[np.float64]
    """(fx, fy, cx, cy) px of the depth images; pixel (0, 0) is the centre of the upper left one. Shape (F, 4)."""
    depth: NDArray[np.float32]
    """Along each camera's z, 0 where unknown. Shape (F, h, w)."""
    confidence: NDArray[np.float32]
    """In [0, 1]. Shape (F, h, w)."""
    masks: NDArray[np.int32] | None = None
    """Instance at each pixel, 0 for none; the same number is the same instance throughout the file. Shape (F, h, w)."""
    features: NDArray[np.float32] | None = None
    """Feature of instance n in row n - 1. Shape (N, D)."""
    depth_noise: NDArray[np.float64] | None = None
    """`base`, `quadratic` and `half_share` of a `DepthNoise`, in the file's units. Shape (3,)."""


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a folder. Raises `OptionError` for a folder that has none, or an invalid one."""
    path = folder / MANIFEST
    if not path.is_file():
        raise OptionError(f"{folder} has no {MANIFEST}; see docs/precomputed.md, or write it with `list3r precompute`")
    if path.stat().st_size > _MAX_MANIFEST:
        raise OptionError(f"{path} is {path.stat().st_size} bytes long and not a manifest")
    try:
        said = parse_json(read_file(path, _MAX_MANIFEST))
    except (ValueError, RecursionError) as error:
        raise OptionError(f"{path} is not valid JSON ({first_line(error)}); see docs/precomputed.md") from None
    if not isinstance(said, dict) or said.get("format") != FORMAT or said.get("version") != VERSION:
        raise OptionError(f'{path} must say "format": "{FORMAT}", "version": {VERSION}')
    if said.get("scale") not in ("metric", "relative"):
        raise OptionError(f'{path}: "scale" must be metric or relative, not {said.get("scale")!r}')
    length, overlap = said.get("chunk_length"), said.get("chunk_overlap")
    for name, value in (("chunk_length", length), ("chunk_overlap", overlap)):
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
            raise OptionError(f'{path}: "{name}" must be a whole number of at least 1')
    return Manifest(said["scale"], str(said.get("model", "")), length, overlap)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `precomputed.json`."""
    (folder / MANIFEST).write_text(json.dumps(manifest.as_json(), indent=2) + "\n", encoding="utf-8")


def write_piece(path: Path, piece: Piece) -> None:
    """Write one file: depth and confidence in half precision, compressed."""
    arrays: dict[str, Any] = {
        "frames": piece.frames.astype("<i8"),
        "T_world_cam": piece.T_world_cam.astype("<f8"),
        "intrinsics": piece.intrinsics.astype("<f8"),
        "depth": piece.depth.astype("<f2"),
        "confidence": piece.confidence.astype("<f2"),
    }
    if piece.masks is not None:
        arrays["masks"] = piece.masks.astype("<i4")
    if piece.features is not None:
        arrays["features"] = piece.features.astype("<f4")
    if piece.depth_noise is not None:
        arrays["depth_noise"] = piece.depth_noise.astype("<f8")
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_frames(path: Path) -> NDArray[np.int64]:
    """Return the frame numbers of a file, without its large arrays. Raises `OptionError`."""
    return _checked_frames(read_arrays(path, ("frames",))["frames"], path)


def read_piece(path: Path) -> Piece:
    """Return one file. Raises `OptionError` that names the invalid array."""
    found = read_arrays(path, (*_NEEDED, *_OPTIONAL))
    missing = sorted(_NEEDED.keys() - found.keys())
    if missing:
        raise OptionError(f"{path} has no array {', '.join(missing)}; see docs/precomputed.md")
    for name, kinds in (_NEEDED | _OPTIONAL).items():
        if name in found and found[name].dtype.kind not in kinds:
            raise OptionError(f"{path}: {name} must be {'whole' if 'i' in kinds else 'real'} numbers")
    frames = _checked_frames(found["frames"], path)
    count, depth = len(frames), found["depth"]
    if depth.ndim != 3 or len(depth) != count or min(depth.shape[1:]) < 2:
        raise OptionError(f"{path}: depth has shape {depth.shape}; ({count}, h, w) is needed")
    wanted = {"T_world_cam": (count, 4, 4), "intrinsics": (count, 4), "confidence": depth.shape, "masks": depth.shape}
    for name, shape in wanted.items():
        if name in found and found[name].shape != shape:
            raise OptionError(f"{path}: {name} has shape {found[name].shape}; {shape} is needed")
    if "features" in found and found["features"].ndim != 2:
        raise OptionError(f"{path}: features has shape {found['features'].shape}; (N, D) is needed")
    masks, features, noise = (found.get(name) for name in _OPTIONAL)
    if noise is not None and (noise.shape != (3,) or not np.isfinite(noise).all() or noise.min() < 0):
        raise OptionError(f"{path}: depth_noise must be three finite numbers that are not negative")
    return Piece(
        frames,
        found["T_world_cam"].astype(np.float64),
        found["intrinsics"].astype(np.float64),
        depth.astype(np.float32),
        found["confidence"].astype(np.float32),
        None if masks is None else masks.astype(np.int32),
        None if features is None else features.astype(np.float32),
        None if noise is None else noise.astype(np.float64),
    )


def _checked_frames(frames: NDArray[Any], path: Path) -> NDArray[np.int64]:
    if frames.ndim != 1 or not len(frames) or frames.dtype.kind not in "iu":
        raise OptionError(f"{path}: frames must be a list of whole numbers, of shape (F,)")
    if (np.diff(frames.astype(np.int64)) <= 0).any() or frames[0] < 0:
        raise OptionError(f"{path}: frames must ascend, from 0 on, each once")
    return frames.astype(np.int64)


def read_arrays(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Return the named arrays of an archive. Raises `OptionError` when it is damaged, or its header is wrong."""
    try:
        check_ordinary(path.stat(), path, MAX_BYTES)
        with open_archive(path) as archive:
            entries = {e.filename.removesuffix(".npy"): e for e in archive.infolist()}
            claimed = sum(e.file_size for e in entries.values())
            if claimed > min(MAX_BYTES, _FREE_BYTES + _MOST_RATIO * path.stat().st_size):
                raise OptionError(f"{path} claims {claimed >> 20} MiB; it is damaged or hostile")
            return {name: _array(archive, entries[name]) for name in names if name in entries}
    except OptionError:
        raise
    except Exception as error:  # what zipfile, zlib and NumPy raise on damaged bytes is not a closed list
        reason = first_line(error)
        raise OptionError(f"{path} cannot be read: {reason}") from None


def check_archives(folder: Path) -> None:
    """Raise `OptionError` where a file of a folder claims too much, before processes are started that would read it."""
    for path in sorted(folder.glob("*.npz")):
        read_arrays(path, ())


def read_array(path: Path) -> NDArray[Any]:
    """Return the array of an .npy file. Raises `OptionError` when it is damaged, or holds anything but numbers."""
    try:
        check_ordinary(path.stat(), path, MAX_BYTES)
        return np.asarray(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError) as error:
        reason = first_line(error)
        raise OptionError(f"{path} cannot be read: {reason}") from None


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, its size checked against its header before any of it is unpacked."""
    with archive.open(entry) as stream:
        readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        version = npy.read_magic(stream)
        if version not in readers:
            raise ValueError(f"{entry.filename} is an array in format {version}")
        shape, fortran, dtype = readers[version](stream)
        if dtype.kind not in "biuf" or dtype.fields is not None or any(n < 0 for n in shape):
            raise ValueError(f"{entry.filename} holds {dtype}; only numbers are read")
        wanted = math.prod(shape) * dtype.itemsize
        if wanted > entry.file_size:
            raise ValueError(f"{entry.filename} claims shape {shape} and has {entry.file_size} bytes")
        data = stream.read(wanted + 1)
    if len(data) != wanted:
        raise ValueError(f"{entry.filename} has {len(data)} bytes for shape {shape}")
    flat: NDArray[Any] = np.frombuffer(bytearray(data), dtype)
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
