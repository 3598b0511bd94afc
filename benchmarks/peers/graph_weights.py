"""Weights of edges as the paper (A.4) and VGGT-Long choose them, for rows of `benchmarks/association.py`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.edge_information import WeightSettings, information_of, lever_of
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PaperWeightSettings(WeightSettings):
    """Information is multiplied by the paper's weight of confidence."""

    alpha: float = 0.30
    """The paper's alpha."""
    sharpness: float = 6.0
    """The paper's exponent g."""


@dataclass(frozen=True)
class PlainWeightSettings(WeightSettings):
    """All edges count the same: plain least squares, as VGGT-Long."""


@contextmanager
def peer_weights() -> Iterator[None]:
    """Let graphs with these settings be weighted by them, and all others as they are."""
    with ExitStack() as stack:
        for module in ("pose_graph", "incremental", "node_graph"):
            stack.enter_context(patch(f"list3r.association.graph.{module}.information_of", _information))
        yield


def edge_weights(confidence: Array, settings: PaperWeightSettings) -> Array:
    """Return weights of edges from their confidence m (paper A.4), the strongest edge 1. Shape (E,).

    With the paper's constants all raw weights are below 3.3e-4, so only their ratios mean something.
    """
    grown = np.log1p(settings.alpha * np.clip(confidence, 0.0, 1.0))
    u = grown / (1.0 + grown)
    raw = u**settings.sharpness / (u**settings.sharpness + (1.0 - u) ** settings.sharpness)
    return np.asarray(raw / raw.max() if raw.size and raw.max() > 0 else np.ones_like(raw))


def plain_information(edges: Sequence[Edge], metric: bool, settings: WeightSettings) -> Array:
    """Return the same information for every edge, angles and shifts in one unit. Shape (E, D, D)."""
    levers = [lever for e in edges if (lever := lever_of(e, metric, settings)) is not None]
    lever = float(np.median(levers)) if levers else settings.lever_m
    unit = np.array([lever] * 3 + [1.0] * (3 if metric else 4)) * settings.unmeasured
    return np.tile(np.diag(1.0 / unit**2), (len(edges), 1, 1))


def _information(edges: Sequence[Edge], metric: bool, settings: WeightSettings) -> Array:
    if isinstance(settings, PlainWeightSettings):
        return plain_information(edges, metric, settings)
    information = information_of(edges, metric, settings)
    if isinstance(settings, PaperWeightSettings):
        weight = edge_weights(np.array([e.confidence for e in edges]), settings)
        information *= np.maximum(weight, 1e-6)[:, None, None]
    return information
