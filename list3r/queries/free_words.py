"""Free words against the vectors that things have in a text and image model's space."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.memory.store import Store


class WordEncoder(Protocol):
    """A model whose vectors of text and of pictures can be compared, such as CLIP or SigLIP."""

    @property
    def space(self) -> str:
        """The embedding space of the memory that it belongs to, `model@revision/dim`."""
        ...

    @property
    def min_cosine(self) -> float:
        """From here a thing is said to be what a text says."""
        ...

    def encode(self, text: str) -> NDArray[np.float32]:
        """The unit vector of a text. Shape (D,)."""
        ...


def named_by_vectors(store: Store, encoder: WordEncoder, words: str) -> dict[int, float]:
    """Cosine of every thing that a text may name, by id; none where the memory has no vectors of the space."""
    if encoder.space not in store.embedding_spaces():
        return {}
    ids, vectors = store.embeddings(encoder.space)
    if not len(ids):
        return {}
    cosine = vectors.astype(np.float64) @ np.asarray(encoder.encode(words), np.float64)
    fits = cosine >= encoder.min_cosine
    return dict(zip(ids[fits].tolist(), cosine[fits].tolist(), strict=True))
