"""Whether objects keep their ids over time: masks of every frame against the true ids of its pixels."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import JsonFields

Labels = NDArray[np.integer[Any]]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class IdentityErrors(JsonFields):
    """Estimated ids of true objects over time."""

    frames: int
    """Compared frames."""
    objects: int
    """True objects that some mask covered in some frame."""
    switches: int
    """Times that an object's id is another one than when it was covered last (CLEAR MOT's mismatches)."""
    several_ids: dict[int, tuple[int, ...]]
    """Objects that had more than one id, with the ids in the order in which they came."""


def evaluate_identities(
    frames: Iterable[tuple[Labels, Sequence[tuple[int, Mask]]]],
    wanted: Collection[int] | None = None,
    least_iou: float = 0.5,
) -> IdentityErrors:
    """Follow the ids of true objects.

    Each frame is the true ids of its pixels (H, W), 0 for nothing, and the estimated masks (H, W) with their ids. An
    object has an id when that mask's IoU with its pixels is `least_iou` or more; its last id has priority. `wanted` are
    the counted true ids, None for all. Raises `OptionError` for masks of another size.
    """
    ids_of: dict[int, list[int]] = {}
    count = switches = 0
    for labels, masks in frames:
        count += 1
        for true_id, ids in _covered(labels, masks, least_iou).items():
            if wanted is not None and true_id not in wanted:
                continue
            history = ids_of.setdefault(true_id, [])
            if history and history[-1] in ids:
                continue
            switches += bool(history)
            history.append(ids[0])
    several = {k: tuple(dict.fromkeys(h)) for k, h in sorted(ids_of.items()) if len(set(h)) > 1}
    return IdentityErrors(count, len(ids_of), switches, several)


def _covered(labels: Labels, masks: Sequence[tuple[int, Mask]], least_iou: float) -> dict[int, list[int]]:
    """Return the estimated ids that cover each true object well enough, the best first."""
    if labels.size == 0:
        return {}
    areas = np.bincount(labels.ravel())
    found: dict[int, list[tuple[float, int]]] = {}
    for estimated, mask in masks:
        if mask.shape != labels.shape:
            raise OptionError(f"masks of shape {mask.shape} for true ids of shape {labels.shape}; expected one size")
        shared = np.bincount(labels[mask], minlength=len(areas))
        iou = shared / np.maximum(areas + mask.sum() - shared, 1)
        for k in np.flatnonzero(iou >= least_iou).tolist():
            if k > 0:
                found.setdefault(k, []).append((-float(iou[k]), estimated))
    return {k: [e for _, e in sorted(rows)] for k, rows in found.items()}
