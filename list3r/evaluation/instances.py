"""How well the objects of a scene graph agree with the true ones, by their boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from list3r.evaluation.boxes import box_overlaps
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import JsonFields

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InstanceErrors(JsonFields):
    """Detection of objects at one threshold of box IoU."""

    iou: float
    """The threshold."""
    true_count: int
    estimated_count: int
    matched: int
    recall: float
    """Matched share of the true objects."""
    precision: float
    """Matched share of the estimated objects."""
    f_score: float
    mean_iou: float
    """Over the matched pairs, 0 without any."""
    mean_center_error_m: float
    """Distance of the centres of matched pairs, 0 without any."""
    duplicates: int
    """Estimated objects that are for the greater part in a true object that another one matched."""
    duplicates_per_object: float
    """Duplicates for each true object that was matched."""
    merged_pairs: int
    """Pairs of true objects that are mostly covered by one and the same estimated object."""
    matches: tuple[tuple[int, int, float], ...]
    """(row of the truth, row of the estimate, IoU)."""


def match_boxes(iou: Array, threshold: float) -> list[tuple[int, int]]:
    """Return one-to-one pairs (truth, estimate) with IoU at or above the threshold: most pairs first, then most IoU.

    `iou` has shape (T, E).
    """
    if iou.size == 0:
        return []
    gain = np.where(iou >= threshold, 1.0 + iou / (min(iou.shape) + 1.0), 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if iou[r, c] >= threshold]


def evaluate_instances(
    truth: Sequence[OrientedBox],
    estimate: Sequence[OrientedBox],
    iou_threshold: float = 0.25,
    is_round: Sequence[bool] = (),
) -> InstanceErrors:
    """Match upright boxes of one frame of reference one to one and count what is left over.

    An unmatched estimate is a duplicate when the true object of its best IoU is matched by another estimate and
    contains more than half of its volume. Two true objects are merged when one estimate covers more than half of each
    and not both are matched; pairs with one mostly inside the other's true box, as a ball in a bowl, do not count.
    `is_round` marks true objects without a yaw, see `box_overlaps`.
    """
    iou, inside = box_overlaps(truth, estimate, is_round)
    pairs = match_boxes(iou, iou_threshold)
    matched = len(pairs)
    duplicates = _count_duplicates(iou, inside, pairs)
    errors = [float(np.linalg.norm(truth[t].center - estimate[e].center)) for t, e in pairs]
    return InstanceErrors(
        iou=iou_threshold,
        true_count=len(truth),
        estimated_count=len(estimate),
        matched=matched,
        recall=matched / max(len(truth), 1),
        precision=matched / max(len(estimate), 1),
        f_score=2 * matched / max(len(truth) + len(estimate), 1),
        mean_iou=float(np.mean([iou[t, e] for t, e in pairs])) if pairs else 0.0,
        mean_center_error_m=float(np.mean(errors)) if pairs else 0.0,
        duplicates=duplicates,
        duplicates_per_object=duplicates / max(matched, 1),
        merged_pairs=_count_merged(truth, estimate, {t for t, _ in pairs}),
        matches=tuple((t, e, float(iou[t, e])) for t, e in pairs),
    )


def _count_duplicates(iou: Array, inside: Array, pairs: Sequence[tuple[int, int]]) -> int:
    if iou.shape[0] == 0:
        return 0
    found, used = {t for t, _ in pairs}, {e for _, e in pairs}
    best = iou.argmax(axis=0)
    return sum(e not in used and int(t) in found and bool(inside[t, e] > 0.5) for e, t in enumerate(best))


def _count_merged(truth: Sequence[OrientedBox], estimate: Sequence[OrientedBox], found: set[int]) -> int:
    covered = box_overlaps(estimate, truth)[1] > 0.5
    nested = box_overlaps(truth, truth)[1] > 0.5
    return sum(
        bool((covered[:, a] & covered[:, b]).any() and not nested[a, b] and not nested[b, a])
        for a in range(len(truth))
        for b in range(a)
        if not (a in found and b in found)
    )
