"""The uncertainty of scale along a chunk of structure from motion.

A new frame takes its scale from points that frames before it triangulated. A camera that rotates in place has next to
no parallax while they leave the picture, so errors of a fraction of a pixel make the part after the rotation larger or
smaller than the part before, by a tenth or more (research/colour-video 0208).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ERROR_RAD = 5e-4
"""Common error of the directions to features: a quarter of a pixel of a picture 640 wide."""
HALF_VIEW_RAD = 0.38
"""Rotation after which the middle of the picture has left it."""
ALONG = 0.3
"""Parallax of a motion along the viewing direction, as a share of that of the same motion to the side."""
MOST_FRAMES = 60
"""Frames on either side of a step that are used."""
LEAST_RAD = 1e-4
"""Least parallax."""


def lost_scale(T_chunk_cam: Array, reach: Array) -> Array:
    """Return the variance of the logarithm of scale that each step between G frames adds. Shape (G - 1,).

    `reach` (G,) is the viewing distance of the frames. Points seen on both sides of a step are placed by the parallax
    between the frames before it that look there, and by that between those after it: relative errors of both add up.
    Steps that have those frames in common share that error, too.
    """
    count = len(reach)
    parallax, frames, cut = np.zeros((2, count)), np.ones((2, count)), np.zeros((2, count), bool)
    for k in range(count):
        for side, others in enumerate((slice(k, None, -1), slice(k, None))):
            facing = T_chunk_cam[others, :3, 2][:MOST_FRAMES] @ T_chunk_cam[k, :3, 2] > np.cos(HALF_VIEW_RAD)
            seen = int(np.argmin(np.append(facing, False)))
            way = T_chunk_cam[others, :3, 3][:seen] - T_chunk_cam[k, :3, 3]
            square = (way**2).sum(axis=1) - (1.0 - ALONG**2) * (way @ T_chunk_cam[k, :3, 2]) ** 2
            parallax[side, k] = np.sqrt(max(float(square.max()), 0.0)) / reach[k]
            frames[side, k], cut[side, k] = seen, seen == len(facing) < MOST_FRAMES
    before, after = (0, slice(0, -1)), (1, slice(1, None))
    for mine, other in ((before, after), (after, before)):  # at the chunk's ends the other side gives the motion
        short = cut[mine] & (parallax[mine] < parallax[other])
        parallax[mine] = np.where(short, parallax[other], parallax[mine])
        frames[mine] = np.where(short, frames[other], frames[mine])
    both = np.maximum([parallax[before], parallax[after]], LEAST_RAD)
    return np.asarray(ERROR_RAD**2 * (both**-2.0).sum(axis=0) / np.minimum(frames[before], frames[after]))
