"""Local features that two frames agree on: a start for a registration, and the judge of its outcome."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.features.local import Features, gates, match, relative_pose
from list3r.reconstruction.features.settings import FeatureSettings

Pose = NDArray[np.float64]


@dataclass(frozen=True)
class VerifiedFeatures:
    """Points that a known frame and a new one share, and the pose of the new one by them alone."""

    T_model_cam: Pose
    """Shape (4, 4)."""
    points_model: NDArray[np.float64]
    """By the known frame, metres. Shape (N, 3)."""
    points_cam: NDArray[np.float64]
    """By the new frame, in its camera, metres. Shape (N, 3)."""
    gate_m: NDArray[np.float64]
    """Largest distance between the two that noise explains. Shape (N,)."""
    matches: int
    """Pairs that look alike, of which these N agree on the pose."""

    @classmethod
    def between(
        cls, known: Features, T_model_known: Pose, new: Features, settings: FeatureSettings, noise: SensorNoise
    ) -> VerifiedFeatures | None:
        """Return what both frames show; None where too few features agree on one motion."""
        pairs = match(known.descriptors, new.descriptors, settings.ratio)
        a, b = known.points_cam[pairs[:, 0]], new.points_cam[pairs[:, 1]]
        pose = relative_pose(a, b, settings, noise)
        if pose is None:
            return None
        both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        p, q = a[both].astype(np.float64), b[both].astype(np.float64)
        gate = gates(p, q, settings, noise)
        agree = np.linalg.norm(_moved(pose.T_a_b, q) - p, axis=1) < gate
        return cls(T_model_known @ pose.T_a_b, _moved(T_model_known, p[agree]), q[agree], gate[agree], len(p))

    @property
    def prove(self) -> bool:
        """Whether most pairs agree: fewer may agree by chance, where shapes repeat."""
        return 2 * len(self.gate_m) > self.matches

    def agree_with(self, T_model_cam: Pose) -> bool:
        """Return whether most of the points are where a pose (4, 4) of the new frame puts them, but for noise."""
        off = np.linalg.norm(_moved(T_model_cam, self.points_cam) - self.points_model, axis=1)
        return bool(np.median(off / self.gate_m) < 1.0)


def _moved(T: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points @ T[:3, :3].T + T[:3, 3]
