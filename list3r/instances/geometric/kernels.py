"""The loops of `views` and of masks that are followed. Images are (h, w), intrinsics are (fx, fy, cx, cy)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled

Float = NDArray[np.float32]
Labels = NDArray[np.int32]
Intrinsics = tuple[np.float32, np.float32, np.float32, np.float32]


@compiled
def read_across(
    depth: Float, camera: Intrinsics, T_other_cam: Float, other: Intrinsics, image: Float
) -> tuple[Float, NDArray[np.bool_]]:
    """Depth read in the image of another camera less that predicted from a depth image, and where both are known."""
    height, width = depth.shape
    residual, seen = np.empty(depth.shape, np.float32), np.zeros(depth.shape, np.bool_)
    for row in range(height):
        for column in range(width):
            pixel, z = _pixel(depth[row, column], (row, column), camera, T_other_cam, other, image.shape)
            read = image[pixel // image.shape[1], pixel % image.shape[1]] if pixel >= 0 else np.float32(0)
            residual[row, column] = read - z
            seen[row, column] = read > 0 and depth[row, column] > 0 and z > 0
    return residual, seen


@compiled
def propagate_labels(
    depth: Float,
    camera: Intrinsics,
    T_source_cam: Float,
    source: tuple[Float, Labels],
    law: tuple[np.float32, np.float32, np.float32, np.float32, np.float32],
) -> tuple[Labels, NDArray[np.bool_]]:
    """Labels of a source view looked up from a depth image, and where the source shows the same surface. (h, w) each.

    `source` is its depth and its labels; `law` the noise of depth, base + quadratic * z^2 in metres, the units of a
    metre, the scale of the noise, and the tolerance added to four deviations.
    """
    read, labels = source
    base, quadratic, unit, scale, tolerated = law
    height, width = depth.shape
    out, agrees = np.zeros(depth.shape, np.int32), np.zeros(depth.shape, np.bool_)
    for row in range(height):
        for column in range(width):
            if not depth[row, column] > 0:
                continue
            pixel, z = _pixel(depth[row, column], (row, column), camera, T_source_cam, camera, read.shape)
            if pixel < 0:
                continue
            there = read[pixel // width, pixel % width]
            metres = z / unit
            sigma = (base + quadratic * metres * metres) * unit * scale
            if there > 0 and abs(there - z) < np.float32(4) * sigma + tolerated:
                agrees[row, column] = True
                out[row, column] = labels[pixel // width, pixel % width]
    return out, agrees


@compiled
def _pixel(
    depth: np.float32,
    place: tuple[int, int],
    camera: Intrinsics,
    T_other_cam: Float,
    other: Intrinsics,
    shape: tuple[int, int],
) -> tuple[int, np.float32]:
    """The pixel of another camera that sees the surface of each depth pixel, -1 for none, and its depth there."""
    row, column = place
    u, v = (np.float32(column) - camera[2]) / camera[0], (np.float32(row) - camera[3]) / camera[1]
    T = T_other_cam
    z = (T[2, 0] * u + (T[2, 1] * v + T[2, 2])) * depth + T[2, 3]
    if not depth > 0:
        return -1, z
    safe = max(z, np.float32(1e-6))
    x = ((T[0, 0] * u + (T[0, 1] * v + T[0, 2])) * depth + T[0, 3]) / safe * other[0] + other[2]
    y = ((T[1, 0] * u + (T[1, 1] * v + T[1, 2])) * depth + T[1, 3]) / safe * other[1] + other[3]
    if not (x > -1 and y > -1 and x < shape[1] and y < shape[0]):
        return -1, z
    across, down = int(np.rint(x)), int(np.rint(y))
    if across < 0 or down < 0 or across >= shape[1] or down >= shape[0]:
        return -1, z
    return down * shape[1] + across, z


@compiled
def without_lone(labels: Labels) -> tuple[Labels, Labels]:
    """Labels that three of the eight neighbours share, 0 elsewhere, and the greatest label of a neighbour. (h, w).

    Without a loop over the neighbours, so that it is worked on many pixels at a time.
    """
    height, width = labels.shape
    framed = np.full((height + 2, width + 2), np.iinfo(np.int32).min, np.int32)
    framed[1:-1, 1:-1] = labels
    kept, most = np.empty(labels.shape, np.int32), np.empty(labels.shape, np.int32)
    for row in range(height):
        over, on, under = framed[row], framed[row + 1], framed[row + 2]
        for k in range(width):
            here = on[k + 1]
            alike = np.int32(over[k] == here) + np.int32(over[k + 1] == here) + np.int32(over[k + 2] == here)
            alike += np.int32(on[k] == here) + np.int32(on[k + 2] == here)
            alike += np.int32(under[k] == here) + np.int32(under[k + 1] == here) + np.int32(under[k + 2] == here)
            around = max(np.int32(0), over[k], over[k + 1], over[k + 2], on[k], on[k + 2])
            most[row, k] = max(around, under[k], under[k + 1], under[k + 2])
            kept[row, k] = here if alike >= 3 else 0
    return kept, most


@compiled
def label_runs(
    labels: Labels, stride: int, height: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Labels]:
    """Runs of pixels of one label above 0: where each starts and stops in an image (height, width), and its label.

    Each pixel of `labels` represents `stride` by `stride` pixels of that image.
    """
    room, count = 64 + labels.size // 4, 0
    starts, stops, value = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int32)
    for row in range(height):
        line, column = labels[row // stride], 0
        while column * stride < width:
            here, first = line[column], column
            while column < len(line) and line[column] == here:
                column += 1
            if here <= 0:
                continue
            start, stop = row * width + first * stride, row * width + min(column * stride, width)
            if count and stops[count - 1] == start and value[count - 1] == here:
                stops[count - 1] = stop
                continue
            if count == len(value):
                starts, stops = np.concatenate((starts, starts)), np.concatenate((stops, stops))
                value = np.concatenate((value, value))
            starts[count], stops[count], value[count] = start, stop, here
            count += 1
    return starts[:count], stops[:count], value[:count]


@compiled
def meeting(keys: NDArray[np.int64], shift: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions of ascending keys k with k + `shift` among the keys, and of k + `shift`. Shape (H,) each."""
    here, there = np.empty(len(keys), np.int64), np.empty(len(keys), np.int64)
    count, at = 0, 0
    for k in range(len(keys)):
        wanted = keys[k] + shift
        while at < len(keys) and keys[at] < wanted:
            at += 1
        if at == len(keys):
            break
        if keys[at] == wanted:
            here[count], there[count] = k, at
            count += 1
    return here[:count], there[:count]


@compiled
def sums_by(own: NDArray[np.int64], values: NDArray[np.floating], count: int) -> NDArray[np.float64]:
    """Sums of the rows of `values` (N, C) that belong to each of `count` owners. Shape (count, C)."""
    out = np.zeros((count, values.shape[1]))
    for k in range(len(own)):
        for c in range(values.shape[1]):
            out[own[k], c] += values[k, c]
    return out
