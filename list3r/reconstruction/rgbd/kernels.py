"""The loops of `frame_registration` and `surfels`. Images have the shape (h, w), intrinsics are (fx, fy, cx, cy)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled

Floats = NDArray[np.float32]
Pose = NDArray[np.float64]
Paired = tuple[int, Floats, Floats, Floats, Floats, Floats, Floats, Floats, Floats]
"""What `pair_up` returns."""


@compiled
def pair_up(
    model: tuple[Floats, Floats, Floats],
    T_model_cam: Pose,
    intrinsics: tuple[float, float, float, float],
    view: tuple[Floats, Floats, NDArray[np.bool_], Floats],
    gate_m: float,
    agreement: float,
) -> Paired:
    """Return the number of model points that meet any surface of a view, and the M pairs within the gate.

    `model` is points and normals (N, 3) and grey values (N,); `view` points and normals (h, w, 3) in its camera, where
    they are known, and the inverse of the noise of depth. Of each pair are returned the view's point in model
    coordinates (M, 3), the model's point, normal, grey value, position in the view (M, 2) and coordinates in the
    camera, the distance from point to plane over noise (M,), and the inverse of that noise.
    """
    points, normals, gray = model
    there, facing, valid, inverse_sigma = view
    R, t = T_model_cam[:3, :3], T_model_cam[:3, 3]
    fx, fy, cx, cy = intrinsics
    height, width = valid.shape
    size, count, known = len(points), 0, 0
    moved, met, along = (
        np.empty((size, 3), np.float32),
        np.empty((size, 3), np.float32),
        np.empty((size, 3), np.float32),
    )
    uv, cam, tone = np.empty((size, 2), np.float32), np.empty((size, 3), np.float32), np.empty(size, np.float32)
    residual, precision = np.empty(size, np.float32), np.empty(size, np.float32)
    for k in range(len(points)):
        px, py, pz = points[k, 0] - t[0], points[k, 1] - t[1], points[k, 2] - t[2]
        z = px * R[0, 2] + py * R[1, 2] + pz * R[2, 2]
        if not z > 0.05:
            continue
        x, y = px * R[0, 0] + py * R[1, 0] + pz * R[2, 0], px * R[0, 1] + py * R[1, 1] + pz * R[2, 1]
        u, v = x / z * fx + cx, y / z * fy + cy
        if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        row, column = int(v + 0.5), int(u + 0.5)
        if not valid[row, column]:
            continue
        known += 1
        q, m, n = there[row, column], facing[row, column], normals[k]
        mx = R[0, 0] * q[0] + R[0, 1] * q[1] + R[0, 2] * q[2] + t[0]
        my = R[1, 0] * q[0] + R[1, 1] * q[1] + R[1, 2] * q[2] + t[1]
        mz = R[2, 0] * q[0] + R[2, 1] * q[1] + R[2, 2] * q[2] + t[2]
        dx, dy, dz = mx - points[k, 0], my - points[k, 1], mz - points[k, 2]
        distance = dx * n[0] + dy * n[1] + dz * n[2]
        if abs(distance) >= gate_m or dx * dx + dy * dy + dz * dz >= (4 * gate_m) ** 2:
            continue
        cosine = (
            (R[0, 0] * m[0] + R[0, 1] * m[1] + R[0, 2] * m[2]) * n[0]
            + (R[1, 0] * m[0] + R[1, 1] * m[1] + R[1, 2] * m[2]) * n[1]
            + (R[2, 0] * m[0] + R[2, 1] * m[1] + R[2, 2] * m[2]) * n[2]
        )
        if cosine <= agreement:
            continue
        sure = inverse_sigma[row, column]
        moved[count, 0], moved[count, 1], moved[count, 2] = mx, my, mz
        met[count], along[count], tone[count] = points[k], n, gray[k]
        uv[count, 0], uv[count, 1] = u, v
        cam[count, 0], cam[count, 1], cam[count, 2] = x, y, z
        residual[count], precision[count] = distance * sure, sure
        count += 1
    first = slice(0, count)
    return (
        known,
        moved[first],
        met[first],
        along[first],
        tone[first],
        uv[first],
        cam[first],
        residual[first],
        precision[first],
    )


@compiled
def spread(error: Floats, least: float) -> float:
    """Robust standard deviation of (M,) values, 1 for none."""
    return 1.4826 * float(np.median(np.abs(error))) + least if len(error) else 1.0


@compiled
def centred(error: Floats) -> Floats:
    """Values without their median."""
    return error - np.float32(np.median(error)) if len(error) else error


@compiled
def plane_slopes(moved: Floats, normals: Floats, inverse_sigma: Floats) -> Floats:
    """Slopes of distances from planes over noise by a left-hand step (translation, rotation). Shape (M, 6)."""
    out = np.empty((len(moved), 6), np.float32)
    for k in range(len(moved)):
        q, n, s = moved[k], normals[k], inverse_sigma[k]
        out[k, 0], out[k, 1], out[k, 2] = n[0] * s, n[1] * s, n[2] * s
        out[k, 3], out[k, 4] = (q[1] * n[2] - q[2] * n[1]) * s, (q[2] * n[0] - q[0] * n[2]) * s
        out[k, 5] = (q[0] * n[1] - q[1] * n[0]) * s
    return out


@compiled
def brightness_slopes(
    points: Floats,
    points_cam: Floats,
    sampled: Floats,
    R: Pose,
    focal: tuple[float, float],
    least_gradient: float,
) -> Floats:
    """Slopes of brightness by a left-hand step, where gradients are strong enough, else 0. Shape (M, 6).

    `points` are the model's, in its coordinates and in the camera, (M, 3); `sampled` is brightness and its gradient in
    x and y at the pixels that they fall on, (M, 3); `R` turns from the camera to the model.
    """
    out = np.zeros((len(points), 6), np.float32)
    for k in range(len(points)):
        dx, dy = sampled[k, 1], sampled[k, 2]
        if not dx * dx + dy * dy > least_gradient * least_gradient:
            continue
        p, q, z = points_cam[k], points[k], points_cam[k, 2]
        gx, gy = dx * focal[0] / z, dy * focal[1] / z
        gz = -(gx * p[0] + gy * p[1]) / z
        sx = -(R[0, 0] * gx + R[0, 1] * gy + R[0, 2] * gz)
        sy = -(R[1, 0] * gx + R[1, 1] * gy + R[1, 2] * gz)
        sz = -(R[2, 0] * gx + R[2, 1] * gy + R[2, 2] * gz)
        out[k, 0], out[k, 1], out[k, 2] = sx, sy, sz
        out[k, 3], out[k, 4], out[k, 5] = q[1] * sz - q[2] * sy, q[2] * sx - q[0] * sz, q[0] * sy - q[1] * sx
    return out


@compiled
def bilinear(images: Floats, uv: Floats) -> Floats:
    """Values of images (h, w, C) at places (M, 2) between pixels, as at the rim beyond it. Shape (M, C)."""
    height, width, channels = images.shape
    out = np.empty((len(uv), channels), np.float32)
    for k in range(len(uv)):
        u, v = min(max(uv[k, 0], 0.0), width - 1.0), min(max(uv[k, 1], 0.0), height - 1.0)
        column, row = min(int(u), width - 2), min(int(v), height - 2)
        a, b = u - column, v - row
        for c in range(channels):
            top = images[row, column, c] * (1 - a) + images[row, column + 1, c] * a
            under = images[row + 1, column, c] * (1 - a) + images[row + 1, column + 1, c] * a
            out[k, c] = top * (1 - b) + under * b
    return out


@compiled
def huber_equations(slope: Floats, error: Floats, scale: float, huber: float) -> tuple[Pose, Pose]:
    """Information (D, D) and gradient (D,) of residuals (M,) and their slopes (M, D), in units of a robust scale."""
    size = slope.shape[1]
    information, gradient = np.zeros((size, size)), np.zeros(size)
    limit, precision = huber * scale, 1.0 / (scale * scale)
    for k in range(len(slope)):
        weight = precision * min(1.0, limit / max(abs(error[k]), 1e-9))
        for i in range(size):
            weighted = weight * slope[k, i]
            gradient[i] += weighted * error[k]
            for j in range(i + 1):
                information[i, j] += weighted * slope[k, j]
    for i in range(size):
        for j in range(i):
            information[j, i] = information[i, j]
    return information, gradient


@compiled
def joint_equations(
    model: tuple[Floats, Floats, Floats],
    T_model_cam: Pose,
    intrinsics: tuple[float, float, float, float],
    view: tuple[tuple[Floats, Floats, NDArray[np.bool_], Floats], Floats],
    gate: tuple[float, float, int],
    kernel: tuple[float, float],
) -> tuple[Paired, float, Pose, Pose]:
    """Pairs of `pair_up`, the robust scale of their distances, and information and gradient of a left-hand step.

    `view` is that of `pair_up`, and brightness with its gradients (h, w, 3); `gate` is in metres, the least cosine of
    normals, and the least number of pairs, below which the equations are left 0; `kernel` is the limit of Huber's for
    distances, and the weight of brightness, 0 for none.
    """
    surface, brightness = view
    paired = pair_up(model, T_model_cam, intrinsics, surface, gate[0], gate[1])
    _, moved, points, normals, gray, uv, points_cam, residual, inverse_sigma = paired
    scale = spread(residual, 1e-3)
    if len(residual) < gate[2]:
        return paired, scale, np.zeros((6, 6)), np.zeros(6)
    slope = plane_slopes(moved, normals, inverse_sigma)
    information, gradient = huber_equations(slope, residual, scale, kernel[0])
    if kernel[1] > 0:
        sampled, R = bilinear(brightness, uv), np.ascontiguousarray(T_model_cam[:3, :3])
        slope = brightness_slopes(points, points_cam, sampled, R, (intrinsics[0], intrinsics[1]), 0.0)
        error = centred(sampled[:, 0] - gray)
        more, further = huber_equations(slope, error, spread(error, 1.0), 1.345)
        information += kernel[1] * more
        gradient += kernel[1] * further
    return paired, scale, information, gradient


@compiled
def foremost(
    elements: Floats, T_model_cam: Pose, intrinsics: tuple[float, float, float, float], height: int, width: int
) -> NDArray[np.int32]:
    """Number of the nearest element that faces the camera at each pixel, -1 for none. Shape (h * w,).

    `elements` begin with point and normal, (N, 8).
    """
    R, t = T_model_cam[:3, :3], T_model_cam[:3, 3]
    fx, fy, cx, cy = intrinsics
    out, nearest = np.full(height * width, -1, np.int32), np.full(height * width, np.inf, np.float32)
    for k in range(len(elements)):
        e = elements[k]
        px, py, pz = e[0] - t[0], e[1] - t[1], e[2] - t[2]
        z = px * R[0, 2] + py * R[1, 2] + pz * R[2, 2]
        if not z > 0.1 or px * e[3] + py * e[4] + pz * e[5] >= 0:
            continue
        u = (px * R[0, 0] + py * R[1, 0] + pz * R[2, 0]) / z * fx + cx + 0.5
        v = (px * R[0, 1] + py * R[1, 1] + pz * R[2, 1]) / z * fy + cy + 0.5
        if u >= 0 and v >= 0 and u < width and v < height:
            pixel = int(v) * width + int(u)
            if z <= nearest[pixel]:
                out[pixel], nearest[pixel] = k, z
    return out


@compiled
def fuse(
    elements: Floats,
    element: NDArray[np.int32],
    seen: tuple[Floats, Floats, Floats],
    axis: Pose,
    limits: tuple[float, float],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Average measurements into elements (N, 8) of point, normal, grey and weight, in place.

    `element` is the element that each of M measurements meets, -1 for none; `seen` are the measurements as rows like
    the elements (M, 8), their depth and its noise (M,); `axis` is the viewing direction. `limits` are the least cosine
    of normals and the most views to remember. Returned are the measurements without an element, and the elements that
    were seen through, whose weight is halved.
    """
    rows, depth, sigma = seen
    new, through = np.zeros(len(rows), np.bool_), np.zeros(len(elements), np.bool_)
    for k in range(len(rows)):
        if element[k] < 0:
            new[k] = True
            continue
        e, m = elements[element[k]], rows[k]
        behind = (m[0] - e[0]) * axis[0] + (m[1] - e[1]) * axis[1] + (m[2] - e[2]) * axis[2]
        limit = 3 * sigma[k] + 0.01 * depth[k]
        if abs(behind) < limit:
            if m[3] * e[3] + m[4] * e[4] + m[5] * e[5] > limits[0]:
                _average(e, m, limits[1])
            continue
        new[k] = True
        if behind > limit:
            e[7] *= np.float32(0.5)
            through[element[k]] = True
    return new, through


@compiled
def _average(element: Floats, measured: Floats, most: float) -> None:
    total = element[7] + measured[7]
    share = measured[7] / total
    for c in range(7):
        element[c] += (measured[c] - element[c]) * share
    length = np.sqrt(element[3] * element[3] + element[4] * element[4] + element[5] * element[5])
    for c in range(3, 6):
        element[c] /= length
    element[7] = min(total, np.float32(most))
