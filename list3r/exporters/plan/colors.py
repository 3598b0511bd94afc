"""Colours of a plan: few, told apart by people who see colours otherwise, and different between neighbours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.palette import Color

PALETTE: tuple[Color, ...] = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (230, 159, 0),
    (120, 94, 240),
    (140, 90, 40),
)
"""After Okabe and Ito (2008), without black and yellow, which paper and ink take."""
_NEIGHBOURS = 6


def plan_colors(centers: Mapping[int, NDArray[np.float64]]) -> dict[int, Color]:
    """Return a colour for each id: one that the nearest ones coloured before lack, else the one that is farthest away.

    `centers` are places on the page. The same places have the same colours.
    """
    ids = sorted(centers)
    if not ids:
        return {}
    xy = np.array([centers[n] for n in ids], dtype=np.float64)
    chosen: list[int] = []
    for k, instance_id in enumerate(ids):
        away = np.linalg.norm(xy[:k] - xy[k], axis=1)
        near = np.argsort(away, kind="stable")
        used = {chosen[n] for n in near[:_NEIGHBOURS].tolist()}
        wish = [(instance_id + step) % len(PALETTE) for step in range(len(PALETTE))]
        chosen.append(next(c for c in wish if c not in used))
    return {n: PALETTE[c] for n, c in zip(ids, chosen, strict=True)}
