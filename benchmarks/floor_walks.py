"""Walks over a bare floor with steps of exposure: does the camera slip, and do the time stamps change its path?

PYTHONPATH=. python benchmarks/floor_walks.py --json benchmarks/results/floor-walks.json

The camera of a walk through two rooms looks down until floor fills the picture, and up again. Before the floor exposure
falls within three frames, to a half and to a quarter, and comes back; pictures are drawn out by their own motion; every
twelfth row has no depth, as on a headset. The same frames are stamped at 3 to 30 frames a second. `ate_cm` is over the
frames with a pose, `slips` are steps between neighbours that are off by more than 3 cm, and `unsure` counts frames that
say so themselves, `unsure_slips` the slips at them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json
from numpy.typing import NDArray

from benchmarks.simulation.blind import exposed
from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory
from list3r.frames.base import Camera, Frame
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.rendering.sensor import SensorSettings, sense
from list3r.simulation.walk import PathSettings
from list3r.simulation.worlds.world import SimulatedWorld

FRAMES, FLOOR = 60, slice(20, 40)
DOWN_DEG = 85.0
"""Least angle below the horizon at which the camera looks at the floor."""
STAMPS = (3.0, 5.0, 10.0, 15.0, 30.0)
SLIP_M = 0.03


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[21, 22, 23])
    parser.add_argument("--fps", type=float, default=10.0, help="at which the walk is filmed")
    parser.add_argument("--json", type=Path)
    words = parser.parse_args()
    rows = []
    for seed in words.seeds:
        path = PathSettings(fps=words.fps, speed_m_s=0.8, turn_deg_s=40.0)
        walk = WalkSettings(seed, frames=FRAMES, size=(240, 180), path=path)
        truth = over_the_floor(walk.poses()[1])
        frames = filmed(walk, truth, words.fps)
        for stamps in STAMPS:
            rows.append({"seed": seed, "stamps": stamps, **measured(walk, frames, truth, stamps)})
            print(json.dumps(rows[-1]), flush=True)
    print(machine())
    print(json.dumps(summary(rows)))
    write_json(words.json, {"filmed_at": words.fps, "all": summary(rows), "walks": rows})


def over_the_floor(T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses, looking down in the middle. Shape (F, 4, 4)."""
    out = T_world_cam.copy()
    bend = np.interp(np.arange(len(out)), [FLOOR.start - 10, FLOOR.start, FLOOR.stop - 1, FLOOR.stop + 9], [0, 1, 1, 0])
    for T, share in zip(out, bend, strict=True):
        now = np.arcsin(np.clip(-T[2, 2], -1.0, 1.0))
        down = share * max(0.0, np.radians(DOWN_DEG) - now)
        turn = np.eye(3)
        turn[1:, 1:] = [[np.cos(down), np.sin(down)], [-np.sin(down), np.cos(down)]]
        T[:3, :3] = T[:3, :3] @ turn
    return out


def without_things(walk: WalkSettings, T_world_cam: NDArray[np.float64]) -> SimulatedWorld:
    """Return the rooms without the things that are in the way of the floor."""
    world, c = walk.world(), walk.camera()
    renderer = Renderer(world, Camera(c.width // 4, c.height // 4, c.fx / 4, c.fy / 4, c.cx / 4, c.cy / 4))
    seen = {int(i) for T in T_world_cam for i in np.unique(renderer.render(T).ids)}
    return replace(world, objects=tuple(o for o in world.objects if o.structure or o.id not in seen))


def filmed(walk: WalkSettings, T_world_cam: NDArray[np.float64], fps: float) -> list[Frame]:
    """Return what the camera sees, its brightness stepping twice."""
    renderer, out = Renderer(without_things(walk, T_world_cam[FLOOR]), walk.camera()), []
    gain = np.ones(len(T_world_cam))
    for start, least in ((FLOOR.start + 2, 0.5), (FLOOR.start + 11, 0.25)):
        gain[start : start + 6] = np.interp(np.arange(6), [0, 2, 3, 5], [1.0, least, least, 1.0])
    for k, T in enumerate(T_world_cam):
        seen = renderer.render(T)
        drawn = np.mean([renderer.render(P).color for P in exposed(T_world_cam, k, fps, 1 / 40, 3)], axis=0)
        shown = sense(replace(seen, color=np.float32(gain[k]) * drawn), SensorSettings(), walk.seed, k, k / fps)
        depth = shown.depth.copy()
        depth[k % 12 :: 12] = 0.0
        out.append(Frame(k, k / fps, shown.color, depth, None))
    return out


def measured(
    walk: WalkSettings, frames: Sequence[Frame], T_world_cam: NDArray[np.float64], stamps: float
) -> dict[str, Any]:
    """Track the frames as if `stamps` came in a second, and hold their path against the truth."""
    parts = RgbdReconstructor().parts([replace(f, time_s=f.index / stamps) for f in frames], walk.camera())
    square, posed, slips, unsure = 0.0, 0, set(), set()
    for part in parts:
        at, T = part.frame_indices[part.posed], part.T_chunk_cam[part.posed]
        found = evaluate_trajectory(Trajectory(at / 1.0, T_world_cam[at]), Trajectory(at / 1.0, T))
        square, posed = square + len(at) * found.ate_se3_m.rmse**2, posed + len(at)
        for a, b, T_a, T_b in zip(at[:-1], at[1:], T[:-1], T[1:], strict=True):
            off = np.linalg.inv(T_world_cam[a]) @ T_world_cam[b] - np.linalg.inv(T_a) @ T_b
            slips |= {int(b)} if np.linalg.norm(off[:3, 3]) > SLIP_M else set()
        unsure |= part.unsure & set(at.tolist())
    return {
        "posed": posed,
        "parts": len(parts),
        "ate_cm": round(100 * float(np.sqrt(square / max(posed, 1))), 2),
        "slips": len(slips),
        "unsure": len(unsure),
        "unsure_slips": len(slips & unsure),
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of all walks together."""
    of_walk = [[r["ate_cm"] for r in rows if r["seed"] == seed] for seed in {r["seed"] for r in rows}]
    return {
        "posed": round(sum(r["posed"] for r in rows) / (FRAMES * len(rows)), 4),
        "ate_cm": max(r["ate_cm"] for r in rows),
        "slips": sum(r["slips"] for r in rows),
        "apart_by_stamps_cm": round(max(max(ates) - min(ates) for ates in of_walk), 2),
    }


if __name__ == "__main__":
    main()
