"""An index over the embeddings of a store: derived when first asked for, kept with the store, never stored."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.errors import OptionError, SpaceMismatchError
from list3r.memory.search.all_vectors import AllVectors
from list3r.memory.search.inverted_file import InvertedFile, unit, unit_query
from list3r.memory.search.vector_cells import Cells, cache_file, cell_count, sample_size
from list3r.memory.store.store import Store

_EXACT = 30_000
"""Up to this many vectors all are compared; more are looked up in an inverted file."""
_PROBED = 64
"""Cells looked into for a question, at least; twice as many whenever too few of what they hold passes the filters."""
_LOOKED_AT = 10_000
"""Vectors that the cells hold together, at least: small cells part what is alike more often."""
_RANKED = 64
"""Candidates of the inverted file, at least, that are compared exactly with what the store holds."""
_REBUILD = 0.1
"""Share of the vectors that may have changed before the index is built again."""


class VectorIndices:
    """What is kept of an open store: the index of each space, and the spaces that it holds."""

    def __init__(self) -> None:
        self.of_space: dict[str, VectorIndex] = {}
        self.spaces: tuple[int, list[str]] | None = None
        """State of the file as other processes left it, and the spaces then."""


@dataclass
class VectorIndex:
    """Search by cosine over the vectors of one named space.

    Small memories are compared in full. Large ones keep half-precision copies in an inverted file, and the best of
    those are compared again with the vectors in the store, so scores are exact at any size. What the store has changed
    since the index was built is compared in full, too; what another process changed makes it be built again.
    """

    space: str
    """`model@revision/dim`."""
    dimension: int
    count: int
    """Vectors in `index`."""
    index: AllVectors | InvertedFile
    _made_of: tuple[int, int]
    """State of the file as other processes left it, and how often something was taken back."""
    _seen: int
    """How many of the store's own changes `index` holds."""
    _stamp: object = None
    _fresh: tuple[NDArray[np.int64], NDArray[np.float32]] | None = None
    """Ids and unit vectors of what has changed."""
    _stale: frozenset[int] = field(default_factory=frozenset)
    """Ids whose vectors in `index` no longer count."""

    @staticmethod
    def of(store: Store, space: str | None = None) -> VectorIndex:
        """Return the index of a store's embeddings, of the named space or of the only one.

        Raises `SpaceMismatchError` for a space the memory does not hold, `OptionError` when it holds none or several
        and none was named.
        """
        chosen = _chosen_space(store, space)
        stamp = store.connection.stamp()
        held = store.derived.of(VectorIndices).of_space
        found = held.get(chosen)
        if found is None or found._made_of != (stamp[0], stamp[2]) or not found._caught_up(store, stamp):
            held.pop(chosen, None)
            found = held[chosen] = _build(store, chosen, stamp)
        return found

    def _caught_up(self, store: Store, stamp: tuple[int, int, int]) -> bool:
        """Take in what the store has changed since; False when that is so much that building again is better."""
        if stamp == self._stamp:
            return True
        changed = sorted(set(store.embeddings.touched[self._seen :]))
        if len(changed) > max(1000, _REBUILD * self.count):
            return False
        ids, vectors = store.embeddings.of(self.space, changed)
        if len(ids) and vectors.shape[1] != self.dimension:
            return False
        self._fresh = (ids, unit(vectors)) if len(ids) else None
        self._stale, self._stamp = frozenset(changed), stamp
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
        width, probed = max(4 * k, _RANKED), max(_PROBED, -(-_LOOKED_AT * cell_count(self.count) // max(self.count, 1)))
        while True:
            found = self._ranked(store, query, width, probed)
            kept = _first(found, k, passing)
            if len(kept) >= k or width >= self.count:
                return kept
            width = min(8 * width, self.count)
            probed = self.count if width == self.count else 2 * probed

    def _ranked(self, store: Store, query: NDArray[np.float32], width: int, probed: int) -> list[tuple[int, float]]:
        """Return the best `width` or so of the index and all that has changed, by exact cosine."""
        score, at = self.index.search(store, query, min(width, self.count), probed)
        found = [(int(n), float(s)) for n, s in zip(at, score, strict=True) if n >= 0 and int(n) not in self._stale]
        if self.count > _EXACT:
            ids, vectors = store.embeddings.of(self.space, [n for n, _ in found])
            found = list(zip(ids.tolist(), (unit(vectors) @ query).tolist(), strict=True)) if len(ids) else []
        if self._fresh is not None:
            found += zip(self._fresh[0].tolist(), (self._fresh[1] @ query).tolist(), strict=True)
        return sorted(found, key=lambda x: (-x[1], x[0]))

    def vector(self, store: Store, instance_id: int) -> NDArray[np.float32]:
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
    made_of, kept = store.connection.stamp()[0], store.derived.of(VectorIndices)
    if kept.spaces is None or kept.spaces[0] != made_of or store.embeddings.spaces_touched - set(kept.spaces[1]):
        kept.spaces = (made_of, store.embeddings.spaces())
    spaces = kept.spaces[1]
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


def _build(store: Store, space: str, stamp: tuple[int, int, int]) -> VectorIndex:
    """Read what has to be read now, a batch at a time."""
    count = store.embeddings.count(space)
    index, total = _all(store, space) if count <= _EXACT else _inverted(store, space, count)
    return VectorIndex(space, index.d, total, index, (stamp[0], stamp[2]), len(store.embeddings.touched), stamp)


def _all(store: Store, space: str) -> tuple[AllVectors, int]:
    """Return all vectors as they are, and how many."""
    parts = [(ids, unit(vectors)) for ids, vectors in store.embeddings.batches(space)]
    if not parts:
        return AllVectors(np.zeros(0, np.int64), np.zeros((0, 1), np.float32)), 0
    ids, vectors = (np.concatenate(each) for each in zip(*parts, strict=True))
    return AllVectors(ids, vectors), len(ids)


def _inverted(store: Store, space: str, count: int) -> tuple[InvertedFile, int]:
    """Return all vectors in cells that are learned on a sample or were kept since they were, and how many."""
    place = cache_file(store.path, space)
    seals = store.embeddings.seals()
    cells = Cells.load(place, next(store.embeddings.batches(space, 1))[1].shape[1], count)
    while True:
        if cells is None:
            cells = Cells.learned(unit(store.embeddings.sample(space, sample_size(count))), count)
        index, total = _filled(store, space, cells, seals)
        if total != count:  # the checksums leave vectors out: all are read, which finds what is damaged
            cells.seals.clear()
            index, total = _filled(store, space, cells, None)
        if not cells.outdated:
            cells.save(place, seals)
            return index, total
        cells = None


def _filled(store: Store, space: str, cells: Cells, seals: Mapping[int, bytes] | None) -> tuple[InvertedFile, int]:
    """Return the vectors in their cells, and how many: those in parts of the table that are as they were are left to be
    read when they are asked for. Without `seals` all are read.
    """
    index = InvertedFile(space, cells.centroids)
    same = {part for part, seal in (seals or {}).items() if cells.seals.get(part) == seal}
    held = cells.take_over(store.embeddings.parts_of(cells.ids), same)
    index.leave(cells.ids[held], cells.cells[held])
    total = int(held.sum())
    table = store.embeddings
    for ids, vectors in table.batches(space) if seals is None else table.in_parts(space, seals.keys() - same):
        rows = unit(vectors)
        index.add(ids, rows, cells.of(index.quantizer, ids, rows))
        total += len(ids)
    return index, total
