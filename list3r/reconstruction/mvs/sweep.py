"""Plane sweep of one keyframe: matching cost of many depths, aggregated along paths, and refined between planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from list3r.reconstruction.mvs.images import Tensor, Warp, box_sum, greatest_around, look_up, stacked
from list3r.reconstruction.mvs.kernels import lowest, path_costs, zncc_cost
from list3r.reconstruction.mvs.settings import SweepSettings


@dataclass(frozen=True)
class DepthMatch:
    """The match of one keyframe with its sources. All images share their shape (h, w)."""

    inverse_depth: Tensor
    """1 / chunk units."""
    cost: Tensor
    """Matching cost of the chosen depth in [0, 1]: (1 - ZNCC) / 2 of the better half of the sources."""
    margin: Tensor
    """Cost of the best different depth less that of the chosen one."""
    texture: Tensor
    """Variance of brightness in the window over that of noise."""
    doubt: Tensor
    """Where it is unknown which of two surfaces is seen. Shape (h, w), bool."""


@dataclass(frozen=True)
class CoarseDepth:
    """Depth of a keyframe by the planes."""

    inverse: Tensor
    """Inverse depth, 1 / chunk units. Shape (h, w)."""
    margin: Tensor
    """Cost of the best different depth less that of the chosen one. Shape (h, w)."""
    spacing: float
    """Inverse depth from one plane to the next."""


@dataclass(frozen=True)
class SweepReference:
    """A keyframe with its window sums, ready to be compared."""

    gray: Tensor
    mean: Tensor
    spread: Tensor
    """Variance of brightness in the window, noise added."""

    @staticmethod
    def of(gray: Tensor, radius: int, noise: float) -> SweepReference:
        """Sums over windows of an image (h, w)."""
        count = float((2 * radius + 1) ** 2)
        mean = box_sum(gray, radius) / count
        variance = (box_sum(gray * gray, radius) / count - mean * mean).clamp_min(0.0)
        return SweepReference(gray, mean, variance + noise * noise)


def matching_cost(
    reference: SweepReference, sources: Sequence[Tensor], warps: Sequence[Warp], depths: Tensor, settings: SweepSettings
) -> Tensor:
    """Cost in [0, 1] of inverse depths (D, 1, 1) or (D, h, w). Shape (D, h, w).

    ZNCC over windows (Kanade and Okutomi 1994 name the windows, Collins 1996 the sweep) with noise in the variances,
    so that flat windows cost 0.5. The sources are in two groups, each of which may be occluded (Kang, Szeliski and Chai
    2001): the better group counts for most.
    """
    groups = [sources[0::2], sources[1::2]], [warps[0::2], warps[1::2]]
    means = [
        _group_cost(reference, some, theirs, depths, settings)
        for some, theirs in zip(*groups, strict=True)
        if len(some)
    ]
    if len(means) == 1:
        return means[0]
    return 0.75 * torch.minimum(means[0], means[1]) + 0.25 * torch.maximum(means[0], means[1])


def _group_cost(
    reference: SweepReference, sources: Sequence[Tensor], warps: Sequence[Warp], depths: Tensor, settings: SweepSettings
) -> Tensor:
    if depths.device.type != "cpu":
        return _cost_of_tensors(reference, sources, warps, depths, settings)
    known = stacked([reference.gray, reference.mean, reference.spread])
    places = stacked([w.rotated for w in warps]), stacked([w.shift for w in warps])
    tried = np.ascontiguousarray(depths.numpy(), np.float32)
    cost = zncc_cost(known, stacked(sources), places, tried, settings.radius_px, settings.image_noise)
    return torch.from_numpy(cost)


def _cost_of_tensors(
    reference: SweepReference, sources: Sequence[Tensor], warps: Sequence[Warp], depths: Tensor, settings: SweepSettings
) -> Tensor:
    """Return the same on an accelerator."""
    shape = (depths.shape[0], *reference.gray.shape)
    total = torch.zeros(shape, device=reference.gray.device)
    count = torch.zeros_like(total)
    for source, warp in zip(sources, warps, strict=True):
        x, y, _ = warp.place(depths)
        values, inside = look_up(source, x.expand(shape), y.expand(shape))
        total += _zncc(reference, values, settings) * inside
        count += inside
    return torch.where(count > 0, 0.5 - 0.5 * total / count.clamp_min(1.0), torch.full((), 0.5, device=total.device))


def _zncc(reference: SweepReference, values: Tensor, settings: SweepSettings) -> Tensor:
    size = float((2 * settings.radius_px + 1) ** 2)
    mean = box_sum(values, settings.radius_px) / size
    square = box_sum(values * values, settings.radius_px) / size
    cross = box_sum(values * reference.gray, settings.radius_px) / size
    spread = (square - mean * mean).clamp_min_(0.0).add_(settings.image_noise**2)
    return (cross - mean * reference.mean) * torch.rsqrt(spread * reference.spread)


def aggregate(cost: Tensor, gray: Tensor, settings: SweepSettings) -> Tensor:
    """Sum of path costs from four sides (Hirschmueller 2008), over their number. Shape (D, h, w)."""
    volume = cost.permute(1, 2, 0).contiguous()
    down = _paths(volume, gray, settings)
    across = _paths(volume.transpose(0, 1).contiguous(), gray.T.contiguous(), settings).transpose(0, 1)
    return ((down + across) * 0.25).permute(2, 0, 1).contiguous()


def _paths(volume: Tensor, gray: Tensor, settings: SweepSettings) -> Tensor:
    """Path costs along the first axis, from both ends, summed. Shape (n, m, D)."""
    if volume.device.type != "cpu":
        return _paths_of_tensors(volume, gray, settings)
    large = _larger_steps(gray, settings).numpy()
    return torch.from_numpy(path_costs(volume.numpy(), large, np.float32(settings.path_small)))


def _larger_steps(gray: Tensor, settings: SweepSettings) -> Tensor:
    """Return the cost of a step of more than one depth from each pixel to the next. Shape (n - 1, m)."""
    change = (gray[1:] - gray[:-1]).abs()
    return (settings.path_large / (1.0 + change / settings.path_edge)).clamp_min(1.5 * settings.path_small)


def _paths_of_tensors(volume: Tensor, gray: Tensor, settings: SweepSettings) -> Tensor:
    """Return the same on an accelerator."""
    length, large = volume.shape[0], _larger_steps(gray, settings)
    both = torch.stack([volume, volume.flip(0)], dim=1)
    large = torch.stack([large, large.flip(0)], dim=1)[..., None]
    out = torch.empty_like(both)
    out[0] = both[0]
    for k in range(1, length):
        before = out[k - 1]
        least = before.amin(dim=-1, keepdim=True)
        best = torch.minimum(before, least + large[k - 1])
        best[..., 1:] = torch.minimum(best[..., 1:], before[..., :-1] + settings.path_small)
        best[..., :-1] = torch.minimum(best[..., :-1], before[..., 1:] + settings.path_small)
        out[k] = both[k] + best - least
    return out[:, 0] + out[:, 1].flip(0)


def below_planes(cost: Tensor) -> tuple[Tensor, Tensor]:
    """Position of the least of costs (D, h, w) by a parabola, and its whole plane. Shape (h, w) each."""
    if cost.device.type == "cpu":
        found, number = lowest(cost.contiguous().numpy())
        return torch.from_numpy(found), torch.from_numpy(number)
    return _below_planes_of_tensors(cost)


def _below_planes_of_tensors(cost: Tensor) -> tuple[Tensor, Tensor]:
    """Return the same on an accelerator."""
    best = cost.argmin(dim=0, keepdim=True).clamp(1, cost.shape[0] - 2)
    left, middle, right = (cost.gather(0, best + k)[0] for k in (-1, 0, 1))
    bend = (left - 2.0 * middle + right).clamp_min(1e-6)
    offset = (0.5 * (left - right) / bend).clamp(-1.0, 1.0)
    return best[0] + offset, best[0]


def coarse_match(reference: SweepReference, cost: Tensor, settings: SweepSettings) -> tuple[Tensor, Tensor]:
    """Plane number (with a fraction) of each pixel by costs (D, h, w), and the margin of the choice. Shape (h, w)."""
    place, plane = below_planes(aggregate(cost, reference.gray, settings))
    number = torch.arange(len(cost), device=cost.device)[:, None, None]
    other = torch.where((number - plane).abs() <= 2, torch.full((), 1.0, device=cost.device), cost).amin(dim=0)
    return place, other - cost.gather(0, plane[None])[0]


def choose_at_edges(
    gray: Tensor,
    sources: Sequence[Tensor],
    warps: Sequence[Warp],
    start: Tensor,
    spacing: float,
    settings: SweepSettings,
) -> tuple[Tensor, Tensor]:
    """Inverse depths (h, w), kept or replaced by those of the nearest or farthest surface close by; and where that
    is in doubt.

    The smallest windows decide, and neighbours are weighted by similar brightness (adaptive support weights, Yoon and
    Kweon 2006): coarse windows make the foreground too wide.
    """
    front, back = greatest_around(start, settings.edge_reach_px), -greatest_around(-start, settings.edge_reach_px)
    small = replace(settings, radius_px=1)
    depths = torch.stack([start, front, back])
    cost = matching_cost(SweepReference.of(gray, 1, settings.image_noise), sources, warps, depths, small)
    cost = _alike_mean(cost, gray, settings)
    chosen = depths.gather(0, cost.argmin(dim=0, keepdim=True))[0]
    apart = torch.where((depths - chosen).abs() > spacing, cost, torch.full((), 2.0, device=cost.device))
    edge = front - back > 2.0 * spacing
    doubt = edge & (apart.amin(dim=0) - cost.amin(dim=0) < settings.edge_doubt)
    return torch.where(edge, chosen, start), doubt


def _alike_mean(values: Tensor, gray: Tensor, settings: SweepSettings, radius: int = 6, step: int = 2) -> Tensor:
    """Means of values (C, h, w) over a window, weighted by similarity of brightness to its middle."""
    height, width = gray.shape
    padded = torch.nn.functional.pad(values[None], (radius,) * 4, mode="replicate")[0]
    around = torch.nn.functional.pad(gray[None, None], (radius,) * 4, mode="replicate")[0, 0]
    total, weight = torch.zeros_like(values), torch.zeros_like(gray)
    for j in range(0, 2 * radius + 1, step):
        for i in range(0, 2 * radius + 1, step):
            rows, columns = slice(j, j + height), slice(i, i + width)
            far = ((j - radius) ** 2 + (i - radius) ** 2) ** 0.5 / radius
            w = torch.exp((around[rows, columns] - gray).abs_().mul_(-1.0 / settings.edge_likeness).sub_(far))
            total += w * padded[:, rows, columns]
            weight += w
    return total / weight


def refine(
    reference: SweepReference,
    sources: Sequence[Tensor],
    warps: Sequence[Warp],
    coarse: CoarseDepth,
    settings: SweepSettings,
) -> DepthMatch:
    """Return better inverse depths: windows follow the slopes of the depth found so far, which then are no bias."""
    start, spacing = coarse.inverse, coarse.spacing
    inverse, doubt = choose_at_edges(reference.gray, sources, warps, start, spacing, settings)
    least = 0.02 * spacing
    offsets = torch.arange(-2, 3, device=start.device, dtype=torch.float32)[:, None, None]
    cost = torch.zeros((), device=start.device)
    for share in settings.refine_steps:
        step = share * spacing
        depths = (inverse + offsets * step).clamp_min(least)
        raw = matching_cost(reference, sources, warps, depths, settings)
        smooth = box_sum(raw, 1) / 9.0
        place, plane = below_planes(smooth)
        inverse = (inverse + (place - 2.0) * step).clamp_min(least)
        inverse = _median(inverse)
        cost = raw.gather(0, plane[None])[0]
    texture = reference.spread / settings.image_noise**2 - 1.0
    return DepthMatch(inverse, cost, coarse.margin, texture, doubt)


def _median(inverse: Tensor) -> Tensor:
    """Median of each pixel and its four neighbours: removes single errors, keeps edges. Shape (h, w)."""
    shifted = torch.nn.functional.pad(inverse[None, None], (1,) * 4, mode="replicate")[0, 0]
    height, width = inverse.shape
    around = [shifted[1 + j : 1 + j + height, 1 + i : 1 + i + width] for j, i in _CROSS]
    return torch.stack(around).median(dim=0).values


_CROSS = ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
