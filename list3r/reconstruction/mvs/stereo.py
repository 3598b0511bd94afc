"""Dense depth of a chunk of RGB frames whose poses are known: plane sweep, consistency, fusion.

Keyframes are swept (`sweep`): ZNCC at a coarse width over all depths, paths, refinement at the working width; where
matches are doubtful, a network reads the same costs and the picture (`network`). Depth that other keyframes confirm is
kept and fused (`fusion`), flat holes are filled at low confidence (`fill`), and every frame gets the depth of the
around it. Depth without parallax, or with no texture near it, stays unknown (decisions 0068, 0199).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.reconstruction.base import DepthNoise
from list3r.reconstruction.mvs.fill import fill_regions
from list3r.reconstruction.mvs.fusion import (
    DepthMap,
    SweptDepth,
    agree_and_fuse,
    enlarge,
    fill_flat,
    project_depth,
    rims_out,
    speckles_out,
)
from list3r.reconstruction.mvs.images import Pictures, Poses, Tensor, Warp, box_sum, make_pictures, sharpness
from list3r.reconstruction.mvs.network import load_network, predict_depth, side_features
from list3r.reconstruction.mvs.settings import (
    MatchTrustSettings,
    MvsSettings,
    SweepNetworkSettings,
)
from list3r.reconstruction.mvs.sweep import (
    CoarseDepth,
    DepthMatch,
    SweepReference,
    coarse_match,
    matching_cost,
    refine,
)
from list3r.reconstruction.mvs.views import (
    ViewPairs,
    choose_keyframes,
    choose_neighbours,
    choose_projected,
    choose_sources,
    pair_views,
    plane_depths,
    seen_parts,
)

__all__ = ["KeyframeCosts", "MvsSettings", "PosedFrames", "Sparse", "dense_depth", "keyframe_costs", "stereo_noise"]

Sparse = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Pixels (N, 2) and depths (N,) of a frame's triangulated points."""


@dataclass(frozen=True)
class _Chunk:
    """Inputs of every step."""

    frames: Sequence[Frame]
    T_chunk_cam: Poses
    coarse: Pictures
    fine: Pictures
    keyframes: list[int]
    pairs: ViewPairs
    parts: NDArray[np.bool_]
    """See `seen_parts`. Shape (F, K, N)."""
    depth: NDArray[np.float64]
    """Typical depth of each frame, chunk units. Shape (F,)."""
    span: tuple[float, float]
    """Nearest and farthest depth of the search, chunk units."""
    sharp: NDArray[np.float64]
    device: str
    settings: MvsSettings


@dataclass(frozen=True)
class KeyframeCosts:
    """How well each depth matches in a keyframe, at the coarse width."""

    key: int
    """Number of its frame."""
    sources: list[int]
    reference: SweepReference
    planes: NDArray[np.float32]
    """Inverse depths, evenly spaced. Shape (D,)."""
    cost: Tensor
    """In [0, 1]. Shape (D, h, w)."""
    parallax_px: float
    """Pixels that one unit of inverse depth moves a point."""

    @property
    def span(self) -> tuple[float, float]:
        """Least and greatest inverse depth."""
        return float(self.planes[0]), float(self.planes[-1])

    def side_features(self) -> NDArray[np.float32]:
        """Return the network's inputs other than costs and picture. Shape (3,)."""
        return side_features(self.span, self.parallax_px, len(self.sources))


@dataclass(frozen=True)
class PosedFrames:
    """Frames of one camera with their poses."""

    frames: Sequence[Frame]
    posed: NDArray[np.bool_]
    """Frames with a valid pose; the others get no depth. Shape (F,)."""
    T_chunk_cam: Poses
    """Shape (F, 4, 4)."""
    camera: Camera
    sparse: Sequence[Sparse | None] | None = None
    """Triangulated points of each frame where there are some: they bound the searched depths."""


def dense_depth(
    given: PosedFrames, settings: MvsSettings | None = None, device: str = "cpu"
) -> tuple[NDArray[np.float32], NDArray[np.float16]]:
    """Return depth along z, chunk units, 0 where unknown, and confidence of every frame. Shape (F, H, W) each.

    Confidence in [0, 1] is 1 / (1 + (sigma / half_sigma)^2) of the expected deviation.
    """
    frames, camera = given.frames, given.camera
    shape = (len(frames), camera.height, camera.width)
    depth, confidence = np.zeros(shape, np.float32), np.zeros(shape, np.float16)
    if int(given.posed.sum()) < 3:
        return depth, confidence
    with torch.inference_mode(), _one_thread():
        chunk = _prepare(given, settings or MvsSettings(), device)
        if chunk is None:
            return depth, confidence
        maps = {row: _filled(chunk, row, seen) for row, seen in _keyframe_maps(chunk).items()}
        for position in np.flatnonzero(given.posed).tolist():
            small = _frame_map(chunk, maps, position)
            if small is None:
                continue
            depth[position], confidence[position] = _full_size(chunk, small, frames[position], camera)
    return depth, confidence


def keyframe_costs(given: PosedFrames, settings: MvsSettings | None = None, device: str = "cpu") -> list[KeyframeCosts]:
    """Return the costs of the keyframes as `dense_depth` matches them, for training."""
    with torch.inference_mode(), _one_thread():
        chunk = _prepare(given, settings or MvsSettings(), device)
        rows = range(0 if chunk is None else len(chunk.keyframes))
        found = [_costs(chunk, row) for row in rows if chunk is not None]
    return [swept for swept in found if swept is not None]


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch with one thread: the split of work decides the last bits of vectorised functions."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def stereo_noise(
    depth: NDArray[np.float32], confidence: NDArray[np.float16], settings: MatchTrustSettings | None = None
) -> DepthNoise | None:
    """Return the noise of stereo depth (F, H, W): deviations of small windows from a plane, growing with depth squared.

    None where too little is known to measure it. Structure resembles noise, so the smoother windows decide.
    """
    chosen = settings or MatchTrustSettings()
    used = np.flatnonzero((depth > 0).any(axis=(1, 2)))
    rates = []
    for position in used[:: max(1, len(used) // chosen.noise_frames)].tolist():
        stride = max(1, depth.shape[2] // 320)
        d, c = depth[position][::stride, ::stride], confidence[position][::stride, ::stride]
        inverse = np.where(c > 0.3, 1.0 / np.maximum(d, 1e-9), 0.0)
        rates.append(plane_residual(inverse, radius=8)[4:-4:4, 4:-4:4].ravel())
    found = np.concatenate(rates) if rates else np.zeros(0)
    found = found[np.isfinite(found)]
    rough = float(np.quantile(found, 0.4)) if len(found) >= 200 else 0.0
    return DepthNoise(0.0, rough, chosen.half_sigma) if rough > 0 else None


def plane_residual(inverse: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    """RMS deviation of inverse depth (h, w) from a plane in each window, NaN where a third of it is unknown."""
    v, u = np.mgrid[: inverse.shape[0], : inverse.shape[1]].astype(np.float64)
    known, size = (inverse > 0).astype(np.float64), (2 * radius + 1, 2 * radius + 1)
    n, *rest = (
        cv2.boxFilter(known * term, cv2.CV_64F, size, normalize=True, borderType=cv2.BORDER_CONSTANT)
        for term in (np.ones_like(u), u, v, inverse, u * u, u * v, v * v, inverse * u, inverse * v, inverse**2)
    )
    mu, mv, mw, uu, uv, vv, wu, wv, ww = (term / np.maximum(n, 1e-9) for term in rest)
    uu, uv, vv = uu - mu * mu, uv - mu * mv, vv - mv * mv
    wu, wv, ww = wu - mw * mu, wv - mw * mv, ww - mw * mw
    determinant = np.maximum(uu * vv - uv * uv, 1e-9)
    explained = (vv * wu * wu - 2.0 * uv * wu * wv + uu * wv * wv) / determinant
    return np.where(n > 0.67, np.sqrt(np.maximum(ww - explained, 0.0)), np.nan)


def _prepare(given: PosedFrames, settings: MvsSettings, device: str) -> _Chunk | None:
    """Return the inputs of every step; None where the cameras do not move."""
    frames, posed, camera, sparse = given.frames, given.posed, given.camera, given.sparse
    T = np.where(posed[:, None, None], given.T_chunk_cam, np.eye(4))
    coarse = make_pictures(frames, camera, min(settings.sweep.coarse_width_px, camera.width), device)
    fine = make_pictures(frames, camera, min(settings.sweep.width_px, camera.width), device)
    sharp = np.array([sharpness(gray) for gray in fine.gray.cpu().numpy()])
    known = _sparse_depth(sparse, len(frames), settings.views.reach)
    if known is None:
        known = _probe(given, T, coarse, sharp, settings, device)
    if known is None:
        return None
    depth, span = known
    keyframes = choose_keyframes(posed, T, depth, sharp, settings.views)
    pairs = pair_views(keyframes, posed, T, fine.camera, depth)
    parts = seen_parts(keyframes, posed, T, fine.camera, depth)
    return _Chunk(frames, T, coarse, fine, keyframes, pairs, parts, depth, span, sharp, device, settings)


def _sparse_depth(
    sparse: Sequence[Sparse | None] | None, count: int, reach: tuple[float, float]
) -> tuple[NDArray[np.float64], tuple[float, float]] | None:
    """Typical depth of each frame and the span of depths, from triangulated points."""
    if sparse is None:
        return None
    each = [np.zeros(0) if s is None else s[1][s[1] > 0] for s in sparse]
    joined = np.concatenate(each)
    if len(joined) < 20:
        return None
    typical = float(np.median(joined))
    depth = np.array([float(np.median(d)) if len(d) >= 10 else typical for d in each])
    low, high = np.quantile(joined, [0.01, 0.99])
    return depth, (reach[0] * float(low), reach[1] * float(high))


def _probe(
    given: PosedFrames,
    T: Poses,
    coarse: Pictures,
    sharp: NDArray[np.float64],
    settings: MvsSettings,
    device: str,
) -> tuple[NDArray[np.float64], tuple[float, float]] | None:
    """Typical depth without triangulated points: a few keyframes are swept from very near to very far, twice."""
    posed = given.posed
    centers = T[posed, :3, 3]
    reach = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    if reach < 1e-9:
        return None
    typical, span = 6.0 * reach, (1.0 * reach, 100.0 * reach)
    for _ in range(2):
        depth = np.full(len(posed), typical)
        keyframes = choose_keyframes(posed, T, depth, sharp, settings.views)
        keyframes = keyframes[:: max(1, len(keyframes) // 4)]
        pairs = pair_views(keyframes, posed, T, coarse.camera, depth)
        parts = np.zeros((0, 0, 0), bool)
        chunk = _Chunk(given.frames, T, coarse, coarse, keyframes, pairs, parts, depth, span, sharp, device, settings)
        found = [d for d in (_probed(chunk, row) for row in range(len(keyframes))) if len(d)]
        if not found:
            return None
        joined = np.concatenate(found)
        typical = float(np.median(joined))
        low, high = np.quantile(joined, [0.02, 0.98])
        span = (0.5 * float(low), 2.5 * float(high))
    return np.full(len(posed), typical), span


def _probed(chunk: _Chunk, row: int) -> NDArray[np.float64]:
    """Depths of the pixels of a keyframe with unambiguous matches."""
    swept = _costs(chunk, row)
    if swept is None:
        return np.zeros(0)
    found = _coarse(chunk, swept)
    return (1.0 / found.inverse[found.margin > chunk.settings.trust.sure_margin]).cpu().numpy().astype(np.float64)


def _costs(chunk: _Chunk, row: int) -> KeyframeCosts | None:
    """Match a keyframe at the coarse width with its sources; None without parallax."""
    settings, key = chunk.settings.sweep, chunk.keyframes[row]
    sources = choose_sources(row, chunk.pairs, chunk.T_chunk_cam, chunk.sharp, key, chunk.settings.views)
    if not sources:
        return None
    parallax = _parallax_px(chunk, row, sources, chunk.coarse.camera)
    planes = plane_depths(*chunk.span, parallax, 24, settings.planes)
    reference = SweepReference.of(chunk.coarse.gray[key], settings.radius_px, settings.image_noise)
    inverse = torch.from_numpy(planes).to(chunk.device)[:, None, None]
    others, warps = [chunk.coarse.gray[k] for k in sources], _warps(chunk, key, sources, chunk.coarse.camera)
    cost = matching_cost(reference, others, warps, inverse, settings)
    return KeyframeCosts(key, sources, reference, planes, cost, parallax)


def _coarse(chunk: _Chunk, swept: KeyframeCosts) -> CoarseDepth:
    """Depth at the coarse width."""
    spacing = float(swept.planes[1] - swept.planes[0])
    place, margin = coarse_match(swept.reference, swept.cost, chunk.settings.sweep)
    return CoarseDepth(float(swept.planes[0]) + place * spacing, margin, spacing)


def _parallax_px(chunk: _Chunk, row: int, sources: list[int], camera: Camera) -> float:
    """Return the pixels that one unit of inverse depth moves a point in the sources: the upper quartile."""
    angle = np.radians(chunk.pairs.angle_deg[row, sources])
    return float(np.quantile(np.tan(angle), 0.75) * chunk.depth[chunk.keyframes[row]] * camera.fx)


def _warps(chunk: _Chunk, key: int, others: Sequence[int], camera: Camera) -> list[Warp]:
    T = chunk.T_chunk_cam
    return [Warp.between(T[key], T[k], camera, chunk.device) for k in others]


def _sweep(chunk: _Chunk, row: int) -> SweptDepth | None:
    """Return a keyframe's own depth by matches, elsewhere by the network; None without parallax."""
    swept = _costs(chunk, row)
    if swept is None:
        return None
    match = _matched(chunk, row, swept)
    if chunk.settings.network is None:
        return match
    predicted = _predicted(chunk, swept, match, chunk.settings.network)
    return SweptDepth(
        torch.where(match.known, match.inverse, predicted.inverse),
        torch.where(match.known, match.sigma, predicted.sigma),
        match.known | predicted.known,
    )


def _matched(chunk: _Chunk, row: int, swept: KeyframeCosts) -> SweptDepth:
    """Return depth by matches alone."""
    settings, trust, sources = chunk.settings.sweep, chunk.settings.trust, swept.sources
    gray, coarse = chunk.fine.gray[swept.key], _coarse(chunk, swept)
    start = CoarseDepth(_resized(coarse.inverse, gray.shape), _resized(coarse.margin, gray.shape), coarse.spacing)
    reference = SweepReference.of(gray, settings.radius_px, settings.image_noise)
    warps = _warps(chunk, swept.key, sources, chunk.fine.camera)
    match = refine(reference, [chunk.fine.gray[k] for k in sources], warps, start, settings)
    known = (match.cost < trust.most_cost) & (match.margin > trust.least_margin) & (match.texture > trust.least_texture)
    return SweptDepth(match.inverse_depth, _match_sigma(chunk, row, sources, match), known & ~match.doubt)


def _predicted(chunk: _Chunk, swept: KeyframeCosts, match: SweptDepth, settings: SweepNetworkSettings) -> SweptDepth:
    """Return the depth that the network predicts from costs and picture, near matches that it agrees with."""
    network, color = load_network(device=chunk.device), chunk.frames[swept.key].color
    inverse, error = predict_depth(network, swept.cost, color, swept.span, swept.side_features())
    inverse, error = _resized(inverse, match.inverse.shape), _resized(error, match.inverse.shape)
    sigma = 2.0**0.5 * error * inverse
    apart = (match.inverse - inverse).abs()
    agrees = match.known & (apart < chunk.settings.fusion.gate * torch.sqrt(sigma**2 + match.sigma**2))
    share = box_sum(agrees.float(), settings.reach_px) / (2 * settings.reach_px + 1) ** 2
    return SweptDepth(inverse, sigma, (error < settings.most_error) & (share > settings.least_share))


def _match_sigma(chunk: _Chunk, row: int, sources: list[int], match: DepthMatch) -> Tensor:
    """Standard deviation of inverse depth: that of a match in px over the parallax, more where the match is poor."""
    parallax = _parallax_px(chunk, row, sources, chunk.fine.camera)
    poor = 1.0 + 4.0 * match.cost
    return poor * (chunk.settings.fusion.match_px / parallax)


def _resized(image: Tensor, shape: torch.Size) -> Tensor:
    return torch.nn.functional.interpolate(image[None, None], size=tuple(shape), mode="bilinear")[0, 0]


def _keyframe_maps(chunk: _Chunk) -> dict[int, DepthMap]:
    """Confirmed depth of the keyframes by their number."""
    seen = {row: s for row in range(len(chunk.keyframes)) if (s := _sweep(chunk, row)) is not None}
    out: dict[int, DepthMap] = {}
    for row, own in seen.items():
        near = [k for k in choose_neighbours(row, chunk.keyframes, chunk.pairs, chunk.settings.views) if k in seen]
        if not near:
            continue
        key, others = chunk.keyframes[row], [chunk.keyframes[k] for k in near]
        warps = _warps(chunk, key, others, chunk.fine.camera)
        fusion = chunk.settings.fusion
        fused = agree_and_fuse(own, [seen[k] for k in near], warps, fusion)
        out[row] = rims_out(speckles_out(fused, fusion), fusion.rim_px, fusion.rim_step)
    return out


def _filled(chunk: _Chunk, row: int, depth: DepthMap) -> DepthMap:
    """Return a keyframe's depth with its flat regions without texture filled."""
    height, width = depth.inverse.shape
    color = cv2.resize(chunk.frames[chunk.keyframes[row]].color, (width, height), interpolation=cv2.INTER_AREA)
    small = fill_flat(depth, chunk.settings.fusion)
    inverse, sigma = small.inverse.cpu().numpy(), small.sigma.cpu().numpy()
    inverse, sigma = fill_regions(inverse, sigma, np.asarray(color, np.uint8), chunk.settings.fill)
    return DepthMap(torch.from_numpy(inverse).to(chunk.device), torch.from_numpy(sigma).to(chunk.device))


def _frame_map(chunk: _Chunk, maps: dict[int, DepthMap], position: int) -> DepthMap | None:
    """Depth of a frame at the working width, from the nearest keyframes; None without any."""
    known = sorted(maps)
    if not known:
        return None
    overlap = np.array([chunk.pairs.overlap[row, position] for row in known])
    overlap[[chunk.keyframes[row] == position for row in known]] = 1.0
    apart = np.array([abs(chunk.keyframes[row] - position) for row in known])
    best = choose_projected(overlap, chunk.parts[position, known], apart, chunk.settings.fusion)
    rows = [known[k] for k in best]
    if not rows:
        return None
    T = chunk.T_chunk_cam
    warps = [Warp.between(T[chunk.keyframes[r]], T[position], chunk.fine.camera, chunk.device) for r in rows]
    projected = project_depth([maps[r] for r in rows], warps, chunk.settings.fusion)
    fusion = chunk.settings.fusion
    return rims_out(fill_flat(projected, fusion), fusion.projected_rim_px, fusion.rim_step)


def _full_size(
    chunk: _Chunk, small: DepthMap, frame: Frame, camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float16]]:
    """Depth and confidence at the camera's size."""
    full = make_pictures([frame], camera, camera.width, chunk.device).gray[0]
    gray = _resized(full, small.inverse.shape)
    inverse, sigma = enlarge(small, gray, full, chunk.settings.sweep.path_edge, chunk.settings.fusion.enlarged_step)
    zero = torch.zeros((), device=full.device)
    depth = torch.where(inverse > 0, 1.0 / inverse.clamp_min(1e-9), zero)
    confidence = torch.where(inverse > 0, 1.0 / (1.0 + (sigma / chunk.settings.trust.half_sigma) ** 2), zero)
    return depth.cpu().numpy(), confidence.to(torch.float16).cpu().numpy()
