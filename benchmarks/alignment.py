"""Alignment of two dense reconstructions of 30 shared frames: speed and accuracy compared with other methods.

    python benchmarks/alignment.py [--seeds 1,2,3] [--ways ours,vggt_long_double] [--json FILE]

518 x 378 point maps of a furnished room, noise growing with depth on both sides, 10 % outliers, truth known. `builds`
is what builds do: samples of each chunk on fixed pixel grids, rounded as they are stored, and the edge between them
(`measure_edge`). Compared with it: `ours`, `align_point_maps` on all pixels, which builds do not use, and:
- the way of VGGT-Long (Deng et al., 2025), reimplemented from its description: pixels with a confidence over 0.1 of the
  smaller median on both sides, weights sqrt(c1 c2), scale from the ratio of the weighted RMS radii, rotation by SVD,
  five rounds of Huber re-weighting (delta 0.1) over all pairs, in single precision as there;
- the same in double precision (`peers.vggt_long.robust_similarity`): sums over millions of points lose digits;
- plain weighted Umeyama over all pairs.
Seconds are CPU seconds of one thread. Outliers are on both sides, or on the
  second side alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.peers.point_maps import align_point_maps
from benchmarks.peers.vggt_long import VggtLongSettings, robust_similarity
from list3r.association.overlap.overlap_edge import EdgeEnd, measure_edge
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3, rotation_exp
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.keyframe_record import frame_samples

FRAMES, HEIGHT, WIDTH = 30, 378, 518
FOCAL = 430.0
OUTLIERS = 0.10
NOISE = (0.004, 0.003)
"""Standard deviation of depth: first times depth plus second times its square, metres."""
Maps = NDArray[np.float32]


@dataclass(frozen=True)
class Overlap:
    """The frames that two chunks share, as each reconstructed them."""

    points_u: Maps
    confidence_u: Maps
    points_v: Maps
    confidence_v: Maps
    depth_u: Maps
    """In units of u. Shape (F, H, W)."""
    depth_v: Maps
    T_u_cam: NDArray[np.float64]
    """Poses of the cameras. Shape (F, 4, 4)."""
    T_v_cam: NDArray[np.float64]
    S_v_u: Sim3
    """Truth."""
    S_u_world: Sim3
    """Truth."""
    center_u: NDArray[np.float64]
    """Middle of the room in u, where positions are compared. Shape (3,)."""


def make_overlap(seed: int, both_sides: bool) -> Overlap:
    """A walk through a room of 6 x 5 x 2.7 m with furniture, seen by two reconstructions."""
    rng = np.random.default_rng([seed, both_sides])
    rays, cams = _walk(rng)
    depth = _cast(rays, cams, _boxes(rng))
    S_u_world = Sim3.exp(np.r_[rng.normal(size=3), rng.normal(size=3), rng.uniform(-0.7, 0.7)])
    S_v_world = Sim3.exp(np.r_[rng.normal(size=3), rng.normal(size=3), rng.uniform(-0.7, 0.7)])
    hit = rng.random(depth.shape) < OUTLIERS
    on_u = hit & (rng.random(depth.shape) < 0.5) if both_sides else np.zeros_like(hit)
    u = _observe(rng, rays, cams, depth, on_u, S_u_world)
    v = _observe(rng, rays, cams, depth, hit & ~on_u, S_v_world)
    middle = S_u_world.apply(np.array([[3.0, 2.5, 1.3]]))[0]
    poses = (_poses(rays, cams, S) for S in (S_u_world, S_v_world))
    return Overlap(*u[:2], *v[:2], u[2], v[2], *poses, S_v_world @ S_u_world.inverse(), S_u_world, middle)


def _poses(rays: NDArray[np.float64], cams: NDArray[np.float64], S_chunk_world: Sim3) -> NDArray[np.float64]:
    """Camera-to-chunk poses (F, 4, 4): the columns of a rotation are the rays of a pixel to the right, below and ahead,
    by differences."""
    ahead = rays[:, HEIGHT // 2, WIDTH // 2]
    right, down = (FOCAL * (rays[:, HEIGHT // 2 + dy, WIDTH // 2 + dx] - ahead) for dx, dy in ((1, 0), (0, 1)))
    out = np.tile(np.eye(4), (len(cams), 1, 1))
    out[:, :3, :3] = S_chunk_world.rotation @ np.stack([right, down, ahead], axis=-1)
    out[:, :3, 3] = S_chunk_world.apply(cams)
    return out


def _walk(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays of all pixels with unit depth, world axes, shape (F, H, W, 3), and camera centres (F, 3)."""
    x = (np.arange(WIDTH) - WIDTH / 2) / FOCAL
    y = (np.arange(HEIGHT) - HEIGHT / 2) / FOCAL
    camera = np.stack([*np.meshgrid(x, y), np.ones((HEIGHT, WIDTH))], axis=-1)
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    t = np.linspace(0.0, 1.0, FRAMES)
    yaw = rng.uniform(0, 2 * np.pi) + 0.8 * t + 0.05 * np.sin(9 * t)
    cams = np.stack([1.5 + 1.5 * t, 1.5 + 1.0 * t, 1.4 + 0.1 * np.sin(5 * t)], axis=1) + rng.uniform(-0.4, 0.4, 3)
    turns = rotation_exp(yaw[:, None] * np.array([0.0, 0.0, 1.0])) @ level @ rotation_exp(np.array([-0.25, 0.0, 0.0]))
    return np.einsum("fij,hwj->fhwi", turns, camera), cams


def _boxes(rng: np.random.Generator) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Lower and upper corners of furniture along the walls."""
    out = []
    for _ in range(10):
        size = rng.uniform([0.3, 0.3, 0.4], [1.2, 0.8, 1.6])
        low = rng.uniform([0, 0, 0], np.array([6.0, 5.0, 0.01]) - size * [1, 1, 0])
        side = rng.integers(0, 2)
        low[side] = rng.choice([0.0, [6.0, 5.0][side] - size[side]])
        out.append((low, low + size))
    return out


def _cast(
    rays: NDArray[np.float64], cams: NDArray[np.float64], boxes: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> NDArray[np.float64]:
    """Depth to the room's inside and the furniture's outside, by slabs. Shape (F, H, W)."""
    depth = np.empty(rays.shape[:3])
    with np.errstate(divide="ignore"):
        for k, (ray, cam) in enumerate(zip(rays, cams, strict=True)):
            inverse = 1.0 / ray
            depth[k] = np.maximum(-cam * inverse, (np.array([6.0, 5.0, 2.7]) - cam) * inverse).min(axis=-1)
            for low, high in boxes:
                a, b = (low - cam) * inverse, (high - cam) * inverse
                enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
                depth[k] = np.where((enter < leave) & (enter > 0.1) & (enter < depth[k]), enter, depth[k])
    return depth


def _observe(
    rng: np.random.Generator,
    rays: NDArray[np.float64],
    cams: NDArray[np.float64],
    depth: NDArray[np.float64],
    wrong: NDArray[np.bool_],
    S_chunk_world: Sim3,
) -> tuple[Maps, Maps, Maps]:
    """Points, confidence and depth: confidence falls with the noise, and knows two of three outliers."""
    sigma = NOISE[0] * depth + NOISE[1] * depth**2
    seen = depth + sigma * rng.normal(size=depth.shape)
    seen[wrong] *= rng.uniform(0.4, 2.5, int(wrong.sum()))
    confidence = 1.0 / (1.0 + sigma / 0.03) * rng.uniform(0.7, 1.0, depth.shape)
    confidence[wrong & (rng.random(depth.shape) < 2 / 3)] *= 0.3
    world = cams[:, None, None] + seen[..., None] * rays
    points = S_chunk_world.apply(world.reshape(-1, 3)).reshape(world.shape)
    return tuple(a.astype(np.float32) for a in (points, confidence, float(S_chunk_world.scale) * seen))  # type: ignore[return-value]


# ---------------------------------------------------------------------------------------------- the ways


def builds(overlap: Overlap) -> Sim3:
    """The edge of a build between two chunks that share frames."""
    o, camera = overlap, Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    sides = ((o.depth_u, o.confidence_u, o.T_u_cam), (o.depth_v, o.confidence_v, o.T_v_cam))
    every, frames = np.ones(FRAMES, bool), np.arange(FRAMES)
    u, v = (
        frame_samples(
            Reconstruction(frames, every, T, camera, depth, confidence.astype(np.float16), "relative", frames)
        )
        for depth, confidence, T in sides
    )
    return measure_edge(EdgeEnd(1, u), EdgeEnd(2, v), camera, metric=False).edge.S_v_u


def ours(overlap: Overlap) -> Sim3:
    """`align_point_maps`."""
    o = overlap
    return align_point_maps(o.points_u, o.confidence_u, o.points_v, o.confidence_v, metric=False).S_v_u


def vggt_long(overlap: Overlap) -> Sim3:
    """Five rounds of Huber over all confident pairs, scale from the ratio of spreads."""
    o = overlap
    least = 0.1 * min(float(np.median(o.confidence_u)), float(np.median(o.confidence_v)))
    keep = (o.confidence_u > least) & (o.confidence_v > least)
    p_u, p_v = o.points_u[keep], o.points_v[keep]
    weight = np.sqrt(o.confidence_u[keep] * o.confidence_v[keep])
    S_v_u = _ratio_of_radii(p_u, p_v, weight)
    for _ in range(5):
        turned = (p_u @ (S_v_u.scale * S_v_u.rotation.T)).astype(np.float32) + S_v_u.translation.astype(np.float32)
        residual = np.linalg.norm(turned - p_v, axis=1)
        huber = np.minimum(1.0, 0.1 / np.maximum(residual, 1e-12)).astype(np.float32)
        S_v_u = _ratio_of_radii(p_u, p_v, weight * huber)
    return S_v_u


def _ratio_of_radii(p_u: Maps, p_v: Maps, weight: Maps) -> Sim3:
    w = (weight / weight.sum(dtype=np.float64)).astype(np.float32)
    mean_u, mean_v = (w[:, None] * p_u).sum(axis=0), (w[:, None] * p_v).sum(axis=0)
    du, dv = p_u - mean_u, p_v - mean_v
    scale = np.sqrt((w * (dv**2).sum(axis=1)).sum() / (w * (du**2).sum(axis=1)).sum())
    left, _, right = np.linalg.svd((dv * w[:, None]).T.astype(np.float64) @ du.astype(np.float64))
    rotation = (left * [1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return Sim3(np.asarray(float(scale)), rotation, mean_v - scale * rotation @ mean_u)


def plain_umeyama(overlap: Overlap) -> Sim3:
    """Weighted Umeyama over all pairs, least squares scale, no kernel."""
    o = overlap
    p_u, p_v = o.points_u.reshape(-1, 3), o.points_v.reshape(-1, 3)
    weight = np.sqrt(o.confidence_u * o.confidence_v).ravel()
    w = (weight / weight.sum(dtype=np.float64))[:, None]
    mean_u, mean_v = (w * p_u).sum(axis=0), (w * p_v).sum(axis=0)
    du, dv = p_u - mean_u, p_v - mean_v
    left, size, right = np.linalg.svd((w * dv).T @ du)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale, rotation = float((size * sign).sum() / (w * du**2).sum()), (left * sign) @ right
    return Sim3(np.asarray(scale), rotation, mean_v - scale * rotation @ mean_u)


def vggt_long_double(overlap: Overlap) -> Sim3:
    """`vggt_long` in double precision."""
    o = overlap
    least = 0.1 * min(float(np.median(o.confidence_u)), float(np.median(o.confidence_v)))
    keep = (o.confidence_u > least) & (o.confidence_v > least)
    weight = np.sqrt(o.confidence_u[keep].astype(np.float64) * o.confidence_v[keep])
    p_u, p_v = o.points_u[keep].astype(np.float64), o.points_v[keep].astype(np.float64)
    return robust_similarity(p_u, p_v, weight, VggtLongSettings())


WAYS: dict[str, Callable[[Overlap], Sim3]] = {
    "builds": builds,
    "ours": ours,
    "vggt_long": vggt_long,
    "vggt_long_double": vggt_long_double,
    "plain_umeyama": plain_umeyama,
}


def measure(seed: int, both_sides: bool, ways: Sequence[str]) -> dict[str, dict[str, float]]:
    """Seconds and errors of some ways on one overlap; lengths in metres."""
    overlap, out = make_overlap(seed, both_sides), {}
    for name in ways:
        way = WAYS[name]
        seconds = []
        for _ in range(3 if name in ("builds", "ours") else 1):
            begin = time.process_time()
            found = way(overlap)
            seconds.append(time.process_time() - begin)
        error = found.inverse() @ overlap.S_v_u
        moved = np.linalg.norm(error.apply(overlap.center_u[None])[0] - overlap.center_u) / overlap.S_u_world.scale
        out[name] = {
            "seconds": float(np.median(seconds)),
            "scale_error_percent": 100 * abs(float(error.scale) - 1.0),
            "rotation_error_deg": float(np.degrees(np.linalg.norm(error.log()[3:6]))),
            "position_error_m": float(moved),
        }
    return out


def summarise(runs: list[dict[str, dict[str, float]]]) -> dict[str, Any]:
    """Mean and worst of each figure of each way, and how many times faster ours is."""
    table: dict[str, Any] = {}
    for name in runs[0]:
        table[name] = {
            key: {"mean": float(np.mean([r[name][key] for r in runs])), "worst": max(r[name][key] for r in runs)}
            for key in runs[0][name]
        }
    if {"ours", "vggt_long"} <= set(runs[0]):
        ratios = [r["vggt_long"]["seconds"] / r["ours"]["seconds"] for r in runs]
        table["times_faster_than_vggt_long"] = {"mean": float(np.mean(ratios)), "worst": min(ratios)}
    return table


def main() -> None:
    """Parse arguments, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3,4,5", help="seeds of the overlaps, separated by commas")
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    given = parser.parse_args()
    ways = given.ways.split(",")
    if unknown := sorted(set(ways) - set(WAYS)):
        parser.error(f"unknown: {', '.join(unknown)}; choose from {', '.join(WAYS)}")
    seeds = [int(s) for s in given.seeds.split(",")]
    result: dict[str, Any] = {"seeds": seeds, "frames": FRAMES, "size": [WIDTH, HEIGHT], "outliers": OUTLIERS}
    print(f"{machine()['processor']}, one thread; {FRAMES} frames of {WIDTH} x {HEIGHT}, seeds {given.seeds}")
    with threadpool_limits(1):
        for name, both in (("outliers_on_both_sides", True), ("outliers_on_one_side", False)):
            result[name] = summarise([measure(seed, both, ways) for seed in seeds])
            _print(name, result[name])
    write_json(given.json, result)


def _print(name: str, table: dict[str, Any]) -> None:
    print(f"\n{name.replace('_', ' ')} (mean / worst)")
    for way in [way for way in WAYS if way in table]:
        row = table[way]
        print(
            f"  {way:14s} {row['seconds']['mean']:7.3f} / {row['seconds']['worst']:7.3f} s"
            f"   scale {row['scale_error_percent']['mean']:.4f} / {row['scale_error_percent']['worst']:.4f} %"
            f"   rotation {row['rotation_error_deg']['mean']:.4f} / {row['rotation_error_deg']['worst']:.4f} deg"
            f"   position {row['position_error_m']['mean']:.5f} / {row['position_error_m']['worst']:.5f} m"
        )
    if ratio := table.get("times_faster_than_vggt_long"):
        print(f"  ours is {ratio['mean']:.0f} times faster than the way of VGGT-Long (least {ratio['worst']:.0f})")


if __name__ == "__main__":
    main()
