"""Colours of a plan: few, distinct for colour-blind people, and different between neighbours."""

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
_TOGETHER = 512
"""So many places are compared with each other directly, and with those before them through one tree."""


def plan_colors(centers: Mapping[int, NDArray[np.float64]]) -> dict[int, Color]:
    """Return a colour for each id: one that the nearest ones coloured before lack, else the one that is farthest away.

    `centers` are places on the page. The same places have the same colours.
    """
    ids = sorted(centers)
    if not ids:
        return {}
    near = nearest_before(np.array([centers[n] for n in ids], dtype=np.float64), _NEIGHBOURS)
    chosen: list[int] = []
    for k, instance_id in enumerate(ids):
        used = {chosen[n] for n in near[k]}
        wish = [(instance_id + step) % len(PALETTE) for step in range(len(PALETTE))]
        chosen.append(next(c for c in wish if c not in used))
    return {n: PALETTE[c] for n, c in zip(ids, chosen, strict=True)}


def nearest_before(xy: NDArray[np.float64], count: int) -> list[list[int]]:
    """Return for each place (N, 2) which of those before it are nearest, at most `count`, in time near to linear."""
    from scipy.spatial import cKDTree

    out: list[list[int]] = []
    for start in range(0, len(xy), _TOGETHER):
        block = xy[start : start + _TOGETHER]
        known = np.zeros((len(block), 0), np.int64)
        if start:
            known = np.asarray(cKDTree(xy[:start]).query(block, k=list(range(1, min(count, start) + 1)))[1])
        for k in range(len(block)):
            among = np.concatenate([known[k], np.arange(start, start + k)])
            away = np.linalg.norm(xy[among] - block[k], axis=1)
            out.append(among[np.argsort(away, kind="stable")[:count]].tolist())
    return out
