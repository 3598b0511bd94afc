"""Walks past bare walls: how much of the video is kept, in how many parts, how exact, and whether up is right.

PYTHONPATH=. python benchmarks/bare_walls.py --json benchmarks/results/bare-walls.json

Two furnished rooms with plain plaster, whose marks are as faint as a sensor's noise. The camera turns to a bare wall,
which fills the picture for 10 to 60 frames while it moves along, and turns back to where it left or, `onward`, to where
the walk is later. `posed` is the share of the frames with a pose among those in which things (no wall, floor or
ceiling) take a twentieth of the picture or more; `ate_cm` is over all parts, each aligned by itself, `main_ate_cm` over
the largest; `up_deg` is the error of up in each part, None where it is unknown there.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray

import list3r
from benchmarks.given_poses import paths_of_parts
from benchmarks.simulation.blind import BlindSettings, blind_walk
from list3r.evaluation.scene import alignment_of
from list3r.evaluation.trajectory import Trajectory, associate, evaluate_trajectory, read_tum
from list3r.frames.base import Camera
from list3r.memory.library.world.gravity import gravity_of
from list3r.simulation.dataset import WalkSettings, write_walk
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.walk import PathSettings
from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.world import SimulatedWorld

FPS = 15.0
SIZE = (240, 180)
LEAST_THINGS = 0.05
"""Share of a picture from which on it shows structure."""
FAINT = 5
"""Grey levels between the marks of the plaster and the rest."""


class PlainWalk(WalkSettings):
    """A walk through rooms with plain plaster."""

    def world(self) -> SimulatedWorld:
        """Return the rooms."""
        world = super().world()
        bare = [
            replace(o, parts=tuple(replace(p, material=_plain(p.material)) for p in o.parts)) for o in world.objects
        ]
        return replace(world, objects=tuple(bare))


@dataclass(frozen=True)
class BareWalk(PlainWalk):
    """A walk past a bare wall."""

    wall: int = 20
    """Frames of nothing but wall."""
    onward: int = 0
    """Frames of the walk that the way back leaves out."""

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Seconds (F,) and T_world_cam (F, 4, 4)."""
        calm = BlindSettings(
            wall_at=0.5,
            wall_s=self.wall / FPS,
            wall_m=0.8,
            turn_deg_s=75.0,
            step_m_s=0.7,
            dark_s=0.0,
            onward=self.onward,
        )
        values = {name: getattr(self, name) for name in WalkSettings.__dataclass_fields__}
        way = blind_walk(PlainWalk(**values), calm)
        return way.time_s, way.T_world_cam


WALKS = (
    BareWalk(seed=11, wall=10, onward=25),
    BareWalk(seed=12, wall=20, onward=25),
    BareWalk(seed=13, wall=40),
    BareWalk(seed=14, wall=40, onward=25),
    BareWalk(seed=15, wall=60),
    BareWalk(seed=16, wall=60, onward=25),
    BareWalk(seed=17, wall=30),
    BareWalk(seed=18, wall=30, onward=25),
    BareWalk(seed=19, wall=50),
    BareWalk(seed=20, wall=15),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=90, help="of each walk without its wall")
    parser.add_argument("--walks", default="0,1,2,3,4,5,6,7,8,9", help="numbers of those that are filmed")
    parser.add_argument("--keep", type=Path, help="folder in which the films are kept")
    parser.add_argument("--colour", action="store_true", help="without depth, by structure from motion")
    parser.add_argument("--json", type=Path)
    words = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for number in map(int, words.walks.split(",")):
            walk = replace(WALKS[number], frames=words.frames, size=SIZE, path=PathSettings(fps=FPS, speed_m_s=0.35))
            folder = (words.keep or Path(scratch)) / f"walk-{number}"
            if not (folder / "truth.json").exists():
                write_walk(folder, walk)
            rows.append(
                {"walk": number, "wall": walk.wall, "onward": walk.onward, **measured(folder, walk, words.colour)}
            )
            print(json.dumps(rows[-1]), flush=True)
    table = summary(rows)
    print(machine())
    print(json.dumps(table, indent=1))
    write_json(words.json, {"all": table, "walks": rows})


def measured(folder: Path, walk: BareWalk, colour: bool) -> dict[str, Any]:
    """Build one memory and hold it against the truth."""
    truth = read_tum(folder / "groundtruth.txt")
    shown = things_in_view(walk, truth.T_world_cam)
    source = folder / "rgb" if colour else folder
    camera = walk.camera()
    by = ["--intrinsics", f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}", "--fps", "0"] if colour else []
    with tempfile.TemporaryDirectory() as scratch:
        memory = Path(scratch) / "walk.l3r"
        asked = ("--poses", "estimate", "--workers", "1", "--preset", "cpu", *by)
        wall_s = run_list3r("build", str(source), "-m", str(memory), *asked)[1]["wall_s"]
        with list3r.open(memory) as scene:
            parts = paths_of_parts(scene)
            known = {part: gravity_of(scene.store, part) != "unknown" for part in parts}
            posed = {f.frame_index for f in scene.store.frames.all() if f.state == "posed"}
            loops = sum(e.kind == "loop" and e.accepted for e in scene.store.edges.all())
    if colour:  # pictures of a folder have no clock
        parts = {part: _timed(path, truth) for part, path in parts.items()}
    errors = [evaluate_trajectory(truth, path) for path in parts.values() if len(path.time_s) >= 3]
    ate = [(e.ate_sim3_m if colour else e.ate_se3_m).rmse for e in errors]
    frames = [e.pairs for e in errors]
    return {
        "frames": len(shown),
        "shown": int(shown.sum()),
        "posed_shown": len(posed & set(np.flatnonzero(shown).tolist())),
        "posed_all": len(posed),
        "parts": len(parts),
        "loops": loops,
        "ate_cm": round(100 * float(np.sqrt(np.average(np.square(ate), weights=frames))), 2) if ate else None,
        "main_ate_cm": round(100 * ate[int(np.argmax(frames))], 2) if ate else None,
        "frames_of_parts": sorted((len(p.time_s) for p in parts.values()), reverse=True),
        "up_deg": [_up_error(truth, p) if known[part] and len(p.time_s) >= 3 else None for part, p in parts.items()],
        "wall_s": round(wall_s, 1),
    }


def things_in_view(walk: BareWalk, T_world_cam: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return in which frames things take enough of the picture. Shape (F,)."""
    world, c = walk.world(), walk.camera()
    small = Camera(c.width // 8, c.height // 8, c.fx / 8, c.fy / 8, c.cx / 8, c.cy / 8)
    things, renderer = [o.id for o in world.objects if not o.structure], Renderer(world, small)
    return np.array([np.isin(renderer.render(T).ids, things).mean() >= LEAST_THINGS for T in T_world_cam])


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of all walks together."""
    up = [error for r in rows for error in r["up_deg"]]
    told = [error for error in up if error is not None]
    return {
        "walks": len(rows),
        "posed": round(sum(r["posed_shown"] for r in rows) / sum(r["shown"] for r in rows), 4),
        "in_one_part": sum(r["parts"] == 1 for r in rows),
        "parts": sum(r["parts"] for r in rows),
        "ate_cm": max((r["ate_cm"] for r in rows if r["ate_cm"] is not None), default=None),
        "up_unknown": len(up) - len(told),
        "up_deg": max(told, default=None),
        "seconds": round(sum(r["wall_s"] for r in rows), 1),
    }


def _plain(material: Material) -> Material:
    if material.kind != "plaster":
        return material
    r, g, b = material.color
    return replace(material, accent=(r - FAINT, g - FAINT, b - FAINT))


def _timed(path: Trajectory, truth: Trajectory) -> Trajectory:
    return replace(path, time_s=truth.time_s[np.rint(path.time_s).astype(np.int64)])


def _up_error(truth: Trajectory, path: Trajectory) -> float:
    """Return the angle between a part's z and the true one, degrees."""
    assert len(associate(truth.time_s, path.time_s)[0]) >= 3
    S_truth_part = alignment_of(truth, path, with_scale=False)
    return round(float(np.degrees(np.arccos(np.clip(S_truth_part.rotation[2, 2], -1.0, 1.0)))), 2)


if __name__ == "__main__":
    main()
