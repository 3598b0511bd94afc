"""The files of every frame of a source, packed: what takes more than a few MiB lies in a file without a name."""

from __future__ import annotations

import json
import threading
import zlib
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.recordings.stored import CodedArray, FileSlice, Stored, ZipMember

DEPTH, POSE_FILE, POSE = 1, 2, 4
"""What a frame has, as bits of `FrameFiles.holds`."""
_BLOCK = 256
"""Frames that are packed and unpacked together."""
_HELD_BYTES = 4 * 2**20
"""Packed blocks that are held in memory before they go to a temporary file."""


@dataclass(frozen=True, slots=True)
class FrameFile:
    """The files of one frame."""

    color: Stored
    depth: Stored | CodedArray | None = None
    pose: Path | None = None
    """A text file with a 4x4 pose."""
    T_source_camera: NDArray[np.float64] | None = None
    """A pose that was read with the listing, of the camera that `FolderLayout.poses_of` names. Shape (4, 4)."""
    time_s: float | None = None
    """Seconds of the source's clock, if it has one."""
    confidence: Stored | CodedArray | None = None
    """How sure the sensor is of each depth pixel, as whole numbers, see `FolderLayout.least_confidence`."""
    mask: Stored | None = None
    """Where it is 0 the picture shows nothing that counts: depth is unknown there."""
    lens: Camera | None = None
    """The picture's own camera, where pictures differ; what it saw is carried to the camera of the source."""


class FrameFiles(Sequence[FrameFile]):
    """Frames in order. Memory does not grow with them but for nine bytes each."""

    def __init__(self, files: Iterable[FrameFile] = ()) -> None:
        self._packed = SpooledTemporaryFile(max_size=_HELD_BYTES)
        self._ends = array("q", [0])
        self._lock = threading.Lock()
        self._open: tuple[int, list[_Row]] = (-1, [])
        times_s, holds, left = array("d"), bytearray(), iter(files)
        while block := list(islice(left, _BLOCK)):
            times_s.extend(np.nan if f.time_s is None else f.time_s for f in block)
            holds += bytes(_held(f) for f in block)
            self._ends.append(self._ends[-1] + self._packed.write(zlib.compress(_pack(block), 1)))
        self.times_s: NDArray[np.float64] = np.frombuffer(times_s, np.float64)
        """Seconds of the source's clock, NaN where a frame has none. Shape (F,)."""
        self.holds: NDArray[np.uint8] = np.frombuffer(holds, np.uint8)
        """What each frame has: `DEPTH`, `POSE_FILE`, `POSE`. Shape (F,)."""

    def __len__(self) -> int:
        return len(self.holds)

    @overload
    def __getitem__(self, at: int) -> FrameFile: ...
    @overload
    def __getitem__(self, at: slice) -> list[FrameFile]: ...
    def __getitem__(self, at: int | slice) -> FrameFile | list[FrameFile]:
        if isinstance(at, slice):
            return [self[k] for k in range(len(self))[at]]
        number, place = divmod(range(len(self))[at], _BLOCK)
        return _file(*self._block(number)[place])

    def __iter__(self) -> Iterator[FrameFile]:
        for number in range(len(self._ends) - 1):
            for row in self._block(number):
                yield _file(*row)

    def that_hold(self, what: int) -> NDArray[np.int64]:
        """Return the numbers of the frames that have any of `what`, ascending. Shape (K,)."""
        return np.flatnonzero(self.holds & np.uint8(what))

    def _block(self, number: int) -> list[_Row]:
        with self._lock:
            if self._open[0] != number:
                self._packed.seek(self._ends[number])
                packed = self._packed.read(self._ends[number + 1] - self._ends[number])
                times_s = self.times_s[number * _BLOCK : (number + 1) * _BLOCK]
                self._open = number, _unpack(zlib.decompress(packed), times_s)
            return self._open[1]


def _held(file: FrameFile) -> int:
    return (
        DEPTH * (file.depth is not None)
        | POSE_FILE * (file.pose is not None)
        | POSE * (file.T_source_camera is not None)
    )


def _pack(files: Sequence[FrameFile]) -> bytes:
    """Return a line of JSON, then the poses."""
    rows = [
        [
            *(_plain(part) for part in (f.color, f.depth, f.pose, f.confidence, f.mask)),
            None if f.lens is None else asdict(f.lens),
            f.T_source_camera is not None,
        ]
        for f in files
    ]
    poses = [np.asarray(f.T_source_camera, np.float64).tobytes() for f in files if f.T_source_camera is not None]
    return json.dumps(rows).encode() + b"\n" + b"".join(poses)


_Row = tuple[list[Any], NDArray[np.float64] | None, float]
"""The plain parts of a frame, its pose, and its time, NaN for none."""


def _unpack(packed: bytes, times_s: NDArray[np.float64]) -> list[_Row]:
    rows, _, numbers = packed.partition(b"\n")
    poses = iter(np.frombuffer(numbers, np.float64).reshape(-1, 4, 4))
    return [
        (row, next(poses) if row[-1] else None, t) for row, t in zip(json.loads(rows), times_s.tolist(), strict=True)
    ]


def _file(row: list[Any], T: NDArray[np.float64] | None, time_s: float) -> FrameFile:
    *parts, lens, _ = row
    color, depth, pose, confidence, mask = map(_stored, parts)
    camera = None if lens is None else Camera(**{**lens, "distortion": tuple(lens["distortion"])})
    return FrameFile(color, depth, pose, T, None if np.isnan(time_s) else time_s, confidence, mask, camera)


def _plain(part: Stored | CodedArray | None) -> Any:
    match part:
        case None:
            return None
        case ZipMember(archive, member):
            return [str(archive), member]
        case FileSlice(path, start, size, name):
            return [str(path), start, size, name]
        case CodedArray(data, codec, dtype, shape):
            return [_plain(data), codec, dtype, shape, True]
    return str(part)


def _stored(plain: Any) -> Any:
    match plain:
        case [archive, member]:
            return ZipMember(Path(archive), member)
        case [path, start, size, name]:
            return FileSlice(Path(path), start, size, name)
        case [data, codec, dtype, shape, True]:
            return CodedArray(_stored(data), codec, dtype, tuple(shape))
    return None if plain is None else Path(plain)
