"""CPU loops over pixels in which dense depth spends most of its time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled

Floats = NDArray[np.float32]

_ZERO, _HALF, _ONE, _BEHIND = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(1e-4)
_LEAST = np.float32(0.05)
"""Share of a pixel that counts."""
_HIDING = np.float32(0.2)
"""Share of a pixel from which a point occludes points behind it."""


@compiled
def zncc_cost(
    reference: Floats, sources: Floats, ways: tuple[Floats, Floats], depths: Floats, radius: int, noise: float
) -> Floats:
    """Return the mean matching cost of inverse depths over sources, 0.5 where no source sees the place.

    `reference` is brightness and its mean and variance in windows, shape (3, h, w); `sources` (S, h, w); `ways`, (S, 3,
    h, w) rotated and (S, 3) shifted, project pixels into them; `depths` (D, h, w) or (D, 1, 1). Shape (D, h, w).
    """
    _, height, width = reference.shape
    rotated, shift = ways
    out = np.empty((depths.shape[0], height, width), np.float32)
    total, count = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    inside, sums = np.empty((height, width), np.float32), np.empty((3, height, width), np.float32)
    line, place = np.empty((3, width + 2 * radius), np.float32), np.empty((2, width), np.float32)
    tried = np.empty(width, np.float32)
    for d in range(depths.shape[0]):
        total[:] = _ZERO
        count[:] = _ZERO
        for s in range(sources.shape[0]):
            for v in range(height):
                tried[:] = depths[d, min(v, depths.shape[1] - 1)]
                _place_row(rotated[s], shift[s], v, tried, place, inside)
                _look_up_row(sources[s], place, line, radius)
                _row_sums(line, reference, v, radius, sums)
            _add_zncc(reference, sums, inside, radius, np.float32(noise * noise), total)
            count += inside
        for v in range(height):
            for u in range(width):
                out[d, v, u] = _HALF - _HALF * total[v, u] / max(count[v, u], _ONE)
    return out


@compiled
def _place_row(to: Floats, by: Floats, v: int, inverse: Floats, place: Floats, inside: Floats) -> None:
    """Write the projections of a row's pixels into another picture, clamped to its border, and which are inside."""
    right, bottom = np.float32(to.shape[2] - 1), np.float32(to.shape[1] - 1)
    dx, dy, dz = by[0], by[1], by[2]
    for u in range(to.shape[2]):
        ratio = to[2, v, u] + inverse[u] * dz
        scale = _ONE / max(ratio, _BEHIND)
        x = (to[0, v, u] + inverse[u] * dx) * scale if ratio > _BEHIND else -_ONE
        y = (to[1, v, u] + inverse[u] * dy) * scale
        inside[v, u] = _ONE if (x >= _ZERO) & (x <= right) & (y >= _ZERO) & (y <= bottom) else _ZERO
        x, y = x if x > _ZERO else _ZERO, y if y > _ZERO else _ZERO
        place[0, u], place[1, u] = x if x < right else right, y if y < bottom else bottom


@compiled
def _look_up_row(source: Floats, place: Floats, line: Floats, radius: int) -> None:
    """Write the brightness of a picture at positions (2, w) inside it into a line, which is wider by the radius.

    Unsigned numbers are read several at a time.
    """
    height, width = source.shape
    flat, x, y, values = source.reshape(height * width), place[0], place[1], line[0]
    for u in range(len(x)):
        i, j = np.int32(x[u]), np.int32(y[u])
        a, b = x[u] - np.float32(i), y[u] - np.float32(j)
        right = np.uint32(1) if i + 1 < width else np.uint32(0)
        down = np.uint32(width) if j + 1 < height else np.uint32(0)
        at = np.uint32(j) * np.uint32(width) + np.uint32(i)
        under = np.uint32(at + down)
        above = flat[at] + (flat[np.uint32(at + right)] - flat[at]) * a
        below = flat[under] + (flat[np.uint32(under + right)] - flat[under]) * a
        values[np.uint32(radius + u)] = above + (below - above) * b


@compiled
def _row_sums(line: Floats, reference: Floats, v: int, radius: int, sums: Floats) -> None:
    """Write sums (3, h, w) over a window's columns of a row's values, their squares, and their products with grey."""
    width = reference.shape[2]
    for u in range(width):
        value = line[0, radius + u]
        line[1, radius + u] = value * value
        line[2, radius + u] = value * reference[0, v, u]
    for q in range(3):
        for u in range(radius):
            line[q, u] = line[q, radius]
            line[q, radius + width + u] = line[q, radius + width - 1]
        for u in range(width):
            sums[q, v, u] = line[q, u]
        for k in range(1, 2 * radius + 1):
            for u in range(width):
                sums[q, v, u] += line[q, u + k]


@compiled
def _add_zncc(reference: Floats, sums: Floats, inside: Floats, radius: int, noise: np.float32, total: Floats) -> None:
    """Add the correlation of windows to a total, where a source sees the place.

    Loops run over rows taken out of their arrays before, several pixels at a time.
    """
    _, height, width = reference.shape
    size, window = np.float32((2 * radius + 1) ** 2), np.empty((3, width), np.float32)
    ones, squares, products = window[0], window[1], window[2]
    for v in range(height):
        for q in range(3):
            _column_sums(sums[q], v, radius, window[q])
        mean, spread, seen, out = reference[1, v], reference[2, v], inside[v], total[v]
        for u in range(width):
            own = ones[u] / size
            varied = max(squares[u] / size - own * own, _ZERO) + noise
            cross = products[u] / size - own * mean[u]
            out[u] += cross / np.sqrt(varied * spread[u]) * seen[u]


@compiled
def _column_sums(values: Floats, v: int, radius: int, out: Floats) -> None:
    """Write sums (w,) over the rows of a window around row v of values (h, w)."""
    first = values[max(v - radius, 0)]
    for u in range(len(out)):
        out[u] = first[u]
    for k in range(v - radius + 1, v + radius + 1):
        more = values[min(max(k, 0), len(values) - 1)]
        for u in range(len(out)):
            out[u] += more[u]


@compiled
def lowest(cost: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return the position of the least of costs (D, h, w), D >= 3, by a parabola, and its whole plane; see
    `sweep.below_planes`."""
    depths, height, width = cost.shape
    place, plane = np.empty((height, width), np.float32), np.empty((height, width), np.int64)
    least, first = np.empty(width, np.float32), np.empty(width, np.int32)
    for v in range(height):
        least[:] = cost[0, v]
        first[:] = np.int32(0)
        for d in range(1, depths):
            row = cost[d, v]
            for u in range(width):
                lower = row[u] < least[u]
                least[u] = row[u] if lower else least[u]
                first[u] = np.int32(d) if lower else first[u]
        for u in range(width):
            d = min(max(int(first[u]), 1), depths - 2)
            left, middle, right = cost[d - 1, v, u], cost[d, v, u], cost[d + 1, v, u]
            curvature = max(left - np.float32(2.0) * middle + right, np.float32(1e-6))
            offset = min(max(_HALF * (left - right) / curvature, -_ONE), _ONE)
            place[v, u], plane[v, u] = np.float32(d) + offset, d
    return place, plane


@compiled
def path_costs(volume: Floats, large: Floats, small: np.float32) -> Floats:
    """Return the sums of the path costs from both ends of the first axis. Shape (n, m, D).

    `volume` is the cost of D depths at each place, (n, m, D); `large` that of a step of more than one depth from a
    place to the next, (n - 1, m), and `small` that of a step of one.
    """
    length, lines, depths = volume.shape
    out, nothing = np.empty_like(volume), np.float32(np.inf)
    path = np.full((lines, depths + 2), nothing, np.float32)
    for step in range(2 * length):
        back = step >= length
        k = 2 * length - 1 - step if back else step
        begins, gap = k == (length - 1 if back else 0), k if back else k - 1
        for j in range(lines):
            own, cost, total = path[j], volume[k, j], out[k, j]
            if begins:
                own[1:-1] = cost
            else:
                _next_on_path(own, cost, large[gap, j], small)
            if back:
                total += own[1:-1]
            else:
                total[:] = own[1:-1]
    return out


@compiled
def _next_on_path(path: Floats, cost: Floats, large: np.float32, small: np.float32) -> None:
    """Write the path costs (D + 2,), padded with infinity on either side, at the next pixel of costs (D,)."""
    least = path[1]
    for d in range(2, len(cost) + 1):
        least = min(least, path[d])
    far, left = least + large, path[0]
    for d in range(len(cost)):
        here = path[d + 1]
        best = min(min(here, far), min(left + small, path[d + 2] + small))
        left, path[d + 1] = here, cost[d] + best - least


@compiled
def fill_holes(
    inverse: Floats, radius: int, least: float, residual: float
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return where holes in flat surroundings are, and their planes. Shape (h, w) each.

    `least` pixels of the window must be known, and deviate from a plane by at most `residual` of its inverse depth.
    """
    height, width = inverse.shape
    sums = np.zeros((10, height + 1, width), np.float64)
    line, terms = np.zeros((10, width + 1), np.float64), np.empty(10, np.float64)
    for v in range(height):
        for u in range(width):
            w = np.float64(inverse[v, u])
            known = 1.0 if w > 0.0 else 0.0
            terms[0], terms[1], terms[2], terms[3] = known, known * u, known * v, known * u * u
            terms[4], terms[5], terms[6] = known * u * v, known * v * v, w
            terms[7], terms[8], terms[9] = w * u, w * v, w * w
            for c in range(10):
                line[c, u + 1] = line[c, u] + terms[c]
        for c in range(10):
            for u in range(width):
                inside = line[c, min(u + radius + 1, width)] - line[c, max(u - radius, 0)]
                sums[c, v + 1, u] = sums[c, v, u] + inside
    hole, planes = np.zeros((height, width), np.bool_), np.zeros((height, width), np.float64)
    for v in range(height):
        high, low = min(v + radius + 1, height), max(v - radius, 0)
        for u in range(width):
            n = sums[0, high, u] - sums[0, low, u]
            if inverse[v, u] > 0.0 or n <= least or not _enclosed(inverse, v, u, radius):
                continue
            for c in range(1, 10):
                terms[c] = (sums[c, high, u] - sums[c, low, u]) / max(n, 1.0)
            mu, mv, mw = terms[1], terms[2], terms[6]
            cuu, cuv, cvv = terms[3] - mu * mu + 1e-3, terms[4] - mu * mv, terms[5] - mv * mv + 1e-3
            cuw, cvw, cww = terms[7] - mu * mw, terms[8] - mv * mw, terms[9] - mw * mw
            determinant = max(cuu * cvv - cuv * cuv, 1e-9)
            a, b = (cvv * cuw - cuv * cvw) / determinant, (cuu * cvw - cuv * cuw) / determinant
            plane = mw + a * (u - mu) + b * (v - mv)
            flat = np.sqrt(max(cww - a * cuw - b * cvw, 0.0)) < residual * mw
            hole[v, u] = flat and 0.5 * mw < plane < 2.0 * mw
            planes[v, u] = plane
    return hole, planes


@compiled
def _enclosed(inverse: Floats, v: int, u: int, radius: int) -> bool:
    """Return whether a pixel is known within `radius` on the left, on the right, above and below."""
    for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        found = False
        for k in range(1, radius + 1):
            row, column = v + k * dv, u + k * du
            if 0 <= row < inverse.shape[0] and 0 <= column < inverse.shape[1] and inverse[row, column] > 0.0:
                found = True
                break
        if not found:
            return False
    return True


@compiled
def splat(inverse: Floats, sigma: Floats, rotated: Floats, shift: Floats, tolerance: float) -> tuple[Floats, Floats]:
    """Return the inverse depth and sigma of maps (M, h, w) projected into another frame: the nearest, averaged.

    Each point counts in the four pixels around it, unless it is behind the nearest by more than a `tolerance`, share
    of depth. `rotated` (M, 3, h, w) and `shift` (M, 3) project pixels. Shape (h, w) each.
    """
    count, height, width = inverse.shape
    nearest, front = np.zeros((height, width), np.float32), np.float32(1.0 - tolerance)
    mean, error, total = np.zeros_like(nearest), np.zeros_like(nearest), np.zeros_like(nearest)
    points = [_landed(inverse[m], sigma[m], rotated[m], shift[m]) for m in range(count)]
    for places in points:
        _keep_nearest(places, nearest)
    for places in points:
        _add_shares(places, front * nearest, mean, error, total)
    total = np.maximum(total, np.float32(1e-20))
    return mean / total, error / total


@compiled
def _keep_nearest(places: Floats, nearest: Floats) -> None:
    """Write the greatest inverse depth of the points on each pixel."""
    height, width = nearest.shape
    for k in range(places.shape[1]):
        column, row, right, down = _corner(places[0, k], places[1, k])
        for n in range(4):
            u, v, share = column + n % 2, row + n // 2, _share(right, down, n)
            if share > _HIDING and 0 <= u < width and 0 <= v < height and places[2, k] > nearest[v, u]:
                nearest[v, u] = places[2, k]


@compiled
def _add_shares(places: Floats, front: Floats, mean: Floats, error: Floats, total: Floats) -> None:
    """Add the weighted points around each pixel that are before its `front`."""
    height, width = front.shape
    for k in range(places.shape[1]):
        column, row, right, down = _corner(places[0, k], places[1, k])
        inverse, sigma = places[2, k], places[3, k]
        sure = _ONE / (sigma * sigma)
        for n in range(4):
            u, v, share = column + n % 2, row + n // 2, _share(right, down, n)
            if share > _LEAST and 0 <= u < width and 0 <= v < height and inverse > front[v, u]:
                weight = share * sure
                total[v, u] += weight
                mean[v, u] += weight * inverse
                error[v, u] += weight * sigma


@compiled
def _landed(inverse: Floats, sigma: Floats, to: Floats, by: Floats) -> Floats:
    """Return positions (x, y) in another frame of the points of a map, their inverse depth there and sigma. (4, N)."""
    height, width = inverse.shape
    out, count = np.empty((4, height * width), np.float32), 0
    for v in range(height):
        for u in range(width):
            w = inverse[v, u]
            ratio = to[2, v, u] + w * by[2]
            if w <= _ZERO or ratio <= np.float32(1e-3):
                continue
            x, y = (to[0, v, u] + w * by[0]) / ratio, (to[1, v, u] + w * by[1]) / ratio
            if -_ONE <= x <= width and -_ONE <= y <= height:
                out[0, count], out[1, count], out[2, count], out[3, count] = x, y, w / ratio, sigma[v, u]
                count += 1
    return out[:, :count]


@compiled
def _corner(x: np.float32, y: np.float32) -> tuple[int, int, np.float32, np.float32]:
    """Return column and row of the pixel left above a position, and the offset right and below it."""
    column, row = int(np.floor(x)), int(np.floor(y))
    return column, row, x - np.float32(column), y - np.float32(row)


@compiled
def _share(right: np.float32, down: np.float32, n: int) -> np.float32:
    """Return the bilinear share of one of the four pixels around a position."""
    return (right if n % 2 else _ONE - right) * (down if n // 2 else _ONE - down)


@compiled
def enlarged(
    small: tuple[Floats, Floats, Floats], full: Floats, edge: np.float32, step: np.float32
) -> tuple[Floats, Floats]:
    """Return inverse depth and sigma of a map at the size of the picture `full` (H, W), see `fusion.enlarge`.

    `small` is inverse depth, sigma and brightness (h, w).
    """
    inverse, sigma, gray = small
    height, width = inverse.shape
    out, unsure = np.zeros(full.shape, np.float32), np.zeros(full.shape, np.float32)
    tall, wide = np.float32(height / full.shape[0]), np.float32(width / full.shape[1])
    value, weight, error = np.empty(4, np.float32), np.empty(4, np.float32), np.empty(4, np.float32)
    for v in range(full.shape[0]):
        y = (np.float32(v) + _HALF) * tall - _HALF
        top = np.floor(y)
        for u in range(full.shape[1]):
            x = (np.float32(u) + _HALF) * wide - _HALF
            left, known, best, most = np.floor(x), 0, _ZERO, -_ONE
            for n in range(4):
                low, across = top + np.float32(n // 2), left + np.float32(n % 2)
                row, column = min(max(int(low), 0), height - 1), min(max(int(across), 0), width - 1)
                value[n], error[n] = inverse[row, column], sigma[row, column]
                near = (_ONE - abs(y - low)) * (_ONE - abs(x - across))
                alike = np.exp(-abs(gray[row, column] - full[v, u]) / edge) if value[n] > _ZERO else _ZERO
                weight[n] = near * alike + np.float32(1e-6) if value[n] > _ZERO else _ZERO
                known += value[n] > _ZERO
                best = value[n] if weight[n] > most else best
                most = max(most, weight[n])
            if known < 2:
                continue
            total, mean, doubt = _ZERO, _ZERO, _ZERO
            for n in range(4):
                share = weight[n] if abs(value[n] - best) < step * best else _ZERO
                total += share
                mean += share * value[n]
                doubt += share * error[n]
            total = max(total, np.float32(1e-12))
            out[v, u], unsure[v, u] = mean / total, doubt / total
    return out, unsure
