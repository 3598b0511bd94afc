"""Exports of real memories as read by other libraries: counts, ids, boxes and relations against the store, and
validators.

python benchmarks/receivers.py MEMORY.l3r ... --json benchmarks/results/receivers.json

Instances and relations of the store are read back from scene JSON, GraphML, node-link JSON, CSV, Parquet and USD
(points alone, and meshes with colliders), each by another library; corners of boxes from the transforms of the USD
stage. Then usd-core's validators, and by `scripts/validate_usd.sh` NVIDIA's over both stages and the scene of props,
and Robotics-Prop 4.0.0 over each prop (`--no-nvidia` leaves these out). Status 1 where anything differs or complains.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import networkx
import numpy as np
from machine import write_json
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdValidation

import list3r
from list3r.exporters.components import has_box

ROOT = Path(__file__).resolve().parents[1]
DENSITY = 300.0
NEAR_M = 0.001

Triple = tuple[int, str, int]


@dataclass(frozen=True)
class Reading:
    """Content of one file about a memory."""

    ids: list[int]
    relations: list[Triple]
    corners: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """Of boxes, world, by instance, where the file holds boxes. Shape (8, 3)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("memories", nargs="+", type=Path)
    parser.add_argument("--no-nvidia", action="store_true", help="without the validators that take environments")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for path in args.memories:
        with tempfile.TemporaryDirectory() as folder:
            rows.append({"memory": path.stem, **examined(path, Path(folder), nvidia=not args.no_nvidia)})
        print(json.dumps(rows[-1]), flush=True)
    write_json(args.json, {"rows": rows})
    sys.exit(not all(row["sound"] for row in rows))


def examined(path: Path, folder: Path, *, nvidia: bool) -> dict[str, Any]:
    """Export a memory, read the files back and compare."""
    with list3r.open(path) as memory:
        store = stored(memory)
        metric = memory.units == "m"
        report: dict[str, Reading] = {}
        for name, (form, file, read) in READERS.items():
            if form != "parquet" or importlib.util.find_spec("pyarrow"):
                memory.export(form, folder / file, **({"colliders": True} if name == "usd meshes" else {}))
                report[name] = read(folder / file)
        if metric:
            memory.export("simready", folder / "props", density=DENSITY)
    stages = [folder / file for form, file, _ in READERS.values() if form == "usd"]
    row: dict[str, Any] = {
        "instances": len(store.ids),
        "relations": len(store.relations),
        "agree": {name: agrees(store, found) for name, found in report.items()},
        "box_mm": round(1e3 * max((off(store, found) for found in report.values()), default=0.0), 6),
        "usd_core_errors": sum(len(complaints(stage)) for stage in stages),
    }
    if nvidia:
        row |= validated(stages, folder / "props" if metric else None)
    row["sound"] = (
        all(row["agree"].values())
        and row["box_mm"] < 1e3 * NEAR_M
        and not row["usd_core_errors"]
        and row.get("nvidia_sound", True)
    )
    return row


def stored(memory: list3r.SceneMemory) -> Reading:
    """Return the content of the memory itself."""
    instances = memory.instances(structure=None)
    return Reading(
        sorted(i.id for i in instances),
        sorted((r.subject, r.predicate, r.object) for r in memory.relations()),
        {i.id: i.box.corners() for i in instances if has_box(i)},
    )


def agrees(store: Reading, found: Reading) -> bool:
    """Return whether ids and relations are the same, each as often."""
    return found.ids == store.ids and found.relations == store.relations


def off(store: Reading, found: Reading) -> float:
    """Return how far corners of boxes are from where they should, at most; infinite where a box is absent."""
    if not found.corners:
        return 0.0
    if set(found.corners) != set(store.corners):
        return float("inf")
    return max(float(np.abs(found.corners[k] - corners).max()) for k, corners in store.corners.items())


# ------------------------------------------------------------------------------------------------ readers


def read_scene(path: Path) -> Reading:
    """Read a scene JSON."""
    scene = json.loads(path.read_text(encoding="utf-8"))
    return Reading(
        sorted(i["id"] for i in scene["instances"]),
        sorted((r["subject"], r["predicate"], r["object"]) for r in scene["relations"]),
    )


def read_graph(path: Path) -> Reading:
    """Read GraphML or node-link JSON with networkx."""
    if path.suffix == ".graphml":
        graph = networkx.read_graphml(path, node_type=int, force_multigraph=True)
    else:
        graph = networkx.node_link_graph(json.loads(path.read_text(encoding="utf-8")), edges="edges")
    return Reading(sorted(graph), sorted((a, d["predicate"], b) for a, b, d in graph.edges(data=True)))


def read_csv(path: Path) -> Reading:
    """Read both tables of CSV."""
    objects, relations = (
        list(csv.DictReader(p.open(encoding="utf-8", newline=""))) for p in (path, path.with_name("c.relations.csv"))
    )
    return Reading(
        sorted(int(r["id"]) for r in objects),
        sorted((int(r["subject"]), r["predicate"], int(r["object"])) for r in relations),
    )


def read_parquet(path: Path) -> Reading:
    """Read both tables of Parquet with pyarrow."""
    import pyarrow.parquet as pq

    rows, relations = (pq.read_table(p).to_pylist() for p in (path, path.with_name("p.relations.parquet")))
    return Reading(
        sorted(r["id"] for r in rows), sorted((r["subject"], r["predicate"], r["object"]) for r in relations)
    )


def read_usd(path: Path) -> Reading:
    """Read a stage with usd-core."""
    stage = Usd.Stage.Open(str(path))
    ids = {p.GetPath(): p.GetAttribute("list3r:id").Get() for p in stage.Traverse(_all()) if _is_object(p)}
    relations, corners = [], {}
    unit = np.array([[i, j, k, 1.0] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
    for place, instance_id in ids.items():
        prim = stage.GetPrimAtPath(place)
        for relationship in prim.GetRelationships():
            predicate = relationship.GetName().removeprefix("list3r:relation:")
            if predicate != relationship.GetName():
                relations += [(instance_id, predicate, ids[target]) for target in relationship.GetTargets()]
        box = prim.GetChild("box")
        if box:
            T = np.array(UsdGeom.Imageable(box).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
            corners[instance_id] = (unit @ T)[:, :3]
    return Reading(sorted(ids.values()), sorted(relations), corners)


def _all() -> Any:
    return Usd.PrimIsActive & Usd.PrimIsDefined & ~Usd.PrimIsAbstract


def _is_object(prim: Usd.Prim) -> bool:
    return bool(prim.HasAttribute("list3r:id"))


READERS: dict[str, tuple[str, str, Callable[[Path], Reading]]] = {
    "json": ("json", "s.json", read_scene),
    "graphml": ("graphml", "g.graphml", read_graph),
    "node-link": ("node-link", "n.json", read_graph),
    "csv": ("csv", "c.csv", read_csv),
    "parquet": ("parquet", "p.parquet", read_parquet),
    "usd": ("usd", "points.usdc", read_usd),
    "usd meshes": ("usd", "meshes.usdc", read_usd),
}
"""By name: the format, the file, and its reader."""


# --------------------------------------------------------------------------------------------- validators


def complaints(path: Path) -> list[str]:
    """Return the findings of usd-core's own validators in a stage."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    stage = Usd.Stage.Open(str(path))
    return [e.GetMessage() for e in UsdValidation.ValidationContext(validators).Validate(stage)]


def validated(stages: list[Path], props: Path | None) -> dict[str, Any]:
    """Run NVIDIA's validators; whether they found nothing, and how many props there are and pass."""
    command = [str(ROOT / "scripts" / "validate_usd.sh"), *map(str, stages), *([str(props)] if props else [])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        print(done.stdout[-4000:], done.stderr[-2000:], sep="\n", file=sys.stderr)
    counts = re.search(r"(\d+) of (\d+) props pass", done.stdout)
    passed, every = map(int, counts.groups()) if counts else (0, 0)
    return {"nvidia_sound": done.returncode == 0, "props": every, "props_passed": passed}


if __name__ == "__main__":
    main()
