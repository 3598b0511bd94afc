"""Estimate the covariance of a relation of two keyframes: the error of their pairs, and a part that all pairs share.

Pairs of two depth images are many and their errors are correlated: over a neighbourhood by depth, and over whole images
by an error of the calibration, which rotates or scales them. So the information of the pairs counts as that of a few
cells of the picture, and a part that all pairs share is added, about the camera. It is the larger part by far
(research/association 0046).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.edge_information import about
from list3r.association.graph.solver import adjoint
from list3r.memory.core.geometry import Sim3
from list3r.reconstruction.rgbd.frame_registration import FrameRegistration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class KeyframeErrorSettings:
    """Correlated errors of two keyframes."""

    common: float = 0.01
    """Standard deviation that all pairs share: a share of the depth for shifts, radians for rotations, of the log
    scale. A depth camera's focal length is known to about 1 % (7-Scenes: 585 px nominal, 579 px measured)."""
    cells: int = 48
    """Parts of the picture whose errors are independent (8 x 6)."""


def registration_covariance(
    found: FrameRegistration, T_chunk_cam: Array, depth: float, settings: KeyframeErrorSettings
) -> Array:
    """Return the covariance of a rigid S_v_u through a registration of v's view to u's keyframe at `T_chunk_cam` (4,
    4), whose median depth is `depth`: of x in S_true = S_v_u exp(x), u's units, sigma 0. Shape (7, 7).

    S_v_u = T_v T_u_v^-1 T_u^-1, so a left-hand error d of T_u_v is x = -Ad(T_u) d.
    """
    unit = np.array([depth] * 3 + [1.0] * 3)
    correlated = max(found.pairs / settings.cells, 1.0) * max(found.residual, 1.0) ** 2
    steady = found.information / correlated + np.diag(1.0 / unit**2)
    own = np.linalg.inv((steady + steady.T) / 2.0)
    tangent = np.zeros((7, 7))
    tangent[:6, :6] = own + np.diag((settings.common * unit) ** 2)
    moved = adjoint(Sim3.from_matrix(T_chunk_cam))
    return np.asarray(moved @ tangent @ moved.T)


def with_scale(covariance: Array, center: Array, deviation: float, unit: float) -> Array:
    """Return a covariance stated in `unit`s of u (u's coordinates times `unit`), converted to u's own, with an error of
    the scale about `center` (3,), u's coordinates, where surfaces meet at any scale. Shape (7, 7)."""
    back = np.diag([1.0 / unit] * 3 + [1.0] * 4)
    along = about(center[None])[0][:, 6] * deviation
    return np.asarray(back @ covariance @ back + np.outer(along, along))
