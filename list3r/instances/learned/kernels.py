"""The loops of `superpoints` and `graph`, over pairs of voxels and of pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled

Float = NDArray[np.float32]
Ints = NDArray[np.int32]
Codes = NDArray[np.int64]


@compiled
def way_costs(
    pairs: tuple[Ints, Ints],
    cloud: tuple[Float, Float, Float],
    voxel: np.float32,
    weights: tuple[np.float32, np.float32, np.float32],
) -> Float:
    """Path length between neighbouring voxels. Shape (M,).

    `cloud` is points, normals and colours (N, 3); `weights` those of a bend, of a step of colour and of a rise.
    """
    left, right = pairs
    points, normals, lab = cloud
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    out = np.empty(len(left), np.float32)
    for k in range(len(left)):
        a, b = left[k], right[k]
        cosine, step, way, color, faces, other = zero, zero, zero, zero, False, False
        for c in range(3):
            n, m = normals[a, c], normals[b, c]
            away, tone = (points[b, c] - points[a, c]) / voxel, lab[a, c] - lab[b, c]
            cosine += n * m
            step += away * (n + m)
            way += away * away
            color += tone * tone
            faces |= n != zero
            other |= m != zero
        bend, rise = np.float32(0.3), zero
        if faces and other:
            bend, rise = one - min(max(cosine, -one), one), abs(step) / np.float32(2)
        cost = np.float32(0.2) + np.sqrt(way) + weights[0] * bend + weights[1] * np.sqrt(color)
        out[k] = cost + weights[2] * max(rise - half, zero)
    return out


@compiled
def least_of_groups(count: int, left: Codes, right: Codes) -> Codes:
    """The least of each of `count` nodes' connected group. Shape (count,)."""
    above = np.arange(count)
    for k in range(len(left)):
        a, b = left[k], right[k]
        while above[a] != a:
            above[a] = above[above[a]]
            a = above[a]
        while above[b] != b:
            above[b] = above[above[b]]
            b = above[b]
        above[max(a, b)] = min(a, b)
    for n in range(count):
        above[n] = above[above[n]]
    return above


@compiled
def touching(labels: Ints, left: Ints, right: Ints, count: int) -> tuple[Ints, Ints, Codes]:
    """Pairs of neighbouring voxels of different pieces: that of the lesser piece, the other one, and their code."""
    here, there, code = np.empty(len(left), np.int32), np.empty(len(left), np.int32), np.empty(len(left), np.int64)
    found = 0
    for k in range(len(left)):
        a, b = labels[left[k]], labels[right[k]]
        if a == b or a < 0 or b < 0:
            continue
        if a < b:
            here[found], there[found], code[found] = left[k], right[k], np.int64(a) * count + b
        else:
            here[found], there[found], code[found] = right[k], left[k], np.int64(b) * count + a
        found += 1
    return here[:found].copy(), there[:found].copy(), code[:found].copy()


@compiled
def contact_sums(
    pairs: tuple[Ints, Ints],
    at: Codes,
    cloud: tuple[Float, Float, Float, Float],
    voxel: np.float32,
    count: int,
) -> NDArray[np.float64]:
    """Sums over the pairs of voxels at each of `count` borders. Shape (count, 8).

    Of 1, bend, whether it is a groove, cosine, step, difference of colour and of lightness, and noise. `cloud` is
    points, normals and colours (N, 3), and noise (N,); `at` is the border of each pair.
    """
    points, normals, lab, sigma = cloud
    zero, out = np.float32(0), np.zeros((count, 8))
    for k in range(len(at)):
        a, b = pairs[0][k], pairs[1][k]
        faces, other, sums = False, False, np.zeros((4, 3), np.float32)
        for c in range(3):
            n, m = normals[a, c], normals[b, c]
            way, tone = (points[b, c] - points[a, c]) / voxel, lab[b, c] - lab[a, c]
            sums[0, c], sums[1, c] = (m - n) * way, way * (n + m) / np.float32(2)
            sums[2, c], sums[3, c] = n * m, tone * tone
            faces |= n != zero
            other |= m != zero
        known = 1.0 if faces and other else 0.0
        bent = (sums[0, 0] + sums[0, 1] + sums[0, 2]) * known
        row = out[at[k]]
        row[0] += 1
        row[1] += bent
        row[2] += 1.0 if bent < -0.15 else 0.0
        row[3] += sums[2, 0] + sums[2, 1] + sums[2, 2] if known > 0 else np.float32(0.7)
        row[4] += abs(sums[1, 0] + sums[1, 1] + sums[1, 2])
        row[5] += np.sqrt(sums[3, 0] + sums[3, 1] + sums[3, 2])
        row[6] += abs(lab[b, 0] - lab[a, 0])
        row[7] += max(sigma[a], sigma[b])
    return out


@compiled
def seen_across(
    image: Ints,
    view: tuple[Float, Float, Float],
    apart: tuple[int, int, int],
    codes: Codes,
    count: int,
    sums: NDArray[np.float64],
) -> None:
    """Add a view's observations of each border to `sums` (E, 5), between pixels that are `apart` in rows and columns;
    where the second has no label, up to so many times (the third number) as far.

    Number of observations, depth order, and the steps of lightness and of colour. `view` is depth and the least jump of
    it (h, w), and colours (h, w, 3); `codes` (E,) ascend.
    """
    depth, limit, lab = view
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            y, x = _across(image, row, column, apart)
            a, b = image[row, column], image[y, x]
            if a == b or a < 0 or b < 0:
                continue
            at = _place(codes, np.int64(min(a, b)) * count + max(a, b))
            if at < 0:
                continue
            jump = depth[y, x] - depth[row, column]
            jump = -jump if a > b else jump
            sure, first, second = limit[row, column], lab[row, column], lab[y, x]
            sums[at, 0] += 1
            sums[at, 1] += jump > sure
            sums[at, 2] += jump < -sure
            sums[at, 3] += abs(second[0] - first[0])
            sums[at, 4] += np.hypot(abs(second[1] - first[1]), abs(second[2] - first[2]))


@compiled
def _across(image: Ints, row: int, column: int, apart: tuple[int, int, int]) -> tuple[int, int]:
    """The pixel `apart` from another one, see `seen_across`; that one itself where all are of none or outside."""
    y, x = row, column
    for _ in range(apart[2]):
        y, x = y + apart[0], x + apart[1]
        if y >= image.shape[0] or x >= image.shape[1]:
            break
        if image[y, x] >= 0:
            return y, x
    return row, column


@compiled
def _place(codes: Codes, code: int) -> int:
    """Row of a code among ascending ones, -1 where it is not there."""
    low, high = 0, len(codes)
    while low < high:
        middle = (low + high) // 2
        if codes[middle] < code:
            low = middle + 1
        else:
            high = middle
    return low if low < len(codes) and codes[low] == code else -1


@compiled
def extremes(own: Codes, values: NDArray[np.float64], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest value of each of `count` owners, infinite for none. Shape (count,) each."""
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    for k in range(len(own)):
        low[own[k]], high[own[k]] = min(low[own[k]], values[k]), max(high[own[k]], values[k])
    return low, high
