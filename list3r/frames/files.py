"""Files of unknown origin: only ordinary ones of a sane size are read, and pictures that fit in memory."""

from __future__ import annotations

import errno
import os
import stat
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

MAX_FILE_BYTES = 512 * 2**20
"""Of one picture or array; a frame of 134 megapixels with 16 bits a pixel has 256 MiB."""
MAX_TEXT_BYTES = 64 * 2**20
"""Of one list, calibration or set of options; a list of a million frames has about 60 MiB."""
MAX_PIXELS = 2**27
"""Of one picture: 134 megapixels."""


MAX_LIST_BYTES = 512 * 2**20
"""Of one list that is read line by line; poses of ten hours at 100 a second have about 280 MiB."""


def read_file(path: Path, most_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return what an ordinary file holds. Raises `OSError` for a device, a pipe, and for one that is too large."""
    with open_ordinary(path, most_bytes) as file:
        return file.read(os.fstat(file.fileno()).st_size + 1)


def open_ordinary(path: Path, most_bytes: int = MAX_FILE_BYTES) -> BinaryIO:
    """Open an ordinary file. Raises `OSError` for a device, a pipe, and for one that is too large.

    A pipe that nobody writes would keep whoever opens it waiting, and a device need never end.
    """
    file = open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")  # noqa: PTH123 - it closes it
    try:
        check_ordinary(os.fstat(file.fileno()), path, most_bytes)
    except OSError:
        file.close()
        raise
    return file


def check_ordinary(found: os.stat_result, path: Path, most_bytes: int = MAX_FILE_BYTES) -> None:
    """Raise `OSError` for what is not a regular file, and for one that is too large."""
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "it is a device or pipe, not a regular file", str(path))
    if found.st_size > most_bytes:
        text = f"it has {found.st_size >> 20} MiB; at most {most_bytes >> 20} are read"
        raise OSError(errno.EFBIG, text, str(path))


def too_many_pixels(data: bytes) -> tuple[int, int] | None:
    """Return the width and height that a picture claims where they are more than `MAX_PIXELS`, else None."""
    size = _claimed_size(data)
    return size if size is not None and size[0] * size[1] > MAX_PIXELS else None


def _claimed_size(data: bytes) -> tuple[int, int] | None:
    """Width and height by the head of a PNG, JPEG or other picture; None where it says nothing that is understood."""
    if data.startswith(b"\x89PNG") and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(data)
    return _size_of_others(data)


_FRAME_HEADERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return the largest frame that any header before the first scan claims (ITU-T T.81, B.2.2)."""
    places = [at for marker, at in jpeg_segments(data) if marker in _FRAME_HEADERS and at + 9 <= len(data)]
    sizes: list[tuple[int, int]] = [struct.unpack(">HH", data[at + 5 : at + 9])[::-1] for at in places]  # type: ignore[misc]
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield marker and place of the segments of a JPEG up to its first scan, or to where they break off (marker 0)."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        yield marker, at
        if marker == 0xDA:
            return
        alone = marker in (0x01, 0xFF) or 0xD0 <= marker <= 0xD8  # markers without a segment, and filling
        at += (1 if marker == 0xFF else 2) if alone else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    yield 0, at


def _size_of_others(data: bytes) -> tuple[int, int] | None:
    import io
    import warnings

    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            with Image.open(io.BytesIO(data)) as image:
                return image.size
        except Image.DecompressionBombError:
            return 2**16, 2**16
        except Exception:  # whatever the readers of thirty formats raise: no picture that they know
            return None
