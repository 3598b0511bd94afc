"""The vectors of a space of which there are so few that all are compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.memory.store.store import Store


class AllVectors:
    """Unit vectors by instance."""

    def __init__(self, ids: NDArray[np.int64], unit: NDArray[np.float32]) -> None:
        """`ids` has shape (N,), `unit` (N, D)."""
        self._ids, self._unit = ids, unit
        self.d = unit.shape[1]
        """Numbers of a vector."""

    def search(
        self, store: Store, query: NDArray[np.float32], width: int, probed: int
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return cosines and ids of the best `width` and of what is as good as the last of them, in no order. `query`
        is a unit vector (D,); see `InvertedFile.search` for the rest.
        """
        cosine = self._unit @ query
        at = np.flatnonzero(cosine >= np.partition(cosine, -width)[-width]) if width else np.zeros(0, np.int64)
        return cosine[at], self._ids[at]
