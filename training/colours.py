"""Rooms in fewer colours than the catalogue gives them: homes are white on white, cameras are grey, lamps are dim."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from training.samples import Sample

Float = NDArray[np.float32]

MOST_PAINTS = 4
"""Mean colours that the things of a room in few paints share."""
LEFT = 0.6
"""Largest share of its contrast that a dull room keeps."""
OTHER_SHADE = 3.0
"""Deviation of a thing's brightness from its paint's, of 255."""


def in_few_colours(sample: Sample) -> Sample:
    """Return the same views as a grey camera would show them, dull, or with few paints for all things.

    The seed decides which. Depth and truth stay as they are.
    """
    rng = np.random.default_rng([sample.seed, 29])
    shown = [v.rgb.astype(np.float32) for v in sample.views]
    way = rng.choice(["grey", "dull", "grey and dull", "paints"], p=[0.15, 0.2, 0.15, 0.5])
    if way == "paints":
        shown = _in_paints(shown, sample.ids, rng)
    if "grey" in way:
        shown = [np.repeat(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2) for p in shown]
    if "dull" in way:
        shown = _dull(shown, float(rng.uniform(0.0, LEFT)))
    views = [
        replace(v, rgb=np.clip(p + 0.5, 0, 255).astype(np.uint8)) for v, p in zip(sample.views, shown, strict=True)
    ]
    return replace(sample, views=tuple(views))


def _dull(shown: list[Float], left: float) -> list[Float]:
    """Pictures (h, w, 3) of which only a share of the contrast is left."""
    mean = np.mean([p.mean(axis=(0, 1)) for p in shown], axis=0)
    return [np.asarray(mean + left * (p - mean), np.float32) for p in shown]


def _in_paints(shown: list[Float], ids: tuple[NDArray[np.int32], ...], rng: np.random.Generator) -> list[Float]:
    """Pictures (h, w, 3) in which the mean colour of each thing is one of few; what is on it and shadows stay."""
    colour, thing = np.concatenate([p.reshape(-1, 3) for p in shown]), np.concatenate([i.ravel() for i in ids])
    count = np.bincount(thing)
    mean = np.stack([np.bincount(thing, colour[:, k]) for k in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    paints = mean[rng.choice(np.flatnonzero(count), int(rng.integers(1, MOST_PAINTS + 1)))]
    painted = paints[rng.integers(len(paints), size=len(mean))] + rng.normal(0.0, OTHER_SHADE, (len(mean), 1))
    return [np.asarray(p + (painted - mean)[i], np.float32) for p, i in zip(shown, ids, strict=True)]
