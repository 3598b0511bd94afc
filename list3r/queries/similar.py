"""What looks like a thing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from list3r.memory.errors import OptionError
from list3r.memory.records import Instance
from list3r.memory.store import Store
from list3r.memory.vectors import VectorIndex
from list3r.queries.match import FilterOptions, Filters, Match, checked_count, checked_instance


def similar(
    store: Store,
    *,
    instance_id: int | None = None,
    vector: ArrayLike | None = None,
    space: str | None = None,
    k: int = 5,
    **options: Unpack[FilterOptions],
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
    filters = Filters(**options)
    origin = None if instance_id is None else checked_instance(store, instance_id)
    index = VectorIndex.of(store, space)
    query = index.vector(store, origin.id) if origin is not None else vector
    assert query is not None
    found: dict[int, Instance] = {}

    def passing(ids: Sequence[int]) -> set[int]:
        found.update((i.id, i) for i in store.instances_of([n for n in ids if n not in found]))
        return {n for n in ids if n in found and filters.passes(found[n]) and (origin is None or n != origin.id)}

    out = []
    for other, cosine in index.search(store, query, k, passing):
        away = None if origin is None else float(np.linalg.norm(found[other].center - origin.center))
        reason = f"cosine {cosine:.3f} in {index.space}"
        out.append(Match(found[other], round(cosine, 4), None, away, reason))
    return out
