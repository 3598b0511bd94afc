"""What looks like a thing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from list3r.memory.errors import OptionError
from list3r.memory.store import Store
from list3r.memory.vectors import VectorIndex
from list3r.queries.match import Filters, Match, checked_count


def similar(
    store: Store,
    *,
    instance_id: int | None = None,
    vector: ArrayLike | None = None,
    space: str | None = None,
    k: int = 5,
    min_confidence: float = 0.0,
    structure: bool = False,
    state: str | None = None,
) -> list[Match]:
    """The k things whose features are most like those of an instance, or like a `vector` of a named `space`.

    The score is the cosine. Raises `SpaceMismatchError` for vectors of another space, `OptionError` and
    `UnknownIdError` for arguments that make no sense.
    """
    k = checked_count(k)
    if (instance_id is None) == (vector is None):
        raise OptionError("give an instance or a vector to compare with, one of the two")
    if vector is not None and space is None:
        raise OptionError("a vector needs the name of its embedding space, model@revision/dim")
    filters = Filters(structure, min_confidence, state)
    origin = None if instance_id is None else store.instance(instance_id)
    index = VectorIndex.of(store, space)
    query = index.vector(origin.id) if origin is not None else vector
    allowed = {i.id: i for i in filters.select(store.instances()) if origin is None or i.id != origin.id}
    assert query is not None
    out = []
    for other, cosine in index.search(query, len(index.ids)):
        if other in allowed:
            i = allowed[other]
            away = None if origin is None else float(np.linalg.norm(i.center - origin.center))
            out.append(Match(i, round(cosine, 4), None, away, f"cosine {cosine:.3f} in {index.space}"))
    return out[:k]
