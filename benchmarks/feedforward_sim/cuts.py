"""Shot cuts of a simulated video, by the frame descriptors that the simulated network gives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.frames.chunking.cuts import ShotCutSettings, jumps, spaced, suspected

LIKENESS = 0.75
"""Cosine from which frame descriptors are alike whatever is usual."""


def cuts_by_descriptor(descriptors: NDArray[np.float32]) -> tuple[int, ...]:
    """Positions before which the video jumps, ascending, by unit-length descriptors of all frames. Shape (F, D)."""
    chosen = ShotCutSettings()
    if len(descriptors) < 2:
        return ()
    likeness = np.r_[1.0, np.einsum("fd,fd->f", descriptors[1:], descriptors[:-1])]

    def alike(a: int, b: int) -> bool:
        return bool(descriptors[a] @ descriptors[b] >= LIKENESS)

    suspects = [k for k in range(len(likeness)) if suspected(likeness, k, LIKENESS, chosen)]
    return spaced([k for k in suspects if jumps(k, len(descriptors), alike, chosen)], alike, chosen)
