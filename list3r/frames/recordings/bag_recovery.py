"""Recordings whose recorder was killed, or still runs: what is whole of them, with the end that is missing.

Both formats are sequences of records and end with an index, without which `rosbags` refuses them. Of an mcap
(mcap.dev/spec) the end of a file without an index is put after the last whole record; of a ROS 1 bag
(wiki.ros.org/Bags/Format/2.0) the index is made again from its whole chunks. Nothing is written.
"""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

from list3r.frames.recordings.bag_chunks import MOST_BYTES

_MCAP = b"\x89MCAP0\r\n"
_MCAP_DATA_END, _MCAP_FOOTER = 0x0F, 0x02
_MCAP_TAIL = struct.pack("<BQIBQQQI", _MCAP_DATA_END, 4, 0, _MCAP_FOOTER, 20, 0, 0, 0) + _MCAP
"""The end of the data, and a footer that names no index."""
_BAG = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
"""Codes of a bag's records."""
_MOST_HEADER = 1 << 20
"""Bytes of a record's header; the longest hold the definition of a message."""


class CutOffError(ValueError):
    """Raised where a file ends inside of a record."""


@dataclass(frozen=True)
class RecoveredFile:
    """A recording as it would be had its recorder ended it after the last whole record.

    It has of a path what `rosbags` asks of one.
    """

    path: Path
    head: bytes
    """In place of as many bytes at the beginning."""
    end: int
    """Bytes of the file that count."""
    size: int
    """Bytes that the file has."""
    tail: bytes
    """What comes after."""

    @property
    def suffix(self) -> str:
        """The ending by which `rosbags` knows the format."""
        return ".bag" if self.path.name.endswith(".bag.active") else self.path.suffix

    def exists(self) -> bool:
        """Whether it is there."""
        return self.path.exists()

    def is_dir(self) -> bool:
        """It is a file."""
        return False

    def open(self, _: str = "rb") -> BinaryIO:
        """Return it, to be read as bytes."""
        return io.BufferedReader(_Spliced(self), 1 << 16)

    def __str__(self) -> str:
        return str(self.path)


class _Spliced(io.RawIOBase):
    """Head, middle from the file, tail."""

    def __init__(self, recovered: RecoveredFile) -> None:
        self._recovered, self._file, self._at = recovered, recovered.path.open("rb"), 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = (0, self._at, self._recovered.end + len(self._recovered.tail))[whence]
        self._at = max(0, base + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        m, count = self._recovered, len(buffer)
        if self._at < len(m.head):
            data = m.head[self._at : self._at + count]
        elif self._at < m.end:
            self._file.seek(self._at)
            data = self._file.read(min(count, m.end - self._at))
        else:
            data = m.tail[self._at - m.end : self._at - m.end + count]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


def recovered(path: Path, decompressors: Mapping[str, Callable[..., bytes]]) -> RecoveredFile | None:
    """Return a recording that lacks its end as one that has it; None for one that is whole, of another kind, or of
    which nothing is.

    `decompressors` unpack the chunks of a bag, by name. Raises `OSError`.
    """
    stat = path.stat()
    return _recovered(path, stat.st_size, stat.st_mtime_ns, tuple(decompressors.items()))


@lru_cache(maxsize=8)
def _recovered(
    path: Path, size: int, _: int, decompressors: tuple[tuple[str, Callable[..., bytes]], ...]
) -> RecoveredFile | None:
    with path.open("rb") as file:
        begins = file.read(len(_BAG))
        if begins.startswith(_MCAP):
            return _recovered_mcap(path, file, size)
        return _recovered_bag(path, file, size, dict(decompressors)) if begins == _BAG else None


# ---------------------------------------------------------------------------------------------- mcap


def _recovered_mcap(path: Path, file: BinaryIO, size: int) -> RecoveredFile | None:
    file.seek(max(0, size - len(_MCAP)))
    if file.read() == _MCAP and size > len(_MCAP):
        return None
    at, records = len(_MCAP), 0
    while at + 9 <= size:
        file.seek(at)
        code, length = struct.unpack("<BQ", file.read(9))
        # zeros are of a disk that was full, or of a file that is made long before it is written
        if code in (0, _MCAP_DATA_END, _MCAP_FOOTER) or at + 9 + length > size:
            break
        at, records = at + 9 + length, records + 1
    return RecoveredFile(path, b"", at, size, _MCAP_TAIL) if records > 1 else None


# ---------------------------------------------------------------------------------------------- bags of ROS 1


@dataclass(frozen=True)
class _Record:
    """A record of a bag."""

    fields: dict[bytes, bytes]
    header: bytes
    start: int
    data: int
    """Where its data begin."""
    stop: int

    @property
    def code(self) -> int:
        """What kind it is; -1 for none."""
        return int.from_bytes(self.fields.get(b"op", b""), "little") if b"op" in self.fields else -1

    def number(self, name: bytes) -> int:
        """Return a field of four or eight bytes. Raises `CutOffError` where there is none."""
        value = self.fields.get(name, b"")
        if len(value) not in (4, 8):
            raise CutOffError(f"a record has no {name.decode()}")
        return int.from_bytes(value, "little")


def _record(file: BinaryIO, at: int, size: int) -> _Record:
    """Return the record at a place. Raises `CutOffError` where it is not whole."""
    file.seek(at)
    length = _number(file.read(4))
    if not 0 < length <= min(_MOST_HEADER, size - at - 8):
        raise CutOffError("a header is not whole")
    header, fields, place = file.read(length), dict[bytes, bytes](), 0
    while place < length:
        stop = place + 4 + _number(header[place : place + 4])
        name, _, value = header[place + 4 : stop].partition(b"=")
        fields[name], place = value, stop
    data = at + 8 + length
    stop = data + _number(file.read(4))
    if place != length or stop > size:
        raise CutOffError("a record is not whole")
    return _Record(fields, header, at, data, stop)


def _records(file: BinaryIO, at: int, size: int) -> Iterator[_Record]:
    """Yield the whole records from a place on."""
    while at < size:
        try:
            record = _record(file, at, size)
        except CutOffError:
            return
        yield record
        at = record.stop


def _recovered_bag(
    path: Path, file: BinaryIO, size: int, decompressors: dict[str, Callable[..., bytes]]
) -> RecoveredFile | None:
    try:
        first = _record(file, len(_BAG), size)
        if first.code != _BAG_HEADER or _is_indexed(file, first, size):
            return None
    except CutOffError:
        return None
    connections: dict[int, bytes] = {}
    infos: list[bytes] = []
    end, waiting = first.stop, Counter[int]()
    """Messages of the chunk that was read last, by connection, that no index was found for yet."""
    chunk, counts, times, fresh = first, Counter[int](), list[tuple[int, int]](), dict[int, bytes]()
    for record in _records(file, first.stop, size):
        if record.code == _CHUNK:
            if waiting:
                break
            held = _looked_through(file, record, decompressors)
            if held is None:
                break
            fresh, counts = held
            chunk, times, waiting = record, [], Counter(counts)
        elif record.code == _INDEX and waiting:
            times += _times(file, record)
            waiting.pop(record.number(b"conn"), None)
        else:
            break
        if not waiting:
            end = record.stop
            connections = fresh | connections
            infos.append(_chunk_info(chunk, counts, times))
    if not infos:
        return None
    tail = b"".join(connections[n] for n in sorted(connections)) + b"".join(infos)
    header = first.header
    stated = ((b"index_pos", end, 8), (b"conn_count", len(connections), 4), (b"chunk_count", len(infos), 4))
    for name, value, width in stated:
        place = header.find(name + b"=") + len(name) + 1
        header = header[:place] + value.to_bytes(width, "little") + header[place + width :]
    head = _BAG + struct.pack("<I", len(header)) + header
    return RecoveredFile(path, head, end, size, tail)


def _is_indexed(file: BinaryIO, first: _Record, size: int) -> bool:
    """Whether a bag has the whole index that its header refers to."""
    at, wanted = first.number(b"index_pos"), first.number(b"conn_count") + first.number(b"chunk_count")
    return 0 < at <= size and sum(1 for _ in _records(file, at, size)) >= wanted


def _looked_through(
    file: BinaryIO, chunk: _Record, decompressors: dict[str, Callable[..., bytes]]
) -> tuple[dict[int, bytes], Counter[int]] | None:
    """Return the records of connections in a chunk, and its messages by connection; None for one that is damaged."""
    unpack = decompressors.get(chunk.fields.get(b"compression", b"").decode("ascii", "replace"))
    if unpack is None or chunk.stop - chunk.data > MOST_BYTES:
        return None
    file.seek(chunk.data)
    try:
        held = unpack(file.read(chunk.stop - chunk.data))
    except (ValueError, OSError, EOFError):
        return None
    inside, connections, counts, end = io.BytesIO(held), dict[int, bytes](), Counter[int](), 0
    for record in _records(inside, 0, len(held)):
        end = record.stop
        if record.code == _CONNECTION:
            connections.setdefault(record.number(b"conn"), held[record.start : record.stop])
        elif record.code == _MESSAGE:
            counts[record.number(b"conn")] += 1
    return (connections, counts) if counts and end == len(held) else None


def _times(file: BinaryIO, index: _Record) -> list[tuple[int, int]]:
    """Return seconds and nanoseconds of the messages that an index names."""
    file.seek(index.data)
    data = file.read(min(12 * index.number(b"count"), index.stop - index.data))
    return [(s, ns) for s, ns, _ in struct.iter_unpack("<III", data[: len(data) // 12 * 12])]


def _chunk_info(chunk: _Record, counts: Mapping[int, int], times: list[tuple[int, int]]) -> bytes:
    fields = {
        b"op": bytes([_CHUNK_INFO]),
        b"ver": struct.pack("<I", 1),
        b"chunk_pos": struct.pack("<Q", chunk.start),
        b"start_time": struct.pack("<II", *min(times, default=(0, 0))),
        b"end_time": struct.pack("<II", *max(times, default=(0, 0))),
        b"count": struct.pack("<I", len(counts)),
    }
    header = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in fields.items())
    data = b"".join(struct.pack("<II", k, n) for k, n in sorted(counts.items()))
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def _number(data: bytes) -> int:
    if len(data) != 4:
        raise CutOffError("the file ends")
    return int.from_bytes(data, "little")
