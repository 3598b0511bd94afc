"""Depth of several keyframes checked against each other, fused, filled, and projected into every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from list3r.reconstruction.mvs.images import Tensor, Warp, box_sum, greatest_around, look_up, stacked
from list3r.reconstruction.mvs.kernels import enlarged, fill_holes, splat
from list3r.reconstruction.mvs.settings import DepthFusionSettings

_NEAREST = 1e9
"""Inverse depth of unknown pixels where the least is searched."""


@dataclass(frozen=True)
class DepthMap:
    """Depth of one frame at the refined width. Shape (h, w) each."""

    inverse: Tensor
    """1 / chunk units; 0 where unknown."""
    sigma: Tensor
    """Its standard deviation, share of depth; 0 where unknown."""


@dataclass(frozen=True)
class SweptDepth:
    """A keyframe's own depth before it is checked against the others."""

    inverse: Tensor
    """Shape (h, w)."""
    sigma: Tensor
    """Standard deviation of the inverse depth by parallax and texture. Shape (h, w)."""
    known: Tensor
    """Where the match is valid. Shape (h, w), bool."""


def agree_and_fuse(
    seen: SweptDepth, others: Sequence[SweptDepth], warps: Sequence[Warp], settings: DepthFusionSettings
) -> DepthMap:
    """Return a keyframe's depth where other keyframes confirm it, averaged with theirs."""
    inverse, variance = seen.inverse, seen.sigma**2
    total, weight = inverse / variance, 1.0 / variance
    square = inverse * total
    agree, deny, sampled = (torch.zeros_like(inverse) for _ in range(3))
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
        sampled += inside
        deny += seen_there & (difference < -2.0 * limit)
        w = near / (theirs * gain).clamp_min(1e-9) ** 2
        total += w * (inverse + difference)
        square += w * (inverse + difference) ** 2
        weight += w
    mean = total / weight
    scatter = (square / weight - mean * mean).clamp_min(0.0)
    needed = sampled.clamp(1.0, float(settings.least_agree))
    keep = seen.known & (agree >= needed) & (agree > deny)
    noise = variance / (1.0 + 0.5 * agree) + scatter / (1.0 + agree)
    sigma = torch.sqrt(noise) / mean.clamp_min(1e-9) + settings.drift
    zero = torch.zeros((), device=mean.device)
    return DepthMap(torch.where(keep, mean, zero), torch.where(keep, sigma, zero))


def fill_flat(depth: DepthMap, settings: DepthFusionSettings) -> DepthMap:
    """Fill small holes in flat surroundings with the plane of the known pixels around, at high sigma.

    Inverse depth of a plane is linear in the pixel's position, so the plane is a regression by window sums.
    """
    inverse, radius = depth.inverse.cpu().numpy(), settings.fill_radius_px
    hole, plane = fill_holes(inverse, radius, settings.fill_share * (2 * radius + 1) ** 2, settings.fill_residual)
    filled = np.where(hole, plane.astype(np.float32), inverse)
    unsure = np.where(hole, np.float32(settings.fill_sigma), depth.sigma.cpu().numpy())
    device = depth.inverse.device
    return DepthMap(torch.from_numpy(filled).to(device), torch.from_numpy(unsure).to(device))


def project_depth(maps: Sequence[DepthMap], warps: Sequence[Warp], settings: DepthFusionSettings) -> DepthMap:
    """Depth of keyframes projected into another frame: the nearest in each pixel, averaged. `warps` lead into it."""
    inverse, sigma = stacked([m.inverse for m in maps]), stacked([m.sigma for m in maps])
    rotated, shift = stacked([w.rotated for w in warps]), stacked([w.shift for w in warps])
    found = splat(inverse, sigma, rotated, shift, settings.projected_tolerance)
    return DepthMap(*(torch.from_numpy(image).to(maps[0].inverse.device) for image in found))


def enlarge(depth: DepthMap, gray: Tensor, full: Tensor, edge: float, step: float) -> tuple[Tensor, Tensor]:
    """Inverse depth and sigma at the size of the picture `full` (H, W), by joint bilateral upsampling.

    Kopf et al. 2007: each large pixel takes the four small ones around it, those of its own brightness most; where
    they are on two surfaces (`step` apart, share of depth) those of the surface that fits better.
    """
    if full.device.type == "cpu":
        small = depth.inverse.numpy(), depth.sigma.numpy(), np.ascontiguousarray(gray.numpy())
        found = enlarged(small, np.ascontiguousarray(full.numpy()), np.float32(edge), np.float32(step))
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])
    return _enlarged_tensors(depth, gray, full, edge, step)


def _enlarged_tensors(depth: DepthMap, gray: Tensor, full: Tensor, edge: float, step: float) -> tuple[Tensor, Tensor]:
    """Return the same on an accelerator."""
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
    """Depth without pixels that have few neighbours of about the same depth."""
    known = (depth.inverse > 0).float()
    radius = settings.speckle_radius_px
    alone = box_sum(known, radius) < settings.speckle_share * (2 * radius + 1) ** 2
    zero = torch.zeros((), device=known.device)
    return DepthMap(torch.where(alone, zero, depth.inverse), torch.where(alone, zero, depth.sigma))


def rims_out(depth: DepthMap, reach: int, step: float) -> DepthMap:
    """Depth without the outer pixels of foreground surfaces: within `reach` px of a `step` of depth.

    Windows at an outline contain both surfaces, so that the foreground comes out too wide (research/colour-video 0187).
    `step` is a share of depth, beyond the change of a plane there.
    """
    inverse, known = depth.inverse, depth.inverse > 0
    none = torch.full((), _NEAREST, device=inverse.device)
    least, greatest = -greatest_around(-torch.where(known, inverse, none), reach), greatest_around(inverse, reach)
    rim = known & (2.0 * inverse - least - greatest > step * inverse)
    zero = torch.zeros((), device=inverse.device)
    return DepthMap(torch.where(rim, zero, inverse), torch.where(rim, zero, depth.sigma))
