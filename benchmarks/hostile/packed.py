"""Small files that claim or unpack to much: pictures, video, archives. Needs nothing of the program."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib

from PIL import Image


def png(width: int, height: int, bits: int = 8, colors: int = 1) -> bytes:
    """Return a black PNG: a thousand times smaller than its pixels."""
    packer, row = zlib.compressobj(9), bytes(1 + width * colors * bits // 8)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    kind = 2 if colors == 3 else 0
    head = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*c) for c in ((b"IHDR", head), (b"IDAT", data), (b"IEND", b"")))


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def jpeg(width: int, height: int) -> bytes:
    """Return a small JPEG that says it is larger."""
    out = io.BytesIO()
    Image.new("RGB", (16, 16)).save(out, "JPEG")
    data = bytearray(out.getvalue())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def mp4(frames: int, size: tuple[int, int] = (640, 480), *, fragments: bool = False) -> bytes:
    """Return a video of a kilobyte with an index of so many frames."""
    unit = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    width, height = size
    times = struct.pack(">4I", 0, 0, 1000, 1000)
    movie = _full(b"mvhd", 0, times, struct.pack(">IH", 0x10000, 0x100), bytes(10), unit, bytes(24), b"\0\0\0\2")
    shown = struct.pack(">2I", width << 16, height << 16)
    track = _full(b"tkhd", 3, struct.pack(">5I", 0, 0, 1, 0, 1000), bytes(16), unit, shown)
    clock = _full(b"mdhd", 0, struct.pack(">4I2H", 0, 0, 30, frames, 0x55C4, 0))
    kind = _full(b"hdlr", 0, bytes(4), b"vide", bytes(13))
    sides = struct.pack(">2H3IH", width, height, 0x480000, 0x480000, 0, 1)
    entry = _box(b"mp4v", bytes(6), b"\0\1", bytes(16), sides, bytes(32), struct.pack(">Hh", 24, -1))
    n = 0 if fragments else frames
    rows = 1 if n else 0
    tables = (
        _full(b"stsd", 0, struct.pack(">I", 1), entry),
        _full(b"stts", 0, struct.pack(">I", rows), struct.pack(">2I", n, 1) * rows),
        _full(b"stsc", 0, struct.pack(">I", rows), struct.pack(">3I", 1, n, 1) * rows),
        _full(b"stsz", 0, struct.pack(">2I", rows, n)),
        _full(b"stco", 0, struct.pack(">I", rows), struct.pack(">I", 48) * rows),
    )
    here = _box(b"dinf", _full(b"dref", 0, struct.pack(">I", 1), _full(b"url ", 1)))
    media = _box(b"mdia", clock, kind, _box(b"minf", _full(b"vmhd", 1, bytes(8)), here, _box(b"stbl", *tables)))
    more = _box(b"mvex", _full(b"trex", 0, struct.pack(">5I", 1, 1, 1, 1, 0))) if fragments else b""
    head = _box(b"ftyp", b"isom\0\0\2\0isomiso2mp41") + _box(b"mdat", bytes(100))
    out = head + _box(b"moov", movie, _box(b"trak", track, media), more)
    if not fragments:
        return out
    run = _full(b"tfhd", 0x020000, struct.pack(">I", 1)) + _full(b"trun", 0, struct.pack(">I", frames))
    return out + _box(b"moof", _full(b"mfhd", 0, struct.pack(">I", 1)), _box(b"traf", run)) + _box(b"mdat", bytes(100))


def _box(name: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I", 8 + len(body)) + name + body


def _full(name: bytes, flags: int, *parts: bytes) -> bytes:
    return _box(name, struct.pack(">I", flags), *parts)


def zipped(*members: tuple[str, bytes | int], packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An archive; a number means so many zeros."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", packing) as archive:
        for name, data in members:
            with archive.open(name, "w", force_zip64=True) as member:
                left = data if isinstance(data, int) else 0
                member.write(b"" if isinstance(data, int) else data)
                while left > 0:
                    left -= member.write(bytes(min(left, 2**22)))
    return out.getvalue()
