"""Loops over the points of a map, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled

Floats = NDArray[np.float64]


@compiled
def pose_equations(
    T_cam_map: Floats, px: Floats, points: Floats, rows: NDArray[np.bool_], lens: Floats, scale: float
) -> tuple[Floats, Floats]:
    """Return the information (6, 6) and the gradient (6,) of a camera's motion in its own frame: translation, rotation
    vector.

    From points (N, 3) and their pixels (N, 2), those in `rows` that are in front of the camera, under a Cauchy kernel
    of `scale` px. `lens` is fx, fy, cx, cy.
    """
    information, gradient, slope = np.zeros((6, 6)), np.zeros(6), np.empty((2, 6))
    fx, fy, cx, cy = lens
    slope[0, 1] = slope[1, 0] = 0.0
    for k in range(len(points)):
        if not rows[k]:
            continue
        a, b, c = points[k]
        x = T_cam_map[0, 0] * a + T_cam_map[0, 1] * b + T_cam_map[0, 2] * c + T_cam_map[0, 3]
        y = T_cam_map[1, 0] * a + T_cam_map[1, 1] * b + T_cam_map[1, 2] * c + T_cam_map[1, 3]
        z = T_cam_map[2, 0] * a + T_cam_map[2, 1] * b + T_cam_map[2, 2] * c + T_cam_map[2, 3]
        if z <= 0.0:
            continue
        u, v = x / z, y / z
        right, down = fx * u + cx - px[k, 0], fy * v + cy - px[k, 1]
        weight = 1.0 / (1.0 + (right * right + down * down) / (scale * scale))
        slope[0, 0], slope[0, 2] = fx / z, -fx * u / z
        slope[0, 3], slope[0, 4], slope[0, 5] = -fx * u * v, fx * (1.0 + u * u), -fx * v
        slope[1, 1], slope[1, 2] = fy / z, -fy * v / z
        slope[1, 3], slope[1, 4], slope[1, 5] = -fy * (1.0 + v * v), fy * u * v, fy * u
        for i in range(6):
            along, across = weight * slope[0, i], weight * slope[1, i]
            gradient[i] += along * right + across * down
            for j in range(i + 1):
                information[i, j] += along * slope[0, j] + across * slope[1, j]
    for i in range(6):
        for j in range(i):
            information[j, i] = information[i, j]
    return information, gradient
