"""Whether the poses of a map's keyframes agree with their matches.

Growing a map adds a keyframe when a few dozen of its points fit a pose; matches with other keyframes that contradict it
are then dropped. Here they are tested again: most verified two-view matches must be near the epipolar lines of the
map's poses (research/colour-video 0065).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.memory.core.geometry import skew
from list3r.reconstruction.sfm.settings import ConsistencySettings

Floats = NDArray[np.float64]
Seen = Mapping[tuple[int, int], tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Pixels of verified matches in two keyframes, by keys. Shapes (M, 2)."""


def contradicted(
    T_map_cam: Mapping[int, Floats], seen: Seen, camera: Camera, settings: ConsistencySettings | None = None
) -> set[int]:
    """Keyframes of a map that most of their matches with the others contradict, found worst first."""
    s = settings or ConsistencySettings()
    gate = s.most_px * max(camera.width, camera.height) / 640.0
    agreeing = {
        pair: (len(xy[0]), int((epipolar_errors(*xy, T_map_cam[pair[0]], T_map_cam[pair[1]], camera) < gate).sum()))
        for pair, xy in sorted(seen.items())
        if pair[0] in T_map_cam and pair[1] in T_map_cam
    }
    left, out = set(T_map_cam), set()
    while left:
        shares = {k: _share(k, left, agreeing) for k in sorted(left)}
        worst = min(shares, key=lambda k: (shares[k], k))
        if shares[worst] >= s.least_share:
            break
        left.remove(worst)
        out.add(worst)
    return out


def epipolar_errors(
    a: NDArray[np.float32], b: NDArray[np.float32], T_map_a: Floats, T_map_b: Floats, camera: Camera
) -> Floats:
    """Distances of matches from the epipolar lines of two poses, to first order (Sampson), px. Shape (M,)."""
    T_b_a = np.linalg.inv(T_map_b) @ T_map_a
    K_inverse = np.linalg.inv([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    F = K_inverse.T @ skew(T_b_a[:3, 3]) @ T_b_a[:3, :3] @ K_inverse
    ones = np.ones((len(a), 1))
    one, two = np.concatenate([a, ones], axis=1), np.concatenate([b, ones], axis=1)
    in_b, in_a = one @ F.T, two @ F
    size = (in_b[:, :2] ** 2).sum(axis=1) + (in_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((two * in_b).sum(axis=1)) / np.sqrt(np.maximum(size, 1e-12)))


def _share(key: int, left: set[int], agreeing: Mapping[tuple[int, int], tuple[int, int]]) -> float:
    """Share of a keyframe's matches with the others that agree; 1 without any."""
    mine = [n for pair, n in agreeing.items() if key in pair and pair[0] in left and pair[1] in left]
    count = sum(count for count, _ in mine)
    return sum(agree for _, agree in mine) / count if count else 1.0
