"""Boxes of a detector vote for what things are called, over many frames.

A box is a vote for the thing whose mask in that frame fills it best. Its score, calibrated by how well the two fit, is
the probability of the class; a frame that sees the thing well and finds nothing of a class is a vote against it.
Log odds add up over frames, so they can be kept for each local instance and added again however local instances are
grouped later; that pictures of one thing are alike is accounted for there (`memory.labels`).

Boxes count from a score of 0.1: a chair that is found with 0.2 to 0.35 in each of eight pictures is a chair, and a
threshold of 0.3, which suits single pictures, left it to chance (redkitchen: 3 or 4 of 5 chairs and up to two false
names by the threshold, 5 and one without, for both networks). Adding up low scores as if each picture were
independent is worse: every leaflet becomes a bottle or a TV (up to 20 false names).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.coco import plausible
from list3r.memory.core.records import Votes
from list3r.memory.library.labels import PRIOR_ODDS
from list3r.memory.library.overlap.pair_scores import box_iou
from list3r.semantics.detector import Detections


@dataclass(frozen=True)
class VotingSettings:
    """When a box is a vote for a thing."""

    min_overlap: float = 0.3
    """Least IoU of a box and the box around a mask."""
    full_overlap: float = 0.6
    """IoU from which they fit as well as two boxes of one thing do."""
    min_inside: float = 0.7
    """Least share of a mask within the box."""
    min_side_px: float = 14.0
    """Things smaller than this in the picture are not looked at (of a picture 640 px wide)."""
    min_visible: float = 0.4
    """Nor are those of which less is seen."""
    border_px: float = 3.0
    """A thing that the border cuts is looked at with half the weight."""
    recall: float = 0.8
    """Share of the frames in which a detector has a box, however unsure, for a thing of a class that it knows."""
    box_quality: float = 0.75
    """IoU of a right box with the truth. Scores of such networks are the probability of the class times this."""
    independent_s: float = 0.4
    """Pictures nearer in time than this show the same view with the same mistakes and share one vote."""


@dataclass(frozen=True)
class ThingInFrame:
    """A thing in one frame, by its local instances."""

    locals: tuple[int, ...]
    """Local ids of the frame's chunk."""
    shares: tuple[float, ...]
    """Of the thing's pixels, which share each of them has."""
    box_xyxy: NDArray[np.float32]
    """Around its mask, px, upper bounds exclusive. Shape (4,)."""
    mask: NDArray[np.bool_]
    """Shape (H, W)."""
    visible: float
    """Share of it that nothing hides, in [0, 1]."""
    size_m: NDArray[np.float64] | None = None
    """Edges of its box, the third one upright, metres; None where nobody knows. Shape (3,)."""


def vote(
    detections: Detections,
    names: Sequence[str],
    things: Sequence[ThingInFrame],
    gap_s: float = np.inf,
    settings: VotingSettings | None = None,
    region_xyxy: NDArray[np.float32] | None = None,
) -> dict[int, Votes]:
    """What one frame, `gap_s` after the one before, says of the things that it shows: votes by local id.

    `region_xyxy` is where masks can be: depth cameras often see less than colour cameras, and boxes are cut to it.
    """
    s = settings or VotingSettings()
    boxes = detections.boxes_xyxy
    if region_xyxy is not None:
        boxes = np.clip(boxes, np.tile(region_xyxy[:2], 2), np.tile(region_xyxy[2:], 2))
    apart = min(1.0, gap_s / s.independent_s)
    weights = [apart * _weight(t, s) for t in things]
    looked = [k for k, w in enumerate(weights) if w > 0]
    best: dict[tuple[int, str], float] = {}
    for box, score, number in zip(boxes, detections.scores, detections.classes, strict=True):
        name = names[int(number)]
        fits = [(fit, -k) for k in looked if _can_be(name, things[k]) and (fit := _fit(box, things[k], s)) > 0]
        if fits:
            fit, k = max(fits)
            key = (-k, name)
            best[key] = max(best.get(key, 0.0), float(score) * fit)
    out: dict[int, Votes] = {}
    miss = -math.log(1.0 - s.recall)
    for k in looked:
        found = {name: _odds(p, s) + miss for (n, name), p in best.items() if n == k}
        for local_id, share in zip(things[k].locals, things[k].shares, strict=True):
            w = weights[k] * share
            votes = Votes(w * miss, {c: (w, w * odds) for c, odds in sorted(found.items())}, w)
            out[local_id] = out[local_id] + votes if local_id in out else votes
    return out


def summed(votes: Iterable[Mapping[int, Votes]]) -> dict[int, Votes]:
    """The votes of several frames together, by local id."""
    out: dict[int, Votes] = {}
    for frame in votes:
        for local_id, v in frame.items():
            out[local_id] = out[local_id] + v if local_id in out else v
    return dict(sorted(out.items()))


def _weight(thing: ThingInFrame, s: VotingSettings) -> float:
    """How much the frame can say of the thing: 0 where it is too small or hidden."""
    height, width = thing.mask.shape
    x0, y0, x1, y1 = (float(v) for v in thing.box_xyxy)
    small = min(x1 - x0, y1 - y0) < s.min_side_px * max(height, width) / 640.0
    if small or thing.visible < s.min_visible:
        return 0.0
    b = s.border_px
    cut = x0 <= b or y0 <= b or x1 >= width - b or y1 >= height - b
    return thing.visible * (0.5 if cut else 1.0)


def _can_be(name: str, thing: ThingInFrame) -> bool:
    return thing.size_m is None or plausible(name, thing.size_m)


def _fit(box: NDArray[np.float32], thing: ThingInFrame, s: VotingSettings) -> float:
    """How well a box and a thing fit, in [0, 1]; 0 for not at all."""
    overlap = float(box_iou(box[None].astype(np.float64), thing.box_xyxy[None].astype(np.float64))[0, 0])
    if overlap < s.min_overlap:
        return 0.0
    x0, y0, x1, y1 = (max(0, round(v)) for v in box.tolist())
    inside = float(thing.mask[y0:y1, x0:x1].sum()) / max(float(thing.mask.sum()), 1.0)
    return min(1.0, overlap / s.full_overlap) * inside if inside >= s.min_inside else 0.0


def _odds(probability: float, s: VotingSettings) -> float:
    """Log odds by which a box of this score, times how well it fits, supports its class."""
    p = min(max(probability / s.box_quality, 1e-3), 0.95)
    return math.log(p / (1.0 - p)) - PRIOR_ODDS
