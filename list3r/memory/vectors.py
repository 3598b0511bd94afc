"""A FAISS index over the embeddings of a store: derived, never stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.errors import OptionError, SpaceMismatchError
from list3r.memory.store import Store

if TYPE_CHECKING:
    import faiss


@dataclass(frozen=True)
class VectorIndex:
    """Exact inner-product search over the unit vectors of one named space."""

    space: str
    """`model@revision/dim`."""
    ids: NDArray[np.int64]
    """Instance of each vector. Shape (N,)."""
    vectors: NDArray[np.float32]
    """Unit length. Shape (N, D)."""
    index: faiss.IndexFlatIP

    @staticmethod
    def of(store: Store, space: str | None = None) -> VectorIndex:
        """The index of a store's embeddings, of the named space or of the only one.

        Raises `SpaceMismatchError` for a space the memory does not hold, `OptionError` when it holds none or several
        and none was named.
        """
        import faiss

        spaces = store.embedding_spaces()
        if space is None:
            if len(spaces) != 1:
                held = f"several embedding spaces ({', '.join(spaces)}); name one" if spaces else "no embeddings"
                raise OptionError(f"{store.path} holds {held}")
            space = spaces[0]
        if space not in spaces:
            raise SpaceMismatchError(
                f"vectors of the space {space} cannot be compared with those of {store.path}, which holds: "
                f"{', '.join(spaces) or 'none'}"
            )
        ids, vectors = store.embeddings(space)
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        unit = np.ascontiguousarray(vectors / np.maximum(length, 1e-12), dtype=np.float32)
        index = faiss.IndexFlatIP(unit.shape[1])
        index.add(unit)
        return VectorIndex(space, ids, unit, index)

    def search(self, vector: ArrayLike, k: int) -> list[tuple[int, float]]:
        """The k most alike: (instance id, cosine), best first, ties by id. `vector` has shape (D,)."""
        query = np.asarray(vector, dtype=np.float32).reshape(1, -1)
        if query.shape[1] != self.vectors.shape[1]:
            raise SpaceMismatchError(
                f"a vector of {query.shape[1]} numbers cannot be compared in the space {self.space}, "
                f"which has {self.vectors.shape[1]}"
            )
        length = float(np.linalg.norm(query))
        if not np.isfinite(length) or length == 0.0:
            raise OptionError("the vector to compare with must be finite and not zero")
        score, at = self.index.search(np.ascontiguousarray(query / length), min(k, len(self.ids)))
        found = [(int(self.ids[n]), float(s)) for n, s in zip(at[0], score[0], strict=True) if n >= 0]
        return sorted(found, key=lambda x: (-x[1], x[0]))

    def vector(self, instance_id: int) -> NDArray[np.float32]:
        """The vector of an instance. Raises `OptionError` when it has none in this space."""
        at = np.flatnonzero(self.ids == instance_id)
        if len(at) == 0:
            raise OptionError(f"instance {instance_id} has no vector in the space {self.space}")
        return np.asarray(self.vectors[int(at[0])])
