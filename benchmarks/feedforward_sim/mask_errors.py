"""Errors of discovery in unseen homes: objects missed, split, exchanged, and fragments of walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class MaskErrorSettings:
    """Shares of objects; none by default."""

    missed: float = 0.0
    """Missed whatever their size."""
    split: float = 0.0
    """Tracks that come as two, parted by a plane."""
    swapped: float = 0.0
    """Tracks that go over to something they touch."""
    fragments: float = 0.0
    """Pieces of walls and floors taken for objects, for each track of an object."""
    fragment_radius: float = 0.12
    """Of such a piece, as a share of the spread of the chunk's points."""

    def any(self) -> bool:
        """Return whether tracks of objects are changed at all."""
        return self.split > 0 or self.swapped > 0


def exchanged(
    ids: NDArray[np.int32], masks: Bools, structure: set[int], settings: MaskErrorSettings, rng: np.random.Generator
) -> Bools:
    """Return the masks of a track (V, H, W) that may go over to a neighbour at some frame."""
    if rng.random() >= settings.swapped or len(masks) < 4:
        return masks
    start = int(rng.integers(1, len(masks) - 1))
    left, right, inside = ids[start][:, :-1], ids[start][:, 1:], masks[start]
    around = np.concatenate([right[inside[:, :-1]], left[inside[:, 1:]]])
    own = set(ids[start][inside].tolist())
    others = [k for k in around.tolist() if k > 0 and k not in own and k not in structure]
    if not others:
        return masks
    out = masks.copy()
    out[start:] = ids[start:] == max(set(others), key=others.count)
    return out


def parted(masks: Bools, points: Floats, settings: MaskErrorSettings, rng: np.random.Generator) -> list[Bools]:
    """Return the masks of a track as one or as two on either side of a plane. `points` (V, H, W, 3)."""
    if rng.random() >= settings.split or not masks.any():
        return [masks]
    normal = rng.standard_normal(3)
    height = points @ normal.astype(np.float32)
    side = height > np.quantile(height[masks], rng.uniform(0.3, 0.7))
    return [masks & side, masks & ~side]


def fragments(
    ids: NDArray[np.int32],
    points: Floats,
    structure: set[int],
    count: int,
    settings: MaskErrorSettings,
    rng: np.random.Generator,
) -> list[tuple[NDArray[np.int64], Bools]]:
    """Return positions (V,) and masks (V, H, W) of pieces of structure around one of its points."""
    bare = np.isin(ids, sorted(structure))
    where = np.argwhere(bare)
    if not len(where):
        return []
    spread = float(np.linalg.norm(points[bare][::97].std(axis=0)))
    out = []
    for _ in range(count):
        f, y, x = where[rng.integers(len(where))]
        near = np.linalg.norm(points - points[f, y, x], axis=-1) < settings.fragment_radius * spread
        masks = near & (ids == ids[f, y, x])
        positions = np.flatnonzero(masks.sum(axis=(1, 2)) >= 5)
        if len(positions) >= 4:
            out.append((positions, masks[positions]))
    return out
