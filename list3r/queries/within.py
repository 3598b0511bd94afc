"""Find what lies in a region: a box, a sphere, or the frustum of a camera."""

from __future__ import annotations

import math
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from list3r.queries.match import FilterOptions, Filters, Match, checked_length, checked_point, of_one_state
from list3r.queries.seen import LEAST_VISIBLE, visible
from list3r.queries.views.camera import PosedCamera
from list3r.queries.views.surfaces import distance_to_point, surfaces_of


@of_one_state
def within(
    store: Store,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    center: ArrayLike | None = None,
    radius: float | None = None,
    camera: PosedCamera | None = None,
    max_depth: float | None = None,
    occlusion: bool = True,
    **options: Unpack[FilterOptions],
) -> list[Match]:
    """Find the instances of which some surface lies in a box (`lower`, `upper`), in a sphere (`center`, `radius`), both
    in the world, or in the frustum of a `camera`.

    In a box or sphere the score is the share of the thing's surface that lies inside, and distances are from the middle
    of the region; for a camera see `seen.visible`: with `occlusion` it leaves out what other things hide. The most
    inside come first. For the filters see `Filters`. Raises `OptionError` for a region that makes no sense.
    """
    filters = Filters.of(store, options)
    box, sphere = lower is not None or upper is not None, center is not None or radius is not None
    if box + sphere + (camera is not None) != 1:
        raise OptionError(
            "give one region: a box (lower and upper corner), a sphere (center and radius), or the view of a camera"
        )
    if camera is not None:
        least = LEAST_VISIBLE if occlusion else 0.0
        return visible(store, camera, min_visible=least, max_depth=max_depth, occlusion=occlusion, **options)
    if max_depth is not None:
        raise OptionError("a largest depth needs the view of a camera")
    low, high, middle, reach = _box(lower, upper) if box else _sphere(center, radius)
    ids, _ = store.instances.boxes_in_box(
        low, high, structure=filters.structure, min_confidence=filters.min_confidence, state=filters.stored_state
    )
    found = []
    things = filters.select(store.instances.of(sorted(ids.tolist())))
    for i, surface in zip(things, surfaces_of(store, things), strict=True):
        points = surface.points
        if reach is None:
            inside = np.all((points >= low) & (points <= high), axis=1)
        else:
            offset = points - middle
            inside = np.einsum("ij,ij->i", offset, offset) <= reach * reach
        share = np.count_nonzero(inside) / len(inside)
        if share > 0.0:
            away = math.dist(i.center, middle)
            reason = f"{'less than 1%' if share < 0.01 else f'{share:.0%}'} of its surface is inside"
            found.append(Match(i, round(share, 4), distance_to_point(store, i, middle), away, reason))
    return sorted(found, key=lambda m: (-m.score, m.center_distance_m or 0.0, m.instance.id))


_Region = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float | None]
"""Lower and upper corner, middle, and the radius of a sphere."""


def _box(lower: ArrayLike | None, upper: ArrayLike | None) -> _Region:
    if lower is None or upper is None:
        raise OptionError("a box needs both its lower and its upper corner")
    low, high = checked_point(lower, "lower corner"), checked_point(upper, "upper corner")
    if (low > high).any():
        raise OptionError(f"the lower corner {low.tolist()} must not lie beyond the upper corner {high.tolist()}")
    return low, high, low / 2 + high / 2, None


def _sphere(center: ArrayLike | None, radius: float | None) -> _Region:
    if center is None or radius is None:
        raise OptionError("a sphere needs both its center and its radius")
    middle, reach = checked_point(center, "center"), checked_length(radius, "radius")
    return middle - reach, middle + reach, middle, reach
