"""The local instance library of a chunk (paper 3.1): anchors, discovery, prompt selection, tracking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from list3r.frames.base import Frame
from list3r.instances.base import Discoverer, Proposals, Tracker
from list3r.instances.geometric.views import chunk_views, forget_views
from list3r.instances.learned.discovery import LearnedDiscoverer
from list3r.instances.settings import InstanceSettings
from list3r.instances.tracking.low_confidence import low_confidence_instances
from list3r.instances.tracking.movers import with_movers
from list3r.instances.tracking.reprojection import ReprojectionTracker
from list3r.memory.core.records import LocalLibrary
from list3r.reconstruction.base import Reconstruction

_OF_EACH = ("score", "features", "plane", "identity", "structure", "names", "whole", "named")
"""Fields of `Proposals` that hold something of each candidate."""

__all__ = ["InstanceSettings", "build_library", "select_prompts"]


def build_library(
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    settings: InstanceSettings | None = None,
    discoverer: Discoverer | None = None,
    tracker: Tracker | None = None,
) -> LocalLibrary:
    """Find the objects of a chunk and follow them through it.

    `frames` are the chunk's frames in the order of the reconstruction. The default discoverer and tracker need no
    downloaded weights. Moving objects of the reconstruction are added as `dynamic` instances; discovery does not see
    them, as the reconstruction has no depth there.
    """
    settings = settings or InstanceSettings()
    discoverer = discoverer or LearnedDiscoverer(settings)
    tracker = tracker or ReprojectionTracker(settings)
    try:
        views = chunk_views(frames, reconstruction, settings)
        proposals = [discoverer(frames, reconstruction, position) for position in views.anchors]
        prompts = [select_prompts(p, settings) for p in proposals]
        library = tracker(frames, reconstruction, prompts, discoverer.feature_space)
        library = with_movers(library, frames, reconstruction, settings.movers)
        unsure = [p.low_confidence for p in proposals if p.low_confidence is not None]
        return replace(library, scraps=low_confidence_instances(views, unsure, settings, len(library.instances)))
    finally:
        forget_views()


def select_prompts(proposals: Proposals, settings: InstanceSettings) -> Proposals:
    """The candidates worth following: sure enough and large enough in the anchor."""
    area = np.bincount(proposals.labels.ravel(), minlength=len(proposals.score) + 1)[1:]
    least = settings.track.min_area_px * proposals.labels.size / (640 * 480)
    keep = np.flatnonzero((proposals.score >= settings.min_score) & (area >= least))
    renumber = np.zeros(len(proposals.score) + 1, np.int32)
    renumber[keep + 1] = np.arange(1, len(keep) + 1)
    of_each = {n: value for n in _OF_EACH if (value := getattr(proposals, n)) is not None}
    rows = keep.tolist()
    kept: dict[str, Any] = {
        n: v[keep] if isinstance(v, np.ndarray) else tuple(v[k] for k in rows) for n, v in of_each.items()
    }
    return replace(proposals, labels=renumber[proposals.labels], **kept)
