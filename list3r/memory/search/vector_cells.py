"""The cells of the inverted file of a large space: learned once, kept in the user's cache, of use even when outdated.

What is kept is where each vector belongs, not the vectors: a memory answers with what its file holds. The checksums of
the file tell which parts of it are as they were; a vector that has changed since, or has come in, is looked at again as
the index is made. So what is kept may be thrown away, and can at worst hide a candidate; it lies with the user and not
with the memory, so that no file of a stranger brings one along.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import MemoryFileError
from list3r.memory.store.rows.codec import unpack

if TYPE_CHECKING:
    import faiss

_PER_CELL = 40
"""Vectors for each cell, on which the cells are learned."""
_CELLS_BY_ROOT = 4.0
"""Cells over the square root of the number of vectors."""
_ROUNDS = 8
"""Rounds of k-means."""
_STALE = 0.5
"""Share of the vectors that may be other ones than those the cells were learned on."""
_MOST_FILES = 16
"""Memories whose cells are kept."""


def cell_count(count: int) -> int:
    """Return how many cells this many vectors fall into."""
    return int(_CELLS_BY_ROOT * np.sqrt(count))


def sample_size(count: int) -> int:
    """Return how many vectors the cells are learned on."""
    return _PER_CELL * cell_count(count)


@dataclass
class Cells:
    """The centroids of a space and the cell of each vector."""

    centroids: NDArray[np.float32]
    """Shape (C, D)."""
    ids: NDArray[np.int64]
    """Of the vectors whose cells are known, ascending. Shape (N,)."""
    marks: NDArray[np.uint32]
    """Tell whether a vector is still the same. Shape (N,)."""
    cells: NDArray[np.int32]
    """Shape (N,)."""
    seals: dict[int, bytes] = field(default_factory=dict)
    """State of the parts of the table of vectors in which they were read."""
    _new: list[tuple[NDArray[np.int64], NDArray[np.uint32], NDArray[np.int32]]] = field(default_factory=list)
    asked: int = 0
    """Vectors of which it was asked, and """
    unknown: int = 0
    """how many of those were new or had changed."""

    @staticmethod
    def learned(sample: NDArray[np.float32], count: int) -> Cells:
        """Return cells for `count` vectors, learned on a sample (n, D) of unit vectors."""
        import faiss

        kmeans = faiss.Kmeans(
            sample.shape[1],
            min(cell_count(count), len(sample)),
            niter=_ROUNDS,
            seed=1,
            spherical=True,
            min_points_per_centroid=1,
            max_points_per_centroid=2 * _PER_CELL,
        )
        kmeans.train(sample)
        empty = np.zeros(0)
        return Cells(
            np.asarray(kmeans.centroids, np.float32),
            empty.astype(np.int64),
            empty.astype(np.uint32),
            empty.astype(np.int32),
        )

    def take_over(self, parts_of: NDArray[np.int64], same: set[int]) -> NDArray[np.bool_]:
        """Begin with the vectors that stand in parts that are the same; tell which these are. `parts_of` and what is
        returned have shape (N,).
        """
        held = np.isin(parts_of, np.fromiter(same, np.int64, len(same)))
        self.asked, self.unknown = int(held.sum()), 0
        self._new = [(self.ids[held], self.marks[held], self.cells[held])]
        return held

    def of(self, quantizer: faiss.Index, ids: NDArray[np.int64], vectors: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the cells of unit vectors (n, D) of some ids; those that are not known are looked for. Shape (n,)."""
        marks = _marks(vectors)
        at = np.minimum(np.searchsorted(self.ids, ids), max(len(self.ids) - 1, 0))
        if len(self.ids):
            known = (self.ids[at] == ids) & (self.marks[at] == marks)
            cells = np.where(known, self.cells[at], -1).astype(np.int64)
        else:
            known, cells = np.zeros(len(ids), bool), np.full(len(ids), -1, np.int64)
        if not known.all():
            nearest: Any = quantizer.search(np.ascontiguousarray(vectors[~known]), 1)[1]
            cells[~known] = nearest[:, 0]
        self.asked, self.unknown = self.asked + len(ids), self.unknown + int((~known).sum())
        self._new.append((ids, marks, cells.astype(np.int32)))
        return cells

    @property
    def outdated(self) -> bool:
        """Whether most of what was asked for is not what the cells were learned on; after learning it is not."""
        return len(self.ids) > 0 and self.unknown > _STALE * max(self.asked, 1)

    def save(self, path: Path, seals: Mapping[int, bytes]) -> None:
        """Keep what was asked for, in this state of the parts of their table; where that cannot be, nothing is kept."""
        known = {part: seal for part, seal in seals.items() if seal}
        if self.seals == known:
            return
        ids, marks, cells = (np.concatenate(parts) for parts in zip(*self._new, strict=True))
        order = np.argsort(ids)
        new = path.with_name(f"{path.name}-{os.getpid()}")
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with new.open("wb") as file:
                np.savez(
                    file,
                    centroids=self.centroids,
                    ids=ids[order],
                    marks=marks[order],
                    cells=cells[order],
                    parts=np.fromiter(known, np.int64, len(known)),
                    seals=np.frombuffer(b"".join(known.values()), "<u4"),
                )
            new.replace(path)
            files = sorted(path.parent.glob("*.npz"), key=lambda p: p.stat().st_mtime)
            for old in files[:-_MOST_FILES]:
                old.unlink(missing_ok=True)

    @staticmethod
    def load(path: Path, dimension: int, count: int) -> Cells | None:
        """Return what was kept; None where there is nothing, or nothing of use for `count` vectors of a dimension."""
        try:
            arrays = unpack(path.read_bytes(), str(path))
            kept = Cells(
                arrays["centroids"].astype(np.float32),
                arrays["ids"].astype(np.int64),
                arrays["marks"].astype(np.uint32),
                arrays["cells"].astype(np.int32),
                dict(zip(arrays["parts"].tolist(), _in_fours(arrays["seals"]), strict=True)),
            )
        except (OSError, KeyError, ValueError, MemoryFileError):
            return None
        n, c = len(kept.ids), len(kept.centroids)
        fits = kept.centroids.shape == (c, dimension) and kept.marks.shape == kept.cells.shape == kept.ids.shape == (n,)
        if not fits or c == 0 or not np.isfinite(kept.centroids).all() or (np.diff(kept.ids) <= 0).any():
            return None
        if n and not (0 <= kept.cells.min() and kept.cells.max() < c):
            return None
        return kept if 0.5 <= (n + 1) / (count + 1) <= 2.0 else None


def cache_file(memory: Path, space: str) -> Path:
    """Return where the cells of a space of a memory are kept: `$LIST3R_CACHE`, else the user's cache."""
    name = hashlib.sha256(f"{memory.resolve()}\n{space}".encode("utf-8", "surrogateescape")).hexdigest()[:32]
    return _cache_folder() / "cells" / f"{name}.npz"


def _cache_folder() -> Path:
    if os.environ.get("LIST3R_CACHE"):
        return Path(os.environ["LIST3R_CACHE"])
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path("~/.cache").expanduser()) / "list3r"


def _in_fours(seals: NDArray[np.uint32]) -> list[bytes]:
    data = seals.astype("<u4").tobytes()
    return [data[n : n + 4] for n in range(0, len(data), 4)]


def _marks(vectors: NDArray[np.float32]) -> NDArray[np.uint32]:
    """32 bits of each vector that change when it does. Shape (n,)."""
    words = np.ascontiguousarray(vectors).view(np.uint32)
    odd = np.random.default_rng(1).integers(0, 2**31, words.shape[1], dtype=np.uint32) * np.uint32(2) + np.uint32(1)
    mixed = (words ^ (words >> np.uint32(15))) * odd
    return np.asarray(np.bitwise_xor.reduce(mixed ^ (mixed >> np.uint32(13)), axis=1), np.uint32)
