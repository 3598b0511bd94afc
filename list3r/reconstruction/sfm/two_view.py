"""Matches that agree on the geometry of two views of one known camera.

OpenCV's MAGSAC (Barath et al., "MAGSAC++, a fast, reliable and accurate robust estimator", CVPR 2020) takes an eighth
of the time of the three models that pycolmap fits, and keeps the same matches (research/colour-video 0075).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.sfm.colmap import pixel_unit
from list3r.reconstruction.sfm.mapping import MapProblem
from list3r.reconstruction.sfm.settings import LEAST_MATCHES, MappingSettings


def verified_rows(
    problem: MapProblem, camera: Camera, settings: MappingSettings
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Return the rows of each pair that agree on an essential matrix, also where the camera only turned."""
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    gate = settings.pair_error_px * pixel_unit(camera)
    out = {}
    for (a, b), rows in problem.pairs.items():
        if len(rows) < LEAST_MATCHES:
            continue
        one = problem.views[a].xy[rows[:, 0]].astype(np.float64)
        two = problem.views[b].xy[rows[:, 1]].astype(np.float64)
        _, agree = cv2.findEssentialMat(
            one, two, K, method=cv2.USAC_MAGSAC, prob=0.999, threshold=gate, maxIters=settings.pair_trials
        )
        if agree is not None:
            out[a, b] = rows[agree.ravel() > 0]
    return out
