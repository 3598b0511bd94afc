"""How far stated probabilities can be believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def calibration(probability: NDArray[np.float64], right: NDArray[np.bool_], bins: int = 10) -> dict[str, float]:
    """Return the expected calibration error, and the share right of the surest 0.6 and 0.8 and of all."""
    edge = np.clip((probability * bins).astype(int), 0, bins - 1)
    error = sum(abs(probability[edge == k].mean() - right[edge == k].mean()) * (edge == k).mean() for k in set(edge))
    order = np.argsort(-probability, kind="stable")
    tops = {f"right_at_{c:g}": float(right[order[: max(1, round(c * len(order)))]].mean()) for c in (0.6, 0.8, 1.0)}
    return {"ece": round(float(error), 4), "count": len(right), **{k: round(v, 4) for k, v in tops.items()}}
