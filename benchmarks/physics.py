"""Solids of things in a physics engine, against true shapes and convex hulls: balls dropped in, rolled under, put on.

python benchmarks/physics.py --seeds 971-980 --keep FOLDER --json benchmarks/results/physics.json

Two furnished rooms a world, every third frame of the walk, built with given poses. Each true thing is tried alone,
fixed on a floor, three times: `true` of its own parts, `hull` as colliders were before, `ours` of `export --to
mjcf`. A ball of 5 cm is dropped into each open container from 10 cm above its rim (in it after 4 s), rolled at
1 m/s under each table from front to back (in 4 s it must come out), and put on each seat, table top and board (after
3 s it must be within 5 cm in height and 15 cm aside). Things for which the memory has no instance with a box IoU of
0.25 are not found. `rest` is the whole scene for 10 s: a body explodes where it exceeds 5 m/s or ends farther than 1 m
from where it was, and stays where it ends within 5 cm.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray

import list3r
from list3r.exporters.meshes.closed import hull
from list3r.exporters.meshes.instance_mesh import instance_mesh
from list3r.memory.core.records import Instance
from list3r.simulation.dataset import WalkSettings, write_walk
from list3r.simulation.worlds.furniture import shelf_boards
from list3r.simulation.worlds.objects import BOX, CYLINDER, SPHERE, Part, SimulatedObject

os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn
import mujoco

Array = NDArray[np.float64]
RADIUS_M, DENSITY, FOUND_IOU = 0.025, 300.0, 0.25
SHELL_M = 0.004
"""Thickness of the thin shells of true things: half of the ball's way in a step at 4 m/s."""
COLUMNS = ("true", "hull", "ours")
BALL = {"type": "sphere", "size": f"{RADIUS_M}", "mass": "0.05", "condim": "6"}
ROLLING_M = {"in": 0.002, "on": 0.002, "under": 0.0002}
"""Rolling friction: of a soft ball, which comes to rest, and of a hard one, which rolls for metres."""
STEP_S = 0.002


@dataclass(frozen=True)
class EveryThird(WalkSettings):
    """Some frames of a walk."""

    def poses(self) -> tuple[Array, Array]:
        """Seconds (F,) and T_world_cam (F, 4, 4) of the frames to be written."""
        time_s, poses = super().poses()
        return time_s[::3], poses[::3]


@dataclass(frozen=True)
class Trial:
    """A ball at a thing."""

    kind: str
    """in, under, on."""
    start: Array
    """World. Shape (3,)."""
    speed: Array
    """m/s. Shape (3,)."""
    seconds: float


Geom = dict[str, str]
Body = tuple[list[Geom], dict[str, str]]
"""Geoms, and the vertices of meshes by name; world coordinates."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="971-980", help="first-last")
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    parser.add_argument("--no-rest", action="store_true", help="only the things that are tried")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split("-"))
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(first, last + 1):
            folder = (args.keep or Path(scratch)) / str(seed)
            rows.append({"seed": seed} | measured(seed, folder, rest=not args.no_rest))
            print(json.dumps({k: v for k, v in rows[-1].items() if k != "trials"}), flush=True)
    write_json(args.json, {"machine": machine(), "total": total(rows), "worlds": rows})
    print(json.dumps(total(rows), indent=1))


def total(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return sums over worlds."""
    trials = [t for row in rows for t in row["trials"]]
    out: dict[str, Any] = {}
    for kind in ("in", "under", "on"):
        some = [t for t in trials if t["kind"] == kind]
        found = [t for t in some if "ours" in t]
        out[kind] = {"tried": len(some), "found": len(found), "true": sum(t["true"] for t in some)}
        out[kind] |= {name: sum(t[name] for t in found) for name in ("hull", "ours")}
    rests = [row["rest"] for row in rows if "rest" in row]
    for name in COLUMNS:
        if rests:
            out[f"rest {name}"] = {k: sum(r[name][k] for r in rests) for k in ("bodies", "exploded", "stayed")}
    whole = [row for row in rows if "rest" in row]
    out |= {k: sum(row[k] for row in whole) for k in ("things", "parts", "mb", "cpu_s")}
    if whole:
        out["cpu_s_for_60"], out["mb_for_60"] = (round(60 * out[k] / out["things"], 1) for k in ("cpu_s", "mb"))
    return out


def measured(seed: int, folder: Path, *, rest: bool) -> dict[str, Any]:
    """Build the memory of a world where there is none, export it, and try its things."""
    memory = folder / "memory.l3r"
    if not memory.exists():
        write_walk(folder / "walk", EveryThird(seed=seed))
        run_list3r("build", str(folder / "walk"), "-m", str(memory), "--poses", "given", "--workers", "1")
    objects = EveryThird(seed=seed).world().objects
    with list3r.open(memory) as scene, tempfile.TemporaryDirectory() as scratch:
        tried = [i for thing in objects if any(trials_of(thing)) and (i := found(thing, scene.instances()))]
        ids = None if rest else tuple({i.id for i in tried})
        before = time.process_time()
        files = scene.export("mjcf", Path(scratch) / "scene", density=DENSITY, ids=ids)
        row: dict[str, Any] = {"cpu_s": round(time.process_time() - before, 2)}
        exported = Xml.parse(files[0]).getroot()
        bodies = [b for b in exported.iter("body") if b.find("geom[@class='solid']") is not None]
        row |= {
            "things": len(bodies),
            "parts": len(exported.findall(".//geom[@class='solid']")),
            "mb": round(sum(f.stat().st_size for f in files) / 1e6, 3),
        }
        trials = []
        for thing in objects:
            instance = found(thing, scene.instances())
            forms = {"true": true_body(thing)}
            if instance is not None:
                forms["hull"] = hull_body(scene, instance)
                forms["ours"] = our_body(exported, instance.id)
            for trial in trials_of(thing):
                told = {name: passes(body, thing, trial) for name, body in forms.items()}
                trials.append({"thing": thing.label, "id": thing.id, "kind": trial.kind} | told)
        row["trials"] = trials
        if rest:
            row["rest"] = {
                "true": rested(true_scene(objects)),
                "hull": rested(hull_scene(exported, scene, files[0].parent)),
                "ours": rested(mujoco.MjModel.from_xml_path(str(files[0]))),
            }
    return row


def found(thing: SimulatedObject, instances: Sequence[Instance]) -> Instance | None:
    """Return the instance whose box meets that of a true thing best."""
    low, high = (f(thing.box().corners(), axis=0) for f in (np.min, np.max))
    best, most = None, FOUND_IOU
    for i in instances:
        inner = np.clip(np.minimum(high, i.aabb[1]) - np.maximum(low, i.aabb[0]), 0, None).prod()
        iou = inner / (np.prod(high - low) + np.prod(i.aabb[1] - i.aabb[0]) - inner)
        if iou > most:
            best, most = i, iou
    return best


# ------------------------------------------------------------------------------------------------ trials


def trials_of(thing: SimulatedObject) -> Iterator[Trial]:
    """Return what is tried at a true thing."""
    still, (w, d, h) = np.zeros(3), thing.box().size
    opening = [p for p in thing.parts if p.open_top and p.half[0] > 1.3 * RADIUS_M]
    if opening:
        yield Trial("in", at(thing, (0, 0, h + 0.1)), still, 4.0)
    if thing.label in ("table", "desk", "bench"):
        way = thing.rotation() @ np.array([0.0, -1.0, 0.0])
        yield Trial("under", at(thing, (0, d / 2 + 0.3, RADIUS_M)), way, 4.0)
    tops = {"table": h, "desk": h, "bench": h, "chair": 0.46, "sofa": 0.44, "bed": 0.47}
    heights = shelf_boards(h, 4)[:-1] if thing.label == "bookshelf" else [tops.get(thing.label)]
    for height in heights:
        if height is not None:
            aside = w / 4 if thing.label == "sofa" else 0.0
            yield Trial("on", at(thing, (aside, 0.03, height + RADIUS_M + 0.02)), still, 3.0)


def at(thing: SimulatedObject, place: Sequence[float]) -> Array:
    """Return a place in the frame of a thing in the world."""
    return np.array(thing.position) + thing.rotation() @ np.array(place, float)


def passes(body: Body, thing: SimulatedObject, trial: Trial) -> bool:
    """Return whether a ball does at a body what it does at the true thing."""
    model = alone(body, thing.position[2], trial)
    data = mujoco.MjData(model)
    data.qvel[:3] = trial.speed
    data.qvel[3:6] = np.cross([0, 0, 1], trial.speed) / RADIUS_M  # it rolls
    for _ in range(int(trial.seconds / STEP_S)):
        mujoco.mj_step(model, data)
    moved = data.qpos[:3] - trial.start
    if trial.kind == "under":
        return bool(moved @ trial.speed > thing.box().size[1] + 0.35)
    aside = float(np.hypot(*moved[:2]))
    if trial.kind == "in":
        rim = thing.position[2] + thing.box().size[2]
        radius = max(p.half[0] for p in thing.parts if p.open_top)
        return bool(aside < radius and thing.position[2] < data.qpos[2] < rim)
    return bool(aside < 0.15 and abs(moved[2] + 0.02) < 0.05)


def alone(body: Body, floor: float, trial: Trial) -> mujoco.MjModel:
    """Return a model of a fixed body, a floor and a ball."""
    geoms, meshes = body
    root = Xml.Element("mujoco")
    Xml.SubElement(root, "option", timestep=str(STEP_S), integrator="implicitfast")
    asset, world = Xml.SubElement(root, "asset"), Xml.SubElement(root, "worldbody")
    for name, vertices in meshes.items():
        Xml.SubElement(asset, "mesh", name=name, vertex=vertices)
    Xml.SubElement(world, "geom", type="plane", size="0 0 1", pos=f"0 0 {floor}")
    moving = Xml.SubElement(world, "body", pos=text(trial.start))
    Xml.SubElement(moving, "freejoint")
    Xml.SubElement(moving, "geom", BALL | {"friction": f"0.8 0.005 {ROLLING_M[trial.kind]}"})
    for geom in geoms:
        Xml.SubElement(world, "geom", geom)
    return mujoco.MjModel.from_xml_string(Xml.tostring(root, encoding="unicode"))


# ------------------------------------------------------------------------------------------------ forms


def true_body(thing: SimulatedObject) -> Body:
    """Return the parts of a true thing; thin shells of many pieces."""
    geoms: list[Geom] = []
    meshes: dict[str, str] = {}
    for part in thing.parts:
        yaw = thing.yaw + part.yaw
        quat = text([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        place = {"pos": text(at(thing, part.center)), "quat": quat}
        if not part.open_top:
            kind = {BOX: "box", CYLINDER: "cylinder", SPHERE: "sphere"}[part.kind]
            size = {BOX: part.half, CYLINDER: (part.half[0], part.half[2]), SPHERE: part.half[:1]}[part.kind]
            geoms.append({"type": kind, "size": text(size)} | place)
            continue
        for n, piece in enumerate(shell(part)):
            name = f"t{len(geoms)}_{n}"
            meshes[name] = text(at(thing, (0, 0, 0)) + piece @ thing.rotation().T)
            geoms.append({"type": "mesh", "mesh": name})
    return geoms, meshes


def shell(part: Part) -> Iterator[Array]:
    """Return convex pieces of an open cylinder or the lower half of a sphere, in the frame of the thing. (N, 3)."""
    r, half = part.half[0], part.half[2]
    angle = np.linspace(0, 2 * np.pi, 25)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(25)], axis=1)
    if part.kind == CYLINDER:
        rows = [(r, -half), (r, half)]
        base = np.concatenate([ring * [r, r, 1] + [0, 0, z] for z in (-half, SHELL_M - half)])
        yield base + part.center
    else:
        tilt = np.linspace(-np.pi / 2, 0, 9)
        rows = [(r * np.cos(t), r * np.sin(t)) for t in tilt]
    for (r0, z0), (r1, z1) in itertools.pairwise(rows):
        for k in range(24):
            corners = [
                [s * q * ring[j, 0], s * q * ring[j, 1], z if part.kind == CYLINDER else s * z]
                for j in (k, k + 1)
                for q, z in ((r0, z0), (r1, z1))
                for s in (1.0, 1.0 - SHELL_M / r)
            ]
            yield np.unique(np.round(corners, 7), axis=0) + part.center


def hull_body(scene: list3r.SceneMemory, instance: Instance) -> Body:
    """Return the convex hull of an instance's mesh."""
    mesh = instance_mesh(scene.store, instance)
    vertices = hull(instance.box.corners() if mesh is None else mesh.surface.vertices).vertices
    return [{"type": "mesh", "mesh": "hull"}], {"hull": text(vertices)}


def our_body(exported: Xml.Element, instance_id: int) -> Body:
    """Return what was exported of an instance."""
    body = next((b for b in exported.iter("body") if str(b.get("name")).endswith(f"_{instance_id}")), None)
    if body is None:
        return [], {}
    place = np.array(str(body.get("pos")).split(), float)
    geoms = [{"type": "mesh", "mesh": str(g.get("mesh"))} for g in body.findall("geom[@class='solid']")]
    vertices = {str(m.get("name")): m.get("vertex") for m in exported.iter("mesh") if m.get("vertex")}
    meshes = {g["mesh"]: np.array(str(vertices[g["mesh"]]).split(), float).reshape(-1, 3) + place for g in geoms}
    return geoms, {name: text(v) for name, v in meshes.items()}


def text(values: Any) -> str:
    return " ".join(f"{v:.6g}" for v in np.asarray(values, float).ravel())


# ------------------------------------------------------------------------------------------------ rest


def rested(model: mujoco.MjModel) -> dict[str, int]:
    """Let a scene be for 10 s; how many free bodies there are, explode, and stay."""
    data = mujoco.MjData(model)
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    mujoco.mj_forward(model, data)
    start, fastest = data.xpos[free].copy(), np.zeros(len(free))
    first = model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    for _ in range(int(10.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        speed = np.linalg.norm(data.qvel[first[:, None] + np.arange(3)], axis=1)
        fastest = np.maximum(fastest, np.where(np.isfinite(speed), speed, np.inf))
    moved = np.linalg.norm(data.xpos[free] - start, axis=1)
    exploded = (fastest > 5.0) | ~(moved < 1.0)
    return {"bodies": len(free), "exploded": int(exploded.sum()), "stayed": int((moved < 0.05).sum())}


def true_scene(objects: Sequence[SimulatedObject]) -> mujoco.MjModel:
    """Return the true things, free where they stand, in their true rooms."""
    root = Xml.Element("mujoco")
    Xml.SubElement(root, "option", timestep=str(STEP_S), integrator="implicitfast")
    asset, world = Xml.SubElement(root, "asset"), Xml.SubElement(root, "worldbody")
    Xml.SubElement(world, "geom", type="plane", size="0 0 1")
    for thing in objects:
        geoms, meshes = true_body(thing)
        body = Xml.SubElement(world, "body", name=f"{thing.label} {thing.id}")
        if thing.structure is None and thing.attached is None:
            Xml.SubElement(body, "freejoint")
        for name, vertices in meshes.items():
            Xml.SubElement(asset, "mesh", name=f"{thing.id}{name}", vertex=vertices)
        for geom in geoms:
            named = {"mesh": f"{thing.id}{geom['mesh']}"} if "mesh" in geom else {}
            Xml.SubElement(body, "geom", geom | named | {"density": str(DENSITY)})
    return mujoco.MjModel.from_xml_string(Xml.tostring(root, encoding="unicode"))


def hull_scene(exported: Xml.Element, scene: list3r.SceneMemory, folder: Path) -> mujoco.MjModel:
    """Return the exported scene with one hull for each thing."""
    root = Xml.fromstring(Xml.tostring(exported))
    root.find("compiler").set("meshdir", str(folder / "meshes"))
    asset = root.find("asset")
    for body in root.iter("body"):
        parts = body.findall("geom[@class='solid']")
        if not parts:
            continue
        instance = scene.instance(int(str(body.get("name")).rpartition("_")[2]))
        _, meshes = hull_body(scene, instance)
        place = np.array(str(body.get("pos")).split(), float)
        name = f"hull_{instance.id}"
        vertices = np.array(meshes["hull"].split(), float).reshape(-1, 3) - place
        Xml.SubElement(asset, "mesh", name=name, vertex=text(vertices))
        mass = sum(float((p.get("mesh") and p.get("mass")) or 0) for p in parts)
        for part in parts:
            body.remove(part)
        Xml.SubElement(body, "geom", {"class": "solid", "mesh": name} | ({"mass": f"{mass:.6g}"} if mass else {}))
    return mujoco.MjModel.from_xml_string(Xml.tostring(root, encoding="unicode"))


if __name__ == "__main__":
    main()
