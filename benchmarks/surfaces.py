"""Surfaces fused from the depth that a memory stores, against the true surfaces of simulated worlds, beside Open3D's.

python benchmarks/surfaces.py --seeds 907-909 --keep FOLDER --redkitchen ../shared/data/redkitchen --json FILE

Two furnished rooms a seed, 300 frames of 640 x 480 with a Kinect's noise, built with given poses, so that what is
compared lies in one frame. Accuracy is the share of points on a surface, by lot, within 1 and 2 cm of a true solid: an
exact distance. Completeness is the share of true points, one a centimetre, that a frame without noise sees within
4.5 m, within 1 and 2 cm of a surface. Beside ours (`ours`, and `whole`: before it is simplified): Open3D's grid with
its own settings at 2 cm cells on the same stored depth (`open3d`), and on all frames at full size (`open3d_all`).
`things` is the share of the triangles of things within 5 cm of the box of one true object, that of most of them.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray

import list3r
from list3r.memory.store.store import Store
from list3r.queries.views.depth_frames import REST, depth_frames
from list3r.queries.views.fused import FusionSettings, Surface, fused
from list3r.simulation.dataset import DEPTH_UNITS_PER_M, WalkSettings, frame_name, write_walk
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.worlds.objects import BOX, CYLINDER, stack_solids
from list3r.simulation.worlds.world import SimulatedWorld

Array = NDArray[np.float64]
REACH_M, SAMPLES = 4.5, 100_000
Depths = Iterable[tuple[NDArray[np.float32], tuple[float, ...], Array]]
"""Depth (h, w) in metres, fx, fy, cx, cy, and T_world_cam of frames."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="907-909", help="first-last")
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    parser.add_argument("--redkitchen", type=Path, help="the sequence, of which 300 frames are taken")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split("-"))
    with tempfile.TemporaryDirectory() as scratch:
        os.environ["LIST3R_CACHE"] = scratch
        keep = args.keep or Path(scratch)
        worlds = []
        for seed in range(first, last + 1):
            worlds.append({"seed": seed} | of_world(seed, keep / f"world-{seed}"))
            print(json.dumps(worlds[-1]), flush=True)
        result: dict[str, Any] = {"worlds": worlds, "mean": mean(worlds)}
        if args.redkitchen:
            memory = keep / "redkitchen.l3r"
            if not memory.exists():
                run_list3r("build", str(args.redkitchen), "-m", str(memory), "--frames", "0:300", "--workers", "1")
            result["redkitchen"] = exports(memory, keep)
    print(machine(), json.dumps(result["mean"]), json.dumps(result.get("redkitchen")))
    write_json(args.json, result)


def mean(worlds: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    kinds = [k for k, v in worlds[0].items() if isinstance(v, dict) and "accuracy_1cm" in v]
    return {k: {n: round(float(np.mean([w[k][n] for w in worlds])), 4) for n in worlds[0][k]} for k in kinds}


def of_world(seed: int, folder: Path) -> dict[str, Any]:
    """Build the memory of a world where there is none, and hold surfaces against the truth."""
    settings = WalkSettings(seed=seed, size=(640, 480))
    memory = folder / "memory.l3r"
    if not memory.exists():
        write_walk(folder / "walk", settings)
        run_list3r("build", str(folder / "walk"), "-m", str(memory), "--poses", "given", "--workers", "1")
    world, truth = settings.world(), true_points(settings)
    out: dict[str, Any] = exports(memory, folder)
    with Store.open(memory) as store:
        component = store.chunks.all()[0].component
        surface, owner = fused(store, component)
        stored = [(f.depth, f.camera, f.T_world_cam) for f in depth_frames(store, component)]
        out["whole"] = scores(fused(store, component, FusionSettings(kept_share=1.0))[0], world, truth)
    out["ours"] = scores(surface, world, truth)
    out["open3d"] = scores(by_open3d(stored), world, truth)
    out["open3d_all"] = scores(by_open3d(of_walk(folder / "walk", settings)), world, truth)
    out["things"] = things(surface, owner, world)
    return out


def exports(memory: Path, folder: Path) -> dict[str, float]:
    """Return what the first surfaces of a memory cost, and the size of files."""
    with list3r.open(memory) as scene:
        before, began, used = peak_mb(), time.monotonic(), time.process_time()
        surfaces = scene.surfaces()
        out = {"seconds": round(time.monotonic() - began, 1), "cpu_seconds": round(time.process_time() - used, 1)}
        out |= {
            "peak_mb": peak_mb(),
            "peak_mb_before": before,
            "triangles": sum(len(s.faces) for s in surfaces.values()),
        }
        out["surfaces"] = sum(len(s.faces) > 0 for s in surfaces.values())
        began = time.monotonic()
        scene.surfaces()
        out["seconds_again"] = round(time.monotonic() - began, 3)
        for name, form, options in (("glb", "glb", {}), ("html", "web", {}), ("usdc", "usd", {"mesh": True})):
            (path,) = scene.export(form, folder / f"{memory.stem}.{name}", **options)  # type: ignore[arg-type]
            out[f"{name}_mb"] = round(path.stat().st_size / 1e6, 2)
    (kept,) = sorted(Path(os.environ["LIST3R_CACHE"]).glob("surfaces/*.npz"), key=lambda p: p.stat().st_mtime)[-1:]
    return out | {"kept_mb": round(kept.stat().st_size / 1e6, 2)}


def peak_mb() -> int:
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


# ---------------------------------------------------------------------------------------------- the truth


def from_solids(points: Array, world: SimulatedWorld) -> Array:
    """Return how far points are from the nearest surface of a solid, metres. Shape (N, 3) -> (N,)."""
    solids, best = stack_solids(world.objects), np.full(len(points), np.inf)
    for kind, center, half, yaw in zip(solids.kind, solids.center, solids.half, solids.yaw, strict=True):
        c, s = np.cos(yaw), np.sin(yaw)
        local = (points - center) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        if kind == BOX:
            out = np.abs(local) - half
        elif kind == CYLINDER:
            out = np.stack([np.hypot(local[:, 0], local[:, 1]) - half[0], np.abs(local[:, 2]) - half[2]], axis=1)
        else:
            out = np.linalg.norm(local, axis=1, keepdims=True) - half[0]
        signed = np.linalg.norm(np.maximum(out, 0), axis=1) + np.minimum(out.max(axis=1), 0)
        best = np.minimum(best, np.abs(signed))
    return best


def true_points(settings: WalkSettings) -> Array:
    """Return points of true surfaces that every sixth frame sees, one a centimetre. Shape (N, 3)."""
    renderer, camera, points = Renderer(settings.world(), settings.camera()), settings.camera(), []
    rows, columns = np.mgrid[: camera.height : 4, : camera.width : 4]
    for T in settings.poses()[1][::6]:
        depth = renderer.render(T).depth[::4, ::4].astype(np.float64)
        rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(depth.shape)], 2)
        seen = (depth > 0) & (depth < REACH_M)
        points.append((rays * depth[..., None])[seen] @ T[:3, :3].T + T[:3, 3])
    every = np.concatenate(points)
    return every[np.unique(np.floor(every / 0.01).astype(int), axis=0, return_index=True)[1]]


def scores(surface: Surface, world: SimulatedWorld, truth: Array) -> dict[str, float]:
    on, _, _ = surface.sampled(SAMPLES)
    scene = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor
    scene.add_triangles(tensor(surface.vertices), tensor(surface.faces.astype(np.uint32)))
    away = from_solids(on.astype(np.float64), world)
    near = scene.compute_distance(tensor(truth.astype(np.float32))).numpy()
    out = {f"accuracy_{n}cm": float(np.mean(away < n / 100)) for n in (1, 2)}
    out |= {f"completeness_{n}cm": float(np.mean(near < n / 100)) for n in (1, 2)}
    return {k: round(v, 4) for k, v in out.items()} | {
        "mean_error_mm": round(1000 * float(away.mean()), 2),
        "triangles": len(surface.faces),
    }


def things(surface: Surface, owner: NDArray[np.int64], world: SimulatedWorld) -> float:
    """Return the share of triangles of things that lie in the box of one true object, that of most of them."""
    middle = surface.vertices[surface.faces].mean(axis=1)
    objects = [o.box() for o in world.objects]
    inside = total = 0
    for n in np.setdiff1d(owner, REST):
        mine = middle[owner == n]
        inside += max(
            int(np.all(np.abs((mine - b.center) @ b.rotation) < b.size / 2 + 0.05, axis=1).sum()) for b in objects
        )
        total += len(mine)
    return round(inside / max(total, 1), 4)


# ---------------------------------------------------------------------------------------------- Open3D as it comes


def by_open3d(frames: Depths) -> Surface:
    """Return the surface of Open3D's grid with 2 cm cells and its own settings otherwise."""
    core, geometry = open3d.core, open3d.t.geometry
    grid = geometry.VoxelBlockGrid(("tsdf", "weight"), (core.float32, core.float32), (1, 1), 0.02, 16, 10_000)
    for depth, (fx, fy, cx, cy), T_world_cam in frames:
        lens = core.Tensor(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
        image, T_cam_world = geometry.Image(depth), core.Tensor(np.linalg.inv(T_world_cam))
        blocks = grid.compute_unique_block_coordinates(image, lens, T_cam_world, 1.0, REACH_M)
        grid.integrate(blocks, image, lens, T_cam_world, 1.0, REACH_M)
    mesh = grid.extract_triangle_mesh()
    vertices = mesh.vertex.positions.numpy()
    return Surface(vertices, mesh.triangle.indices.numpy().astype(np.int32), np.zeros(vertices.shape, np.uint8))


def of_walk(folder: Path, settings: WalkSettings) -> Depths:
    camera = settings.camera()
    for k, T in enumerate(settings.poses()[1]):
        depth = cv2.imread(str(folder / "depth" / f"{frame_name(k)}.png"), cv2.IMREAD_UNCHANGED)
        yield (depth / DEPTH_UNITS_PER_M).astype(np.float32), (camera.fx, camera.fy, camera.cx, camera.cy), T


if __name__ == "__main__":
    main()
