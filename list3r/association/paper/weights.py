"""Weights of edges as the paper writes them (A.4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ALPHA, GAMMA = 0.30, 6.0
"""The paper's strength of the logarithm and exponent."""


def paper_weights(confidence: Array) -> Array:
    """Return weights w_uv of edges from their confidence m_uv, as shares of the strongest. Shape (E,).

    With the paper's constants all w_uv are below 3.3e-4, so only their ratios mean something.
    """
    grown = np.log1p(ALPHA * np.clip(confidence, 0.0, 1.0))
    u = grown / (1.0 + grown)
    w = u**GAMMA / (u**GAMMA + (1.0 - u) ** GAMMA)
    return np.asarray(w / w.max() if w.size and w.max() > 0 else np.ones_like(w))
