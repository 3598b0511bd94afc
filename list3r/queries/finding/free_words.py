"""Compare free text with the vectors of instances in the space of a text and image model."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.memory.store.store import Store


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
        """Return the unit vector of a text. Shape (D,)."""
        ...


def named_by_vectors(store: Store, encoder: WordEncoder, words: str) -> dict[int, float] | None:
    """Return the cosine of every thing that a text may name, by id, the ids ascending; None where the memory has no
    vectors of the encoder's space. Raises `OptionError` where the encoder's weights are not there.
    """
    if encoder.space not in store.embeddings.spaces():
        return None
    query = np.asarray(encoder.encode(words), np.float64)
    ids, vectors = store.embeddings.all(encoder.space)
    lengths = np.linalg.norm(vectors, axis=1) * np.linalg.norm(query)
    cosine = vectors @ query / np.maximum(lengths, 1e-12)
    fits = cosine >= encoder.min_cosine
    return dict(zip(ids[fits].tolist(), cosine[fits].tolist(), strict=True))


def like(words: str, cosine: float, space: str) -> str:
    """Say why a thing that the words do not name is an answer all the same."""
    return f"like {words!r}: cosine {cosine:.2f} in {space}"
