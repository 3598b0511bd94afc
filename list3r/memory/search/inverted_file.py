"""Vectors in cells, in half precision; where cells are known beforehand, vectors are read when they are looked into."""

from __future__ import annotations

from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.errors import OptionError
from list3r.memory.store.store import Store


class InvertedFile:
    """The vectors of one named space of a store by their cells.

    A question looks into few cells. So a memory that was just opened answers without reading all that it holds, and
    what it reads is checked like every other row. Several threads may ask; one at a time is answered.
    """

    def __init__(self, space: str, centroids: NDArray[np.float32]) -> None:
        """`centroids` of the cells have shape (C, D)."""
        import faiss

        self.space = space
        self.d = centroids.shape[1]
        """Numbers of a vector."""
        self.quantizer = faiss.IndexFlatIP(self.d)
        """Tells the cell of a vector."""
        self.quantizer.add(centroids)
        self._index = faiss.IndexIVFScalarQuantizer(
            self.quantizer, self.d, len(centroids), faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT
        )
        self._index.by_residual = False
        self._index.train(centroids)  # half precision needs no training; this says that the cells are there
        self._lock = Lock()
        self._unread: dict[int, NDArray[np.int64]] = {}
        """Ids that belong to a cell and were not read yet."""

    def add(self, ids: NDArray[np.int64], unit: NDArray[np.float32], cells: NDArray[np.int64]) -> None:
        """Add unit vectors (n, D) with their ids and cells (n,)."""
        import faiss

        pointer: Any = faiss.swig_ptr
        self._index.add_core(len(ids), pointer(unit), pointer(ids), pointer(cells))

    def leave(self, ids: NDArray[np.int64], cells: NDArray[np.int32]) -> None:
        """Say to which cells (n,) the vectors of some ids (n,) belong; each may be told once."""
        order = np.argsort(cells, kind="stable")
        numbers, starts = np.unique(cells[order], return_index=True)
        parts = np.split(ids[order], starts[1:]) if len(ids) else []
        self._unread = dict(zip(numbers.tolist(), parts, strict=True))

    def search(
        self, store: Store, query: NDArray[np.float32], width: int, probed: int
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return cosines and ids, -1 where there are none, of the best of what `probed` cells hold. `query` is a unit
        vector (D,). Shape (width,) each.
        """
        import faiss

        options: Any = faiss.SearchParametersIVF()
        options.nprobe = probed
        with self._lock:
            if self._unread:
                self._read(store, self.quantizer.search(query[None], min(probed, self.quantizer.ntotal))[1][0].tolist())
            score, at = self._index.search(query[None], width, params=options)
        return score[0], at[0]

    def _read(self, store: Store, cells: list[int]) -> None:
        """Read what belongs to some cells."""
        parts = [(n, self._unread[n]) for n in cells if n in self._unread]
        if not parts:
            return
        wanted = np.concatenate([ids for _, ids in parts])
        of = np.repeat([n for n, _ in parts], [len(ids) for _, ids in parts])
        order = np.argsort(wanted)
        ids, vectors = store.embeddings.of(self.space, wanted[order].tolist())
        at = np.searchsorted(wanted[order], ids)
        self.add(ids, unit(vectors), of[order][at])
        for n, _ in parts:
            del self._unread[n]


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
