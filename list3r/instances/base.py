"""The interfaces of the local instance library (paper 3.1, A.1): discoverer and tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.memory.core.records import LocalLibrary
from list3r.reconstruction.base import Reconstruction


@dataclass(frozen=True)
class Proposals:
    """Candidate masks on one anchor frame, N of them, best first."""

    position: int
    """The anchor's position in the chunk."""
    labels: NDArray[np.int32]
    """Candidate at each pixel, 0 for none, n + 1 for candidate n. Shape (H, W)."""
    score: NDArray[np.float32]
    """Confidence in [0, 1]. Shape (N,)."""
    features: NDArray[np.float32]
    """Unit-length object features of the named space. Shape (N, D)."""
    plane: NDArray[np.float64]
    """Plane (n, d) with n . p + d = 0 in camera coordinates of the anchor, n towards the camera, for candidates that
    are one flat surface; NaN for the others. Shape (N, 4)."""
    identity: NDArray[np.int64] | None = None
    """The object each candidate is a view of, where the discoverer knows it across anchors. Shape (N,)."""
    structure: NDArray[np.bool_] | None = None
    """Candidates that bound the room (floor, wall, ceiling), where the discoverer knows. Shape (N,)."""
    names: tuple[str, ...] | None = None
    """Class name of each candidate, where the discoverer has names. N of them."""
    whole: NDArray[np.float32] | None = None
    """Calibrated probability that each candidate is one whole object, where the discoverer knows. Shape (N,)."""
    named: tuple[tuple[tuple[str, float], ...], ...] | None = None
    """Names that each candidate may have, with their probabilities over all anchors, where it knows. N of them."""
    low_confidence: Proposals | None = None
    """Segments too uncertain to be candidates, with `identity` and `whole`, where the discoverer reports them."""


class Discoverer(Protocol):
    """Finds objects on an anchor frame."""

    @property
    def feature_space(self) -> str:
        """Name of the embedding space of its features, `model@revision/dim`."""
        ...

    def __call__(self, frames: Sequence[Frame], reconstruction: Reconstruction, position: int) -> Proposals:
        """Propose masks on the frame at `position` of the chunk; it may also use the neighbouring frames."""
        ...


class Tracker(Protocol):
    """Follows masks through the chunk."""

    def __call__(
        self,
        frames: Sequence[Frame],
        reconstruction: Reconstruction,
        proposals: Sequence[Proposals],
        feature_space: str,
    ) -> LocalLibrary:
        """Propagate all candidates over the chunk, join those that are one object, drop unstable tracks."""
        ...
