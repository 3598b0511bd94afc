"""Record3D over USB: colour, LiDAR depth, confidence and ARKit poses of an iPhone as they are recorded.

The app listens on a port of the phone and sends one message a frame: four big-endian numbers, of which the last is the
length of what follows; eleven little-endian ones (sizes of the images, bytes of their files, the camera used); fx fy
cx cy; qx qy qz qw tx ty tz; then JPEG, depth and confidence (both packed with LZFSE). Of Record3D 1.10 or newer.
"""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from list3r.frames.live.camera import LivePicture, LostError
from list3r.frames.live.feed import Tell
from list3r.frames.live.usbmux import connect, receive
from list3r.frames.readers.phones.record3d import METADATA, MOST_DEPTH_PIXELS
from list3r.frames.recordings.stored import import_lzfse
from list3r.memory.core.errors import SourceError

PORT = 1337
_VARIES = 0.01
"""Focal lengths that differ by a larger share are reported."""
_OUTER = struct.Struct(">4I")
_HEADER = struct.Struct("<11I")
_FLOATS = struct.Struct("<11f")
_MOST_BYTES = 1 << 26
_FRONT_CAMERA = 0


@dataclass(frozen=True)
class _Sizes:
    """Width and height of the images of a frame."""

    color: tuple[int, int]
    depth: tuple[int, int]
    confidence: tuple[int, int]


@dataclass(frozen=True)
class _PhoneFrame:
    """One message."""

    sizes: _Sizes
    intrinsics: tuple[float, ...]
    pose: tuple[float, ...]
    """qx qy qz qw tx ty tz of the camera in its world, ARKit's axes, y up, metres."""
    files: dict[str, bytes]
    """JPEG, depth and confidence by their ending."""


class Record3dPhone:
    """A `LiveCamera` that is an iPhone with LiDAR."""

    name = "Record3D over USB"

    def __init__(self, serial: str, tell: Tell) -> None:
        """The phone of a serial number, or the only one. Raises `OptionError` without the extra."""
        import_lzfse()
        self._serial, self._tell = serial, tell
        self._first: _PhoneFrame | None = None
        self._noted = set[str]()

    def pictures(self, folder: Path, silence_s: float) -> Iterator[LivePicture]:
        """The frames of one connection; the camera is written to `folder` with the first of all.

        A phone that is connected again begins a world of its own, so poses are those of the first connection. Raises
        `LostError`, and `SourceError` for what is no recording of a room.
        """
        again = self._first is not None
        with connect(self._serial, PORT, silence_s) as phone:
            while True:
                frame = _parsed(_message(phone))
                first = self._first = self._first or _begun(folder, frame)
                if frame.sizes != first.sizes:
                    self._note_once(f"pictures that are not {first.sizes.color[0]}x{first.sizes.color[1]} are left out")
                    continue
                if again:
                    self._note_once("poses after a lost connection are in another frame of reference and are left out")
                if abs(frame.intrinsics[0] / first.intrinsics[0] - 1) > _VARIES:
                    self._note_once("the focal length changes by more than 1 %: one camera serves all pictures")
                pose = () if again else frame.pose
                yield LivePicture(frame.files.copy, " ".join(f"{v:.9g}" for v in pose))

    def _note_once(self, line: str) -> None:
        """Tell something, once."""
        if line not in self._noted:
            self._noted.add(line)
            self._tell(line)


def _begun(folder: Path, frame: _PhoneFrame) -> _PhoneFrame:
    """Write down the camera of the first frame, as Record3D's own recordings state theirs."""
    (width, height), depth = frame.sizes.color, frame.sizes.depth
    fx, fy, cx, cy = frame.intrinsics
    metadata = {"w": width, "h": height, "dw": depth[0], "dh": depth[1], "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}
    metadata["confidence"] = ".conf" in frame.files
    (folder / METADATA).write_text(json.dumps(metadata), encoding="ascii")
    return frame


def _message(phone: socket.socket) -> bytearray:
    """Return the next message that has a body. Raises `LostError`."""
    length = 0
    while length == 0:
        length = _OUTER.unpack(receive(phone, _OUTER.size))[3]
    if length > _MOST_BYTES:
        raise LostError(f"the data received is not a frame of Record3D: {length} bytes")
    return receive(phone, length)


def _parsed(body: bytearray) -> _PhoneFrame:
    """Return what a message says. Raises `LostError` where it is no frame, `SourceError` for the front camera."""
    start = _HEADER.size + _FLOATS.size
    if len(body) < start:
        raise LostError("the data received is not a frame of Record3D 1.10 or newer")
    *sizes, jpeg, depth, confidence, misc, kind = _HEADER.unpack_from(body)
    numbers = _FLOATS.unpack_from(body, _HEADER.size)
    pixels = [sizes[k] * sizes[k + 1] for k in (0, 2, 4)]
    fits = start + jpeg + depth + confidence + misc == len(body) and jpeg > 0
    fits = fits and pixels[0] > 0 and 0 < pixels[1] <= MOST_DEPTH_PIXELS and pixels[2] <= MOST_DEPTH_PIXELS
    if not (fits and np.isfinite(numbers[:4]).all() and min(numbers[:2]) > 0):
        raise LostError("the data received is not a frame of Record3D 1.10 or newer")
    if kind == _FRONT_CAMERA:
        raise SourceError("the phone streams its front camera, which has no poses: choose LiDAR in Record3D")
    files, at = {}, start
    for ending, size in ((".jpg", jpeg), (".depth", depth), (".conf", confidence)):
        files[ending] = bytes(body[at : at + size])
        at += size
    named = {ending: data for ending, data in files.items() if data or ending != ".conf"}
    shown = _Sizes((sizes[0], sizes[1]), (sizes[2], sizes[3]), (sizes[4], sizes[5]))
    return _PhoneFrame(shown, numbers[:4], numbers[4:], named)
