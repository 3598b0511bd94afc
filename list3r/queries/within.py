"""What lies in a region."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from list3r.memory.errors import OptionError
from list3r.memory.store import Store
from list3r.queries.match import Filters, Match, checked_length, checked_point
from list3r.queries.surfaces import distance_to_point, surface_tree


def within(
    store: Store,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    center: ArrayLike | None = None,
    radius: float | None = None,
    min_confidence: float = 0.0,
    structure: bool = False,
    state: str | None = None,
) -> list[Match]:
    """The things of which some surface lies in a box (`lower`, `upper`) or a sphere (`center`, `radius`); world.

    The score is the share of the thing's surface that lies inside; the most inside come first. Distances are from the
    middle of the region. Raises `OptionError` for a region that makes no sense.
    """
    filters = Filters(structure, min_confidence, state)
    box, sphere = lower is not None or upper is not None, center is not None or radius is not None
    if box == sphere:
        raise OptionError("give one region: a box (lower and upper corner) or a sphere (center and radius)")
    if box:
        if lower is None or upper is None:
            raise OptionError("a box needs both its lower and its upper corner")
        low, high = checked_point(lower, "lower corner"), checked_point(upper, "upper corner")
        if (low > high).any():
            raise OptionError(f"the lower corner {low.tolist()} must not lie beyond the upper corner {high.tolist()}")
        middle, reach = (low + high) / 2, None
    else:
        if center is None or radius is None:
            raise OptionError("a sphere needs both its center and its radius")
        middle, reach = checked_point(center, "center"), checked_length(radius, "radius")
        low, high = middle - reach, middle + reach
    near = set(store.ids_in_box(low, high))
    found = []
    for i in filters.select(store.instances()):
        if i.id not in near:
            continue
        points = np.asarray(surface_tree(store, i).data)
        if reach is None:
            inside = np.all((points >= low) & (points <= high), axis=1)
        else:
            inside = np.linalg.norm(points - middle, axis=1) <= reach
        share = float(inside.mean())
        if share > 0.0:
            away = float(np.linalg.norm(i.center - middle))
            reason = f"{share:.0%} of its surface is inside"
            found.append(Match(i, round(share, 4), distance_to_point(store, i, middle), away, reason))
    return sorted(found, key=lambda m: (-m.score, m.center_distance_m or 0.0, m.instance.id))
