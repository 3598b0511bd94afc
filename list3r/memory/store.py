"""The store: one SQLite file that is the only truth; nothing outside `memory` knows that it is SQLite."""

from __future__ import annotations

from list3r.memory.codec import checksum
from list3r.memory.edit_verbs import EditVerbs

_CHECKED = {
    "chunks": ("chunk_id", "cannot_link, overlap"),
    "keyframes": ("chunk_id || ':' || frame_index", "descriptor, features, jpeg"),
    "local_instances": ("chunk_id || ':' || local_id", "feature, track"),
    "supports": ("chunk_id || ':' || local_id", "grid, points, confidence, rgb"),
}

_REFERENCES = (
    ("observations", "instance", "instances", "id"),
    ("observations", "chunk_id", "chunks", "chunk_id"),
    ("relations", "subject", "instances", "id"),
    ("relations", "object", "instances", "id"),
    ("embeddings", "instance", "instances", "id"),
    ("frames", "chunk_id", "chunks", "chunk_id"),
    ("instances", "id", "instance_boxes", "id"),
    ("instance_boxes", "id", "instances", "id"),
)


class Store(EditVerbs):
    """Verbs of the memory file. `Store.open(path)` to read, `writable=True` to write, `Store.create(path)` anew."""

    def verify(self) -> list[str]:
        """Every damage found: pages, checksums of blobs, rows that point nowhere. Empty when the file is sound."""
        found = [f"SQLite: {text}" for (text,) in self._rows("PRAGMA integrity_check") if text != "ok"]
        for table, (key, blobs) in _CHECKED.items():
            for name, crc, *parts in self._rows(f"SELECT {key}, crc, {blobs} FROM {table}"):
                if checksum(*parts) != crc:
                    found.append(f"{table} {name}: the checksum does not match; the row is damaged")
        for table, column, other, target in _REFERENCES:
            query = f"SELECT DISTINCT {column} FROM {table} WHERE {column} NOT IN (SELECT {target} FROM {other})"
            found += [f"{table}: {column} {value} is not in {other}" for (value,) in self._rows(query)]
        return found
