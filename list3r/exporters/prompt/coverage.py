"""The fewest pictures that together show every instance."""

from __future__ import annotations

from collections.abc import Mapping, Set

import numpy as np

_EXACT = 400
"""With more pictures than this, dominated ones left out, the greedy choice is kept."""
_NODES = 2000
"""Nodes of the branch and bound at most, so that the same pictures are chosen everywhere."""


def cover(shows: Mapping[int, Set[int]]) -> list[int]:
    """Return keys of a minimum set cover of `shows`. // Pictures dominated by another one are left out; an integer
    program takes the fewest of the rest, or for too many a greedy choice without its redundant ones.
    """
    kept = _undominated(shows)
    if not kept:
        return []
    greedy = _without_spare(_greedy(kept), kept)
    if len(kept) > _EXACT or len(greedy) == 1:
        return sorted(greedy)
    fewest = _fewest(kept)
    return sorted(greedy if fewest is None or len(fewest) > len(greedy) else fewest)


def _undominated(shows: Mapping[int, Set[int]]) -> dict[int, Set[int]]:
    kept: dict[int, Set[int]] = {}
    for key in sorted(shows, key=lambda k: (-len(shows[k]), k)):
        if shows[key] and not any(shows[key] <= other for other in kept.values()):
            kept[key] = shows[key]
    return kept


def _greedy(shows: Mapping[int, Set[int]]) -> list[int]:
    left = set[int]().union(*shows.values())
    chosen = []
    while left:
        best = max(shows, key=lambda k: (len(shows[k] & left), -k))
        chosen.append(best)
        left -= shows[best]
    return chosen


def _without_spare(chosen: list[int], shows: Mapping[int, Set[int]]) -> list[int]:
    """Return the choice without redundant pictures, the last chosen tested first."""
    out = list(chosen)
    for key in reversed(chosen):
        others = set[int]().union(*(shows[k] for k in out if k != key))
        if shows[key] <= others:
            out.remove(key)
    return out


def _fewest(shows: Mapping[int, Set[int]]) -> list[int] | None:
    """Return the least cover by an integer program; None where the search ended before it was found."""
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_array

    keys = sorted(shows)
    row_of = {n: row for row, n in enumerate(sorted(set[int]().union(*shows.values())))}
    pairs = [(row_of[n], column) for column, k in enumerate(keys) for n in shows[k]]
    rows, columns = np.array(pairs).T
    holds = csr_array((np.ones(len(pairs)), (rows, columns)), shape=(len(row_of), len(keys)))
    found = milp(
        np.ones(len(keys)),
        constraints=LinearConstraint(holds, lb=1.0),
        bounds=Bounds(0.0, 1.0),
        integrality=np.ones(len(keys), np.int64),
        options={"node_limit": _NODES},
    )
    if found.x is None:
        return None
    chosen = [k for k, taken in zip(keys, found.x, strict=True) if taken > 0.5]
    return chosen if set[int]().union(*(shows[k] for k in chosen)) == set(row_of) else None
