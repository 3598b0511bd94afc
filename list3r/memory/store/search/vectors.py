"""Search by cosine over the vectors of a memory, by an index of FAISS that is derived and may be thrown away.

The index gives candidates; their vectors are read from the memory, and ranked by those. So an answer holds at any size,
whatever the index knows: what has changed since it was made is compared beside it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import OptionError, SpaceMismatchError
from list3r.memory.store.derived import cache_folder
from list3r.memory.store.store import Store

_EXACT = 30_000
"""Up to this many vectors all are compared; more are looked up in cells."""
_PROBED = 64
"""Cells looked into for a question, at least; twice as many whenever too few of what they hold passes the filters."""
_LOOKED_AT = 10_000
"""Vectors that the cells hold together, at least: small cells part what is alike more often."""
_RANKED = 64
"""Candidates, at least, that are compared exactly with what the store holds."""
_REBUILD = 0.1
"""Share of the vectors that may have changed before the index is made again."""
_CELLS_BY_ROOT = 4.0
"""Cells over the square root of the number of vectors."""
_PER_CELL = 40
"""Vectors for each cell, on which the cells are learned;"""
_ROUNDS = 8
"""in so many rounds of k-means."""
_MOST_FILES = 4
"""Indices that are kept in the user's cache."""
_MARKED = 32
"""Vectors that tell one memory from another of its name."""
Floats = NDArray[np.float32]
Ids = NDArray[np.int64]


class VectorIndices:
    """What is kept of an open store: the index of each space."""

    def __init__(self) -> None:
        self.of_space: dict[str, VectorIndex] = {}


class _AllVectors:
    """Unit vectors, of which there are so few that all are compared."""

    def __init__(self, ids: Ids, unit: Floats) -> None:
        self._ids, self._unit = ids, unit

    def search(self, query: Floats, width: int, probed: int) -> Ids:
        """Return the ids of the best `width` and of what is as good as the last of them, in no order."""
        cosine = self._unit @ query
        return self._ids[cosine >= np.partition(cosine, -width)[-width]] if width else self._ids[:0]


class _Cells:
    """An inverted file: a question looks into few cells. It holds a byte for each number."""

    def __init__(self, index: Any) -> None:
        self._index = index

    def search(self, query: Floats, width: int, probed: int) -> Ids:
        """Return the ids of the best `width` of what `probed` cells hold; fewer where they hold fewer."""
        import faiss

        options: Any = faiss.SearchParametersIVF()
        options.nprobe = probed
        found = self._index.search(query[None], width, params=options)[1][0]
        return np.asarray(found[found >= 0])


@dataclass
class VectorIndex:
    """Search by cosine over the vectors of one named space."""

    space: str
    """`model@revision/dim`."""
    dimension: int
    count: int
    """Vectors in `index`."""
    index: _AllVectors | _Cells
    upto: int
    """The last change that `index` holds, see `Embeddings.changes`."""
    rollbacks: int
    """How often something had been taken back when it was made."""
    _changes: int = -1
    _fresh: tuple[Ids, Floats] = (np.zeros(0, np.int64), np.zeros((0, 0), np.float32))
    """Ids and unit vectors of what has changed since `upto`, as of the change `_changes`."""

    @staticmethod
    def of(store: Store, space: str | None = None) -> VectorIndex:
        """Return the index of a store's embeddings, of the named space or of the only one.

        Raises `SpaceMismatchError` for a space the memory does not hold, `OptionError` when it holds none or several
        and none was named.
        """
        held = store.derived.of(VectorIndices).of_space
        chosen = _chosen_space(store, space)
        found = held.get(chosen)
        if found is None or not found._caught_up(store):
            held.pop(chosen, None)
            found = held[chosen] = _made(store, chosen)
        return found

    def _caught_up(self, store: Store) -> bool:
        """Take in what has changed; False where that is so much that making the index again is better."""
        changes = store.embeddings.changes()
        if self.rollbacks != store.connection.rollbacks or changes < self.upto:
            return False
        if changes != self._changes:
            ids, vectors = store.embeddings.changed(self.space, self.upto)
            if len(ids) > max(1000, _REBUILD * self.count) or (len(ids) and vectors.shape[1] != self.dimension):
                return False
            self._fresh, self._changes = (ids, unit(vectors)), changes
        return True

    def search(
        self, store: Store, vector: ArrayLike, k: int, passing: Callable[[Sequence[int]], set[int]] | None = None
    ) -> list[tuple[int, float]]:
        """Return the k most alike: (instance id, cosine), best first, ties by id. `vector` has shape (D,).

        `passing` says which of some ids may answer; it is asked about as few as it takes.
        """
        query = unit_query(vector)
        if len(query) != self.dimension:
            raise SpaceMismatchError(
                f"a vector of {len(query)} numbers cannot be compared in the space {self.space}, "
                f"which has {self.dimension}"
            )
        width = max(4 * k, _RANKED)
        probed = max(_PROBED, -(-_LOOKED_AT * _cell_count(self.count) // max(self.count, 1)))
        while True:
            kept = _first(self._ranked(store, query, width, probed), k, passing)
            if len(kept) >= k or width >= self.count:
                return kept
            width = min(8 * width, self.count)
            probed = self.count if width == self.count else 2 * probed

    def _ranked(self, store: Store, query: Floats, width: int, probed: int) -> list[tuple[int, float]]:
        """Return the best `width` or so of the index and all that has changed, by exact cosine."""
        changed, fresh = self._fresh
        ids = np.setdiff1d(self.index.search(query, min(width, self.count), probed), changed)
        ids, vectors = store.embeddings.of(self.space, ids.tolist())
        found = list(zip(ids.tolist(), (unit(vectors) @ query).tolist(), strict=True)) if len(ids) else []
        if len(changed):
            found += zip(changed.tolist(), (fresh @ query).tolist(), strict=True)
        return sorted(found, key=lambda x: (-x[1], x[0]))

    def vector(self, store: Store, instance_id: int) -> Floats:
        """Return the vector of an instance. Raises `OptionError` when it has none in this space."""
        ids, vectors = store.embeddings.of(self.space, [instance_id])
        if len(ids) == 0:
            raise OptionError(f"instance {instance_id} has no vector in the space {self.space}")
        return np.asarray(vectors[0])


def _first(
    found: Sequence[tuple[int, float]], k: int, passing: Callable[[Sequence[int]], set[int]] | None
) -> list[tuple[int, float]]:
    """Return the first k that pass."""
    if passing is None:
        return list(found[:k])
    kept: list[tuple[int, float]] = []
    start, width = 0, k + 2
    while start < len(found) and len(kept) < k:
        part = found[start : start + width]
        allowed = passing([i for i, _ in part])
        kept += [f for f in part if f[0] in allowed]
        start, width = start + width, 4 * width
    return kept[:k]


def _chosen_space(store: Store, space: str | None) -> str:
    spaces = store.embeddings.spaces()
    if space is None:
        if len(spaces) != 1:
            held = f"several embedding spaces ({', '.join(spaces)}); name one" if spaces else "no embeddings"
            raise OptionError(f"{store.path} holds {held}")
        return spaces[0]
    if space not in spaces:
        raise SpaceMismatchError(
            f"vectors of the space {space} cannot be compared with those of {store.path}, which holds: "
            f"{', '.join(spaces) or 'none'}"
        )
    return space


# ------------------------------------------------------------------------------------------- making it


def _made(store: Store, space: str) -> VectorIndex:
    """Return an index of all that is there, or one that was kept and that little has changed since."""
    dimension = next(store.embeddings.batches(space, 1))[1].shape[1]
    if (kept := _kept(store, space, dimension)) is not None and kept._caught_up(store):
        return kept
    count, changes, rollbacks = store.embeddings.count(space), store.embeddings.changes(), store.connection.rollbacks
    if count <= _EXACT:
        ids, vectors = store.embeddings.all(space)
        return VectorIndex(space, dimension, count, _AllVectors(ids, unit(vectors)), changes, rollbacks, changes)
    index = _filled(store, space, count)
    found = VectorIndex(space, dimension, count, _Cells(index), changes, rollbacks, changes)
    if store.embeddings.of_the_file():
        _keep(store, found, index)
    return found


def _filled(store: Store, space: str, count: int) -> Any:
    """Return FAISS's index of all vectors, its cells learned on a sample."""
    import faiss

    sample = unit(store.embeddings.sample(space, _PER_CELL * _cell_count(count)))
    cells = min(_cell_count(count), len(sample))
    index: Any = faiss.index_factory(sample.shape[1], f"IVF{cells},SQ8", faiss.METRIC_INNER_PRODUCT)
    index.by_residual = False
    index.cp.niter, index.cp.seed, index.cp.spherical, index.cp.min_points_per_centroid = _ROUNDS, 1, True, 1
    index.train(sample)
    for ids, vectors in store.embeddings.batches(space):
        index.add_with_ids(unit(vectors), ids)
    return index


def _cell_count(count: int) -> int:
    return int(_CELLS_BY_ROOT * np.sqrt(count))


def _kept(store: Store, space: str, dimension: int) -> VectorIndex | None:
    """Return the index that was kept of this memory; None where there is none of use."""
    path = _cache_file(store.path, space)
    if not path.exists() or not store.embeddings.of_the_file():
        return None
    import faiss

    with contextlib.suppress(RuntimeError, OSError, ValueError, KeyError, TypeError):
        told = json.loads(path.with_suffix(".json").read_text())
        marks = {int(n): crc for n, crc in told["marks"].items()}
        found = _marks(store, space, told["upto"], list(marks))
        index: Any = faiss.read_index(str(path), faiss.IO_FLAG_MMAP | faiss.IO_FLAG_READ_ONLY)
        if found and found.items() <= marks.items() and (index.d, index.ntotal) == (dimension, told["count"]):
            path.touch()
            rollbacks = store.connection.rollbacks
            return VectorIndex(space, dimension, index.ntotal, _Cells(index), told["upto"], rollbacks)
    return None


def _keep(store: Store, made: VectorIndex, index: Any) -> None:
    """Keep an index for the next that opens the memory; where that cannot be, nothing is kept."""
    import faiss

    path = _cache_file(store.path, made.space)
    marks = _marks(store, made.space, made.upto, store.embeddings.spread(made.space, _MARKED))
    new = path.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(RuntimeError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        faiss.write_index(index, str(new))
        path.with_suffix(".json").unlink(missing_ok=True)
        new.replace(path)
        path.with_suffix(".json").write_text(json.dumps({"upto": made.upto, "count": made.count, "marks": marks}))
        for old in sorted(path.parent.glob("*.faiss"), key=lambda p: p.stat().st_mtime)[:-_MOST_FILES]:
            old.unlink()


def _marks(store: Store, space: str, upto: int, ids: Sequence[int]) -> dict[int, int]:
    """Return a sum of each vector of some instances that has not changed since; they tell one memory from another."""
    return {n: zlib.crc32(vector) for n, vector in store.embeddings.unchanged(space, ids, upto)}


def _cache_file(memory: Path, space: str) -> Path:
    name = hashlib.sha256(f"{memory.resolve()}\n{space}".encode("utf-8", "surrogateescape")).hexdigest()[:32]
    return cache_folder("vectors") / f"{name}.faiss"


def unit(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return vectors of length 1, of zeros where a vector is; of any finite numbers. Shape (n, D)."""
    with np.errstate(over="ignore", under="ignore"):
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
    out = np.ascontiguousarray(vectors / np.where(length > 0.0, length, 1.0), dtype=np.float32)
    odd = ~((length > 1e-12) & (length < np.inf))[:, 0]  # squares of these cannot be added up as they are
    if odd.any():
        scale = np.abs(vectors[odd]).max(axis=1, keepdims=True)
        scaled = vectors[odd].astype(np.float64) / np.where(scale > 0.0, scale, 1.0)
        out[odd] = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1.0)
    return out


def unit_query(vector: ArrayLike) -> NDArray[np.float32]:
    """Return a vector to compare with at length 1. Shape (D,).

    Raises `OptionError` for what is not a row of finite numbers, or all zero.
    """
    try:
        asked = np.asarray(vector, np.float64)
    except (TypeError, ValueError, OverflowError):
        asked = np.zeros(0)
    if asked.shape[-1:] != (asked.size,) or not np.isfinite(asked).all() or not asked.any():
        raise OptionError("the vector to compare with must be a row of finite numbers, not all zero")
    return np.ravel(unit(asked.reshape(1, -1)))
