"""Which of the instances that are missing where they were are found elsewhere: decided for all of them together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from list3r.memory.core.constraints import Constraints
from list3r.memory.core.geometry import Array
from list3r.memory.library.change.places import GroupLooks, Places
from list3r.memory.library.change.records import ChangeSettings
from list3r.memory.library.change.surface_colors import hue_distance, palette_distance
from list3r.memory.library.overlap.visibility import PlaceVisibility

_NEVER = 1e6


@dataclass
class PlacedInstance:
    """One instance and the places it had: groups by overlap, of which one is where it is now."""

    places: list[int]
    now: int
    state: str = "present"


@dataclass(frozen=True)
class Missing:
    """An instance that a session did not find where it was."""

    placed: PlacedInstance
    gone: PlaceVisibility | None = None
    """What the session's frames see there, where that tells that it is gone; None where an earlier session told that,
    or where they tell nothing."""

    @property
    def hidden(self) -> bool:
        """Whether nothing tells that it is gone."""
        return self.gone is None and self.placed.state != "removed"


@dataclass(frozen=True)
class Move:
    """An instance that is missing from one place and found at another."""

    missing: Missing
    place: int
    deviations: float
    """Sum of squared deviations between what is missing and what is found."""
    chance: float
    """Of being the same instance rather than one of the other candidates or none, in [0, 1]."""

    @property
    def placed(self) -> PlacedInstance:
        """The instance."""
        return self.missing.placed


class MoveSearch:
    """Compares what is missing with what is new by looks and size."""

    def __init__(self, places: Places, constraints: Constraints, settings: ChangeSettings) -> None:
        self._p, self._constraints, self._s = places, constraints, settings

    def moves(
        self,
        missing: Sequence[Missing],
        fresh: Sequence[int],
        came: Collection[int],
        stayed: Collection[int],
        session: int,
    ) -> list[Move]:
        """Return pairs of what is missing and what is new, one to one, of least difference in all.

        Only what is known to have come (`came`) may be what the session did not find gone. Of what has `stayed` the
        whole surface tells, see `Places.looks`.
        """
        from scipy.optimize import linear_sum_assignment

        missing = [m for m in missing if any(self._may_be(m, n, came, session) for n in fresh)]
        if not missing or not fresh:
            return []
        p, s = self._p, self._s
        cost = np.full((len(missing), len(fresh)), _NEVER)
        against = [-2.0 * float(np.log(s.left_unseen)) if m.hidden else 0.0 for m in missing]
        new = [p.looks(n, session, before=False, stayed=n in stayed) for n in fresh]
        for i, m in enumerate(missing):
            old = p.looks(m.placed.now, session, before=True, stayed=m.placed.now in stayed)
            for j, n in enumerate(fresh):
                if self._may_be(m, n, came, session):
                    found = difference(old, new[j], s, p.unit) + against[i]
                    cost[i, j] = found if found <= s.most_deviations else _NEVER
        # For every instance that is missing there is one more column: that it was not found, at the price of the limit.
        rest = np.full((len(missing), len(missing)), _NEVER)
        np.fill_diagonal(rest, s.most_deviations)
        rows, columns = linear_sum_assignment(np.hstack([cost, rest]))
        return [
            Move(missing[i], fresh[j], float(cost[i, j]) - against[i], _chance(cost, i, j, s.most_deviations))
            for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
            if j < len(fresh) and cost[i, j] < _NEVER
        ]

    def _may_be(self, missing: Missing, n: int, came: Collection[int], session: int) -> bool:
        """Return whether something new can be what is missing: no session saw both, no edit tells them apart, and,
        where nothing tells that it is gone, frames came near.
        """
        p, placed = self._p, missing.placed
        if p.component[n] != p.component[placed.now] or (missing.gone is None and n not in came):
            return False
        if missing.hidden and (p.plainly_other(placed.now, n) or p.out_of_sight(placed.now, session)):
            return False
        if any(not set(p.sessions[n]).isdisjoint(p.sessions[m]) for m in placed.places):
            return False
        return not self._constraints.forbids([k for m in placed.places for k in p.groups[m]], list(p.groups[n]))


def difference(a: GroupLooks, b: GroupLooks, s: ChangeSettings, unit: float = 1.0) -> float:
    """Return the sum of squared deviations between two looks; infinite for two that cannot be one instance."""
    deviation = np.array(s.side_share) * (a.extent + b.extent) / 2 + np.array(s.side_m) * unit
    sides = (a.extent - b.extent) / deviation
    off = sides[np.abs(sides) > s.side_longer]
    if len(off) and (off > 0).all() != (off > 0).any():  # neither is a part of the other
        return float("inf")
    sides = np.minimum(sides**2, s.side_most)
    color = (palette_distance(a.palette, b.palette) / s.palette) ** 2 + hue_distance(a.palette, b.palette) / s.hues
    total = float(sides.sum()) + color
    return total if total <= s.most_deviations else float("inf")


def _chance(cost: Array, i: int, j: int, none: float) -> float:
    """Return how likely a pair is, beside the other candidates of either and that there is none, by their
    deviations.
    """
    others = np.concatenate([np.delete(cost[i], j), np.delete(cost[:, j], i), [none]])
    odds = float(np.exp(-0.5 * (others - cost[i, j])).sum())
    return round(1.0 / (1.0 + odds), 3)
