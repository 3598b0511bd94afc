"""Find instances that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from list3r.memory.core.errors import OptionError, SpaceMismatchError
from list3r.memory.core.records import Instance
from list3r.memory.store.search.vectors import VectorIndex, unit, unit_query
from list3r.memory.store.store import Store
from list3r.queries.match import FilterOptions, Filters, Match, checked_count, checked_instance, of_one_state

_BATCH = 500
"""Instances that are loaded at once."""


@of_one_state
def similar(
    store: Store,
    *,
    instance_id: int | None = None,
    vector: ArrayLike | None = None,
    space: str | None = None,
    part: int | None = None,
    k: int = 5,
    **options: Unpack[FilterOptions],
) -> list[Match]:
    """Find the k instances whose features are most like those of an instance, or like a `vector` of a named `space`.

    The score is the cosine; with `part` of the first so many numbers, which is all that `vector` then holds. Raises
    `SpaceMismatchError` for vectors of another space, `OptionError` and
    `UnknownIdError` for arguments that make no sense.
    """
    k = checked_count(k)
    if (instance_id is None) == (vector is None):
        raise OptionError("give either an instance or a vector to compare with")
    if vector is not None and space is None:
        raise OptionError("a vector needs the name of its embedding space, model@revision/dim")
    if part is not None and (vector is None or np.shape(vector) != (part,)):
        raise OptionError(f"part {part} needs a vector of {part} numbers")
    filters = Filters.of(store, options)
    origin = None if instance_id is None else checked_instance(store, instance_id)
    index = VectorIndex.of(store, space)
    query = index.vector(store, origin.id) if origin is not None else vector
    assert query is not None
    if part is not None:
        return _similar_in_part(store, index.space, query, part, k, filters)
    found: dict[int, Instance] = {}

    def passing(ids: Sequence[int]) -> set[int]:
        found.update((i.id, i) for i in store.instances.of([n for n in ids if n not in found]))
        return {n for n in ids if n in found and filters.passes(found[n]) and (origin is None or n != origin.id)}

    out = []
    for other, cosine in index.search(store, query, k, passing):
        away = None if origin is None else float(np.linalg.norm(found[other].center - origin.center))
        reason = f"cosine in {index.space}"
        out.append(Match(found[other], round(cosine, 4), None, away, reason))
    return out


def _similar_in_part(store: Store, space: str, vector: ArrayLike, part: int, k: int, filters: Filters) -> list[Match]:
    """Compare by the first `part` numbers of all vectors, of which there is no index."""
    query = unit_query(vector)
    ids, cosines = [], []
    for some, vectors in store.embeddings.batches(space):
        if vectors.shape[1] < part:
            raise SpaceMismatchError(f"part {part}: the space {space} has fewer numbers")
        ids.append(some)
        cosines.append(unit(vectors[:, :part]) @ query)
    order = np.lexsort((np.concatenate(ids), -np.concatenate(cosines))) if ids else np.zeros(0, np.int64)
    out: list[Match] = []
    for start in range(0, len(order), _BATCH):
        at = order[start : start + _BATCH]
        score = dict(zip(np.concatenate(ids)[at].tolist(), np.concatenate(cosines)[at].tolist(), strict=True))
        for i in filters.select(store.instances.of(list(score))):
            reason = f"cosine of colours alone, the first {part} numbers of {space}"
            out.append(Match(i, round(score[i.id], 4), None, None, reason))
        if len(out) >= k:
            break
    return out[:k]
