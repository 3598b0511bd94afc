"""Depth of several keyframes held against one another, fused, filled, and carried to every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from list3r.reconstruction.mvs.images import Tensor, Warp, box_sum, look_up
from list3r.reconstruction.mvs.settings import DepthFusionSettings


@dataclass(frozen=True)
class DepthMap:
    """Depth of one frame at the refined width. Shape (h, w) each."""

    inverse: Tensor
    """1 / chunk units; 0 where unknown."""
    sigma: Tensor
    """Its standard deviation, share of depth; 0 where unknown."""


@dataclass(frozen=True)
class SweptDepth:
    """A keyframe's own depth before it is held against the others."""

    inverse: Tensor
    """Shape (h, w)."""
    sigma: Tensor
    """Standard deviation of the inverse depth by parallax and texture. Shape (h, w)."""
    known: Tensor
    """Where the match means something. Shape (h, w), bool."""


def agree_and_fuse(
    seen: SweptDepth, others: Sequence[SweptDepth], warps: Sequence[Warp], settings: DepthFusionSettings
) -> DepthMap:
    """Return what other keyframes confirm of a keyframe's depth, averaged with theirs."""
    inverse, variance = seen.inverse, seen.sigma**2
    total, weight = inverse / variance, 1.0 / variance
    square = inverse * total
    agree, deny, looked = (torch.zeros_like(inverse) for _ in range(3))
    for other, warp in zip(others, warps, strict=True):
        x, y, ratio = warp.place(inverse)
        read, inside = look_up(other.inverse, x, y, "nearest")
        known, _ = look_up(other.known.float(), x, y, "nearest")
        theirs, _ = look_up(other.sigma, x, y, "nearest")
        gain = ratio * ratio / warp.rotated[2].clamp_min(1e-3)
        difference = (read - inverse / ratio.clamp_min(1e-4)) * gain
        spread = torch.sqrt(variance + (theirs * gain) ** 2 + (settings.drift * inverse) ** 2)
        limit = torch.minimum(settings.gate * spread, settings.most_gate * inverse)
        seen_there = inside & (known > 0.5)
        near = seen_there & (difference.abs() < limit)
        agree += near
        looked += inside
        deny += seen_there & (difference < -2.0 * limit)
        w = near / (theirs * gain).clamp_min(1e-9) ** 2
        total += w * (inverse + difference)
        square += w * (inverse + difference) ** 2
        weight += w
    mean = total / weight
    scatter = (square / weight - mean * mean).clamp_min(0.0)
    needed = looked.clamp(1.0, float(settings.least_agree))
    keep = seen.known & (agree >= needed) & (agree > deny)
    noise = variance / (1.0 + 0.5 * agree) + scatter / (1.0 + agree)
    sigma = torch.sqrt(noise) / mean.clamp_min(1e-9) + settings.drift
    zero = torch.zeros((), device=mean.device)
    return DepthMap(torch.where(keep, mean, zero), torch.where(keep, sigma, zero))


def fill_flat(depth: DepthMap, settings: DepthFusionSettings) -> DepthMap:
    """Small holes in flat surroundings filled with the plane of what is known around them, and said to be unsure.

    Inverse depth of a plane is linear in the pixel's place, so the plane is a regression by window sums.
    """
    known = (depth.inverse > 0).to(torch.float64)
    height, width = known.shape
    v, u = torch.meshgrid(
        torch.arange(height, device=known.device, dtype=torch.float64),
        torch.arange(width, device=known.device, dtype=torch.float64),
        indexing="ij",
    )
    w = depth.inverse.to(torch.float64)
    radius = settings.fill_radius_px
    stack = torch.stack(
        [known, known * u, known * v, known * u * u, known * u * v, known * v * v, w, w * u, w * v, w * w]
    )
    n, su, sv, suu, suv, svv, sw, swu, swv, sww = _window_sums(stack, radius)
    count = n.clamp_min(1.0)
    mu, mv, mw = su / count, sv / count, sw / count
    cuu, cuv, cvv = suu / count - mu * mu + 1e-3, suv / count - mu * mv, svv / count - mv * mv + 1e-3
    cuw, cvw, cww = swu / count - mu * mw, swv / count - mv * mw, sww / count - mw * mw
    determinant = (cuu * cvv - cuv * cuv).clamp_min(1e-9)
    a = (cvv * cuw - cuv * cvw) / determinant
    b = (cuu * cvw - cuv * cuw) / determinant
    residual = torch.sqrt((cww - a * cuw - b * cvw).clamp_min(0.0))
    plane = mw + a * (u - mu) + b * (v - mv)
    flat = (residual < settings.fill_residual * mw) & (plane > 0.5 * mw) & (plane < 2.0 * mw)
    enclosed = _enclosed(depth.inverse > 0, radius)
    hole = (known == 0) & enclosed & flat & (n > settings.fill_share * (2 * radius + 1) ** 2)
    inverse = torch.where(hole, plane.to(depth.inverse.dtype), depth.inverse)
    unsure = torch.full((), settings.fill_sigma, device=inverse.device)
    return DepthMap(inverse, torch.where(hole, unsure, depth.sigma))


def _enclosed(known: Tensor, radius: int) -> Tensor:
    """Return where something is known within `radius` on the left, on the right, above and below.

    Shape (h, w), bool.
    """
    values = known.float()[None, None]
    out = torch.ones_like(known)
    for pad, kernel in (
        ((radius, 0, 0, 0), (1, radius + 1)),
        ((0, radius, 0, 0), (1, radius + 1)),
        ((0, 0, radius, 0), (radius + 1, 1)),
        ((0, 0, 0, radius), (radius + 1, 1)),
    ):
        padded = torch.nn.functional.pad(values, pad)
        out &= torch.nn.functional.max_pool2d(padded, kernel, 1)[0, 0] > 0
    return out


def _window_sums(values: Tensor, radius: int) -> Tensor:
    """Sums over windows of 2 radius + 1 squared, zero outside, by running totals. Shape (C, h, w)."""
    for dim in (-1, -2):
        length = values.shape[dim]
        before = torch.zeros_like(values.narrow(dim, 0, 1))
        total = torch.cat([before, values.cumsum(dim)], dim=dim)
        at = torch.arange(length, device=values.device)
        high, low = (at + radius + 1).clamp_max(length), (at - radius).clamp_min(0)
        values = total.index_select(dim, high) - total.index_select(dim, low)
    return values


def carry(maps: Sequence[DepthMap], warps: Sequence[Warp], settings: DepthFusionSettings) -> DepthMap:
    """Depth of keyframes as another frame sees it: what is nearest in each pixel, averaged. `warps` lead into it."""
    height, width = maps[0].inverse.shape
    device, size = maps[0].inverse.device, height * width
    index, inverse, sigma, share = (torch.cat(parts) for parts in zip(*map(_splat, maps, warps), strict=True))
    nearest = torch.zeros(size, device=device).scatter_reduce_(0, index, inverse, "amax")
    keep = inverse > (1.0 - settings.carried_tolerance) * nearest[index]
    weight = torch.where(keep, share / sigma**2, torch.zeros((), device=device))
    total = torch.zeros(size, device=device).index_add_(0, index, weight)
    mean = torch.zeros(size, device=device).index_add_(0, index, weight * inverse) / total.clamp_min(1e-20)
    error = torch.zeros(size, device=device).index_add_(0, index, weight * sigma) / total.clamp_min(1e-20)
    return DepthMap(mean.reshape(height, width), error.reshape(height, width))


def _splat(depth: DepthMap, warp: Warp) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels, inverse depth, sigma and bilinear share of a keyframe's points in another frame, four pixels each."""
    height, width = depth.inverse.shape
    known = torch.nonzero(depth.inverse.flatten() > 0)[:, 0]
    x, y, ratio = (value.flatten().index_select(0, known) for value in warp.place(depth.inverse))
    inverse, sigma = (value.flatten().index_select(0, known) for value in (depth.inverse, depth.sigma))
    inverse = inverse / ratio.clamp_min(1e-4)
    left, top = torch.floor(x), torch.floor(y)
    parts = []
    for j in (0, 1):
        for i in (0, 1):
            column, row = left + i, top + j
            share = (1.0 - (x - column).abs()) * (1.0 - (y - row).abs())
            ok = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (ratio > 1e-3) & (share > 0.05)
            rows = torch.nonzero(ok)[:, 0]
            index = (row * width + column).long()
            parts.append(tuple(value.index_select(0, rows) for value in (index, inverse, sigma, share)))
    index, inverse, sigma, share = (torch.cat(part) for part in zip(*parts, strict=True))
    return index, inverse, sigma, share


def enlarge(depth: DepthMap, gray: Tensor, full: Tensor, edge: float, step: float) -> tuple[Tensor, Tensor]:
    """Inverse depth and sigma at the size of the picture `full` (H, W), by joint bilateral upsampling.

    Kopf et al. 2007: each large pixel takes the four small ones around it, those of its own brightness most; where
    they lie on two surfaces (`step` apart, share of depth) those of the surface that fits better.
    """
    height, width = depth.inverse.shape
    H, W = full.shape
    y = (torch.arange(H, device=full.device) + 0.5) * (height / H) - 0.5
    x = (torch.arange(W, device=full.device) + 0.5) * (width / W) - 0.5
    top, left = torch.floor(y).long(), torch.floor(x).long()
    zero = torch.zeros((), device=full.device)
    values, weights, sigmas = [], [], []
    best, most = torch.zeros_like(full), torch.full_like(full, -1.0)
    for j in (0, 1):
        for i in (0, 1):
            row, column = (top + j).clamp(0, height - 1), (left + i).clamp(0, width - 1)
            near = (1.0 - (y - (top + j)).abs())[:, None] * (1.0 - (x - (left + i)).abs())[None]
            pick = (row[:, None], column[None])
            inverse = depth.inverse[pick]
            likeness = torch.exp(-(gray[pick] - full).abs() / edge)
            weight = torch.where(inverse > 0, near * likeness + 1e-6, zero)
            best = torch.where(weight > most, inverse, best)
            most = torch.maximum(weight, most)
            weights.append(weight)
            values.append(inverse)
            sigmas.append(depth.sigma[pick])
    known = torch.zeros_like(full)
    total, mean, sigma = torch.zeros_like(full), torch.zeros_like(full), torch.zeros_like(full)
    for inverse, weight, unsure in zip(values, weights, sigmas, strict=True):
        weight = torch.where((inverse - best).abs() < step * best, weight, zero)
        known += inverse > 0
        total += weight
        mean += weight * inverse
        sigma += weight * unsure
    total = total.clamp_min(1e-12)
    return torch.where(known >= 2, mean / total, zero), torch.where(known >= 2, sigma / total, zero)


def speckles_out(depth: DepthMap, settings: DepthFusionSettings) -> DepthMap:
    """Depth without pixels that few neighbours of about the same depth surround."""
    known = (depth.inverse > 0).float()
    radius = settings.speckle_radius_px
    alone = box_sum(known, radius) < settings.speckle_share * (2 * radius + 1) ** 2
    zero = torch.zeros((), device=known.device)
    return DepthMap(torch.where(alone, zero, depth.inverse), torch.where(alone, zero, depth.sigma))
