"""One image file to one array, or a `FrameError` that says what is wrong with it."""

from __future__ import annotations

import io
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import MAX_PIXELS, jpeg_segments, read_file, too_many_pixels
from list3r.frames.recordings.exr import read_exr
from list3r.frames.recordings.stored import CodedArray, Stored
from list3r.memory.core.errors import FrameError


def read_color(path: Stored, bits: int = 16, *, upright: bool = True) -> NDArray[np.uint8]:
    """Return an RGB image, turned as its EXIF tag says if `upright`. Shape (H, W, 3). Raises `FrameError`.

    Of a picture with 16 bits a channel the lower `bits` are in use, see `used_bits`.
    """
    turned = 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | turned)
    if image.dtype == np.uint16:
        image = np.minimum(image >> (bits - 8), 255).astype(np.uint8)
    elif image.dtype != np.uint8:
        image = _decode(path, cv2.IMREAD_COLOR | turned)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def used_bits(paths: Sequence[Stored]) -> int:
    """Return how many of their 16 bits pictures of one camera use: 10, 12, 14 or 16; 16 for pictures of 8 bits.

    Cameras of 10 to 14 bits write them into 16, and are nearly black where all 16 are looked at.
    """
    brightest = 0
    for path in paths:
        try:
            image = _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
        except FrameError:
            continue
        if image.dtype != np.uint16:
            return 16
        brightest = max(brightest, int(image.max(initial=0)))
    return next(bits for bits in (10, 12, 14, 16) if brightest < 2**bits) if brightest else 16


def read_gray(path: Stored, reduction: int) -> NDArray[np.uint8]:
    """Return a grey image, each side reduced by 1, 2, 4 or 8: a JPEG takes less to decode then. Raises `FrameError`."""
    flags = {
        1: cv2.IMREAD_GRAYSCALE,
        2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
        4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
        8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
    }
    return np.asarray(_decode(path, flags[reduction]), np.uint8)


def read_raw_depth(path: Stored | CodedArray) -> NDArray[Any]:
    """Depth or its confidence as stored, any number type. Shape (H, W). Raises `FrameError`."""
    if isinstance(path, CodedArray):
        return path.decode()
    if path.suffix.lower() == ".npy":
        raw = _load_npy(path)
    elif path.suffix.lower() == ".exr":
        raw = read_exr(_read(path), path.name)
    else:
        raw = _decode(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    if raw.ndim != 2:
        raise FrameError(
            f"{path.name} has {raw.shape[2]} channels, a picture of depth for people; export depth as 16 bits of one "
            "channel"
            if raw.ndim == 3
            else f"{path.name} has the shape {raw.shape}; depth has (height, width)"
        )
    return raw


def sure_depth(raw: NDArray[Any], confidence: NDArray[Any], least: int) -> NDArray[Any]:
    """Return depth as stored, 0 where ARKit was less sure than `least` (0, 1, 2; some apps store 0, 127, 255)."""
    if confidence.shape != raw.shape:
        confidence = cv2.resize(confidence, raw.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    levels = confidence if confidence.max(initial=0) <= 2 else np.rint(confidence / 127.5)
    return np.where(levels >= least, raw, np.zeros((), raw.dtype))


def clean_depth(raw: NDArray[Any], scale: float, max_depth_m: float | None) -> NDArray[np.float32]:
    """Depth in metres, 0 where unknown.

    Unknown is 0, the largest value of an unsigned integer type, NaN, infinite, negative, and beyond `max_depth_m`.
    `raw` has shape (H, W), in `scale` units per metre.
    """
    depth: NDArray[np.float32] = np.multiply(raw, np.float32(1.0 / scale), dtype=np.float32, casting="unsafe")
    far = np.inf if max_depth_m is None else max_depth_m
    if raw.dtype.kind == "u" and raw.dtype.itemsize <= 2:
        far = min(far, float(np.iinfo(raw.dtype).max - 0.5) / scale)
        depth[depth > far] = 0.0
        return depth
    with np.errstate(invalid="ignore"):
        depth[~((depth > 0.0) & (depth <= far) & (depth < np.inf))] = 0.0
    return depth


def _decode(path: Stored, flags: int) -> NDArray[Any]:
    """Decode a file with OpenCV, and refuse one whose end is missing, which OpenCV would fill with grey."""
    data = _read(path)
    if fault := _fault(data):
        raise FrameError(f"{path.name} is {fault}")
    image = decode_picture(data, flags, path.name)
    if image is None:
        raise FrameError(f"{path.name} cannot be decoded")
    return image


def _read(path: Stored) -> bytes:
    """What a file holds. Raises `FrameError` for one that is missing, empty or cannot be read."""
    try:
        data = _bytes(path)
    except FileNotFoundError:
        raise FrameError(f"{path.name} is missing") from None
    except OSError as error:
        raise FrameError(f"{path.name} cannot be read ({error.strerror})") from None
    if not data:
        raise FrameError(f"{path.name} is empty")
    return data


def fault_of(path: Stored | CodedArray) -> str | None:
    """Return what is wrong with a file without decoding it: missing, empty, damaged or cut off; None for nothing."""
    try:
        data = _bytes(path.data if isinstance(path, CodedArray) else path)
    except OSError as error:
        return f"{path.name} cannot be read ({error.strerror})"
    fault = _fault(data) if data else "empty"
    return f"{path.name} is {fault}" if fault else None


def decode_picture(data: bytes, flags: int = cv2.IMREAD_COLOR, name: str = "the picture") -> NDArray[Any] | None:
    """Return what OpenCV makes of a picture, None where it is damaged. Raises `FrameError` for too large a one."""
    size = too_many_pixels(data)
    if size is not None:
        raise FrameError(f"{name} claims {size[0]}x{size[1]} pixels; at most {MAX_PIXELS >> 20} megapixels are read")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        image = None
    return None if image is None else np.asarray(image)


def decode_rgb(data: bytes) -> NDArray[np.uint8] | None:
    """Return a picture as RGB (H, W, 3), None where it is damaged or none is there. Raises `FrameError`."""
    image = decode_picture(data)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def _fault(data: bytes) -> str:
    """Return whether a JPEG or PNG is cut off or a PNG damaged, by its own sums; empty where it is not.

    Phones put a film or maps of brightness behind a JPEG. OpenCV says of a damaged PNG what it does line by line.
    """
    if data.startswith(b"\x89PNG"):
        return _png_fault(data)
    if not data.startswith(b"\xff\xd8"):
        return ""
    *_, (_, start) = jpeg_segments(data)  # what lies before the scan may hold a whole small picture
    return "" if data.find(b"\xff\xd9", start) >= 0 else "cut off"


def _png_fault(data: bytes) -> str:
    """Return what is wrong with the parts of a PNG: length, name, content and CRC-32 each (PNG, section 5.3)."""
    at = 8
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return "damaged"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = end
    return "cut off"


def _bytes(stored: Stored) -> bytes:
    return read_file(stored) if isinstance(stored, Path) else stored.read_bytes()


def _load_npy(path: Stored) -> NDArray[Any]:
    try:
        array = np.load(io.BytesIO(_bytes(path)), allow_pickle=False)
    except FileNotFoundError:
        raise FrameError(f"{path.name} is missing") from None
    except (OSError, ValueError, EOFError, MemoryError) as error:
        raise FrameError(f"{path.name} cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if not isinstance(array, np.ndarray):
        raise FrameError(f"{path.name} is an archive; depth is one array of shape (height, width)")
    if array.dtype.kind not in "uif":
        raise FrameError(f"{path.name} holds {array.dtype}, not depth")
    return np.asarray(array)
