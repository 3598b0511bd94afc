"""The surface points of two chunks that correspond: the same pixel of the same frame in either."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.records import FrameSamples

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Pairs:
    """N corresponding surface points of two chunks."""

    p_u: Floats
    """In u. Shape (N, 3)."""
    p_v: Floats
    """In v. Shape (N, 3)."""
    confidence_u: Floats
    """Shape (N,)."""
    confidence_v: Floats
    """Shape (N,)."""
    frame: Ints
    """Frame.index. Shape (N,)."""
    pixel: Ints
    """Row-major number in the colour image. Shape (N,)."""
    instance_u: Ints
    """Local id in u, -1 for none. Shape (N,)."""
    instance_v: Ints
    """Local id in v, -1 for none. Shape (N,)."""
    T_cam_u: Floats
    """From chunk u to the camera of each pair's frame. Shape (N, 3, 4)."""
    T_cam_v: Floats
    """From chunk v to the camera of each pair's frame. Shape (N, 3, 4)."""
    cam_v: Floats
    """p_v in the camera of its frame. Shape (N, 3)."""

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def weight(self) -> Floats:
        """Geometric mean of the two confidences. Shape (N,)."""
        return np.asarray(np.sqrt(self.confidence_u * self.confidence_v))


def shared_pairs(u: FrameSamples, v: FrameSamples) -> Pairs:
    """Return the samples at the same pixel of the same frame, finite, with confidence, seen from posed cameras.

    Raises `DegenerateError` when there is none, with the reason.
    """
    pick_u, pick_v = shared_samples(u, v)
    if not len(pick_u):
        frames = np.intersect1d(u.frame, v.frame)
        raise DegenerateError(
            f"the chunks share {len(frames)} frames and 0 points; chunks that overlap share posed frames"
        )
    row_u, row_v = _camera_rows(u, u.frame[pick_u]), _camera_rows(v, v.frame[pick_v])
    p_u, p_v = u.points[pick_u].astype(np.float64), v.points[pick_v].astype(np.float64)
    posed = (row_u >= 0) & (row_v >= 0)
    finite = np.isfinite(p_u).all(axis=1) & np.isfinite(p_v).all(axis=1)
    sure = (u.confidence[pick_u] > 0) & (v.confidence[pick_v] > 0)
    for kept, what in (
        (posed, "is in a frame whose camera both chunks posed"),
        (posed & finite, "has finite coordinates in both chunks"),
        (posed & finite & sure, "has a confidence above zero in both chunks"),
    ):
        if not kept.any():
            raise DegenerateError(f"of {len(pick_u)} shared points none {what}")
    keep = np.flatnonzero(posed & finite & sure)
    T_cam_u, T_cam_v = _cameras(u, row_u[keep]), _cameras(v, row_v[keep])
    return Pairs(
        p_u=p_u[keep],
        p_v=p_v[keep],
        confidence_u=u.confidence[pick_u[keep]].astype(np.float64),
        confidence_v=v.confidence[pick_v[keep]].astype(np.float64),
        frame=u.frame[pick_u[keep]],
        pixel=u.pixel[pick_u[keep]].astype(np.int64),
        instance_u=u.instance[pick_u[keep]].astype(np.int64),
        instance_v=v.instance[pick_v[keep]].astype(np.int64),
        T_cam_u=T_cam_u,
        T_cam_v=T_cam_v,
        cam_v=moved(T_cam_v, p_v[keep]),
    )


def shared_samples(u: FrameSamples, v: FrameSamples) -> tuple[Ints, Ints]:
    """Return positions in u and v of the samples at the same pixel of the same frame, by frame and pixel."""
    key_u = (u.frame.astype(np.int64) << np.int64(32)) + u.pixel
    key_v = (v.frame.astype(np.int64) << np.int64(32)) + v.pixel
    _, pick_u, pick_v = np.intersect1d(key_u, key_v, assume_unique=True, return_indices=True)
    return pick_u, pick_v


def moved(T: Floats, points: Floats) -> Floats:
    """Move each point by its own transform. Shapes (N, 3, 4), (N, 3) -> (N, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", T[:, :, :3], points) + T[:, :, 3])


def _camera_rows(samples: FrameSamples, frame: Ints) -> Ints:
    """Return the row of each frame's camera, -1 where it has none that is finite."""
    if not len(samples.camera_frames):
        return np.full(len(frame), -1, np.int64)
    order = np.argsort(samples.camera_frames, kind="stable")
    row = order[np.minimum(np.searchsorted(samples.camera_frames[order], frame), len(order) - 1)]
    good = np.asarray(np.isfinite(samples.T_chunk_cam).all(axis=(1, 2)))
    return np.where((samples.camera_frames[row] == frame) & good[row], row, -1)


def _cameras(samples: FrameSamples, row: Ints) -> Floats:
    """Return the transforms from the chunk to the cameras of rows. Shape (N, 3, 4)."""
    used, which = np.unique(row, return_inverse=True)
    return np.asarray(np.linalg.inv(samples.T_chunk_cam[used])[which.ravel(), :3], np.float64)
