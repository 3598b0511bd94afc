"""How far two instances are apart, and which way one lies from the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from list3r.queries.match import checked_instance
from list3r.queries.views.surfaces import distance_between


@dataclass(frozen=True)
class InstanceDistance:
    """Two instances of one frame of reference, lengths in world units."""

    a: int
    b: int
    gap: float
    """Between the nearest points of the two surfaces, 0 where they touch."""
    center_distance: float
    step: NDArray[np.float64]
    """From the centre of a to the centre of b, world. Shape (3,)."""
    sigma: float | None
    """Standard deviation of the distance from the uncertainty of the two places; None where it is not known."""

    @property
    def horizontal(self) -> float:
        """Between the centres as seen from above; z is up only where gravity is known."""
        return float(np.hypot(self.step[0], self.step[1]))

    @property
    def height_difference(self) -> float:
        """How much higher the centre of b lies than that of a; z is up only where gravity is known."""
        return float(self.step[2])


def measure(store: Store, a: int, b: int) -> InstanceDistance:
    """Return how far instance `b` is from instance `a`. Raises `UnknownIdError`, and `OptionError` for instances of
    components that are not placed against each other.
    """
    one, two = checked_instance(store, a), checked_instance(store, b)
    if one.component != two.component:
        raise OptionError(
            f"#{one.id} and #{two.id} lie in different connected components, so their distance is unknown"
        )
    step = two.center - one.center
    sigmas = one.position_sigma_m, two.position_sigma_m
    sigma = None if None in sigmas else float(np.linalg.norm([s for s in sigmas if s is not None]))
    gap = 0.0 if one.id == two.id else distance_between(store, one, two)
    return InstanceDistance(one.id, two.id, gap, float(np.linalg.norm(step)), step, sigma)
