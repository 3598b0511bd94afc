"""Change detection between two visits, in homes from another source than the simulator of `sessions.py`.

PYTHONPATH=. python benchmarks/changes_elsewhere.py --seeds 7001-7006 --keep FOLDER --json FILE
PYTHONPATH=. python benchmarks/changes_elsewhere.py --house FOLDER/aws-robomaker-small-house-world --seeds 1-4

Worlds and house are those of `discovery.py`, filmed twice with a sensor's depth; the second walk goes the other way
round. In between up to two objects each are moved, removed and added, drawn from seen objects that two people can carry
and that support nothing; moved objects end on the floor or on another object. `list3r build` makes a memory of the
first walk from unknown poses, `list3r update` adds the second. Scoring is that of `sessions.py`, except: a change is
due only where the second walk could see it (`known_places.py`), and an object counts as moved only if it was moved, not
if its box shows another side.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from discovery import seeds_of
from discovery_memory import SENSORS, write_film
from known_places import KnownPlaces
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray
from sessions import measure, total

from list3r.evaluation.scene import read_scene
from list3r.evaluation.trajectory import Trajectory, write_tum
from list3r.memory.store.store import Store
from training.worlds.film import Film, FilmSettings, Visit, make_film, world_extents
from training.worlds.gazebo import film_house, house_extents

Array = NDArray[np.float64]
FRAMES = 120
PROBE = 8
"""Every n-th frame is used to draw the changes."""
LEAST_PX = 300
"""Pixels of a view from which an object may be changed."""
MOST_M = 2.0
"""Longest edge of a moved object."""
EACH = 2
"""Objects that are moved, removed, added."""

Filmer = Callable[[Visit, int, int], Film]
"""Films a visit with so many frames, every n-th of the way."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="7001-7006")
    parser.add_argument("--methods", default="learned", help="such as learned,sam2")
    parser.add_argument("--house", type=Path, help="folder of aws-robomaker-small-house-world")
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in seeds_of(args.seeds):
            root = (args.keep or Path(scratch)) / f"{'house' if args.house else 'world'}-{seed}"
            if not (root / "second" / "truth.json").exists():
                film_twice(root, seed, args.house)
            for method in args.methods.split(","):
                rows.append({"method": method, "seed": seed, **one_home(root, method)})
                print(json.dumps(rows[-1]), flush=True)
    table = {m: total([r for r in rows if r["method"] == m]) for m in dict.fromkeys(r["method"] for r in rows)}
    print(machine())
    print(json.dumps(table, indent=1))
    write_json(args.json, {"frames": FRAMES, "total": table, "homes": rows})


def film_twice(root: Path, seed: int, house: Path | None) -> None:
    """Write both walks of a seed with their truth."""
    sensor = SENSORS[seed % 3]
    if house is not None:
        extents = house_extents(house)
        film: Filmer = lambda visit, frames, every: film_house(house, seed, sensor, frames, every, visit)  # noqa: E731
    else:
        world = FilmSettings(seed, held_out=True, sensor=sensor)
        extents = world_extents(world)
        film = lambda visit, frames, every: make_film(  # noqa: E731
            FilmSettings(seed, held_out=True, frames=frames, every=every, sensor=sensor), visit
        )
    moved, removed, added = drawn(extents, film(Visit(), FRAMES // PROBE, PROBE), np.random.default_rng([seed, 23]))
    visits = {"first": Visit(0, dict.fromkeys(added)), "second": Visit(1, {**moved, **dict.fromkeys(removed)})}
    for name, visit in visits.items():
        shown = film(visit, FRAMES, 1)
        write_film(root / name, shown, seed)
        write_tum(root / name / "groundtruth.txt", Trajectory(shown.time_s, shown.T_world_cam))
        truth = read_scene(root / name / "truth.json")
        for entry in truth["instances"]:
            shift = visit.shifts.get(entry["id"])
            entry["carried"] = [0.0, 0.0, 0.0] if shift is None else shift.tolist()
        (root / name / "truth.json").write_text(json.dumps(truth))


def drawn(
    extents: Mapping[int, Array], probe: Film, rng: np.random.Generator
) -> tuple[dict[int, Array], list[int], list[int]]:
    """Return the moved (id and shift, metres), removed and added objects, drawn from those seen on the way."""
    largest = {k: int(max((probe.ids == k).sum(axis=(1, 2)))) for k in extents}
    free = [k for k, e in extents.items() if largest[k] >= LEAST_PX and _can_be_carried(k, e, extents)]
    order = [free[n] for n in rng.permutation(len(free)).tolist()]
    removed, added, moved = order[0::3][:EACH], order[1::3][:EACH], {}
    for k in (k for k in order if k not in removed and k not in added and _is_supported(k, extents)):
        others = {n: e for n, e in extents.items() if n != k and n not in removed}
        shift = _shift(k, extents[k], others, moved, probe, rng)
        if shift is not None and len(moved) < EACH:
            moved[k] = shift
    return moved, removed, added


def _can_be_carried(k: int, extent: Array, extents: Mapping[int, Array]) -> bool:
    low, high = extent
    if (high - low).max() > MOST_M:
        return False
    middle = {n: e.mean(axis=0) for n, e in extents.items() if n != k}
    inside = {n: bool(((m > low) & (m < high))[:2].all()) for n, m in middle.items()}
    return not any(inside[n] and low[2] + 0.02 < extents[n][0, 2] < high[2] + 0.05 for n in middle)


def _is_supported(k: int, extents: Mapping[int, Array]) -> bool:
    others = {n: e for n, e in extents.items() if n != k}
    return bool(extents[k][0, 2] < 0.05) or _support(extents[k], others) is not None


def _support(extent: Array, others: Mapping[int, Array]) -> int | None:
    """The object that supports another."""
    at = extent.mean(axis=0)
    for n, (low, high) in others.items():
        if abs(high[2] - extent[0, 2]) < 0.04 and ((at > low) & (at < high))[:2].all():
            return n
    return None


def _shift(
    k: int,
    extent: Array,
    others: Mapping[int, Array],
    moved: Mapping[int, Array],
    probe: Film,
    rng: np.random.Generator,
) -> Array | None:
    """A way to a free place on the same support that the probe sees; None where none was found."""
    now = {n: e + moved.get(n, 0.0) for n, e in others.items()}
    support = _support(extent, now)
    for _ in range(300):
        angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 1.2)
        shift = np.array([far * np.cos(angle), far * np.sin(angle), 0.0])
        low, high = extent + shift
        if support is not None and not (
            (low[:2] > now[support][0, :2] - 0.02).all() and (high[:2] < now[support][1, :2] + 0.02).all()
        ):
            continue
        met = [n for n, e in now.items() if n != support and (low < e[1] + 0.02).all() and (high > e[0] - 0.02).all()]
        if not met and _seen_free(np.stack([low, high]), probe):
            return shift
    return None


def _seen_free(extent: Array, probe: Film) -> bool:
    """Whether a view sees through the whole space that an object would take."""
    corners = np.array([[extent[i, 0], extent[j, 1], extent[m, 2]] for i in (0, 1) for j in (0, 1) for m in (0, 1)])
    corners[:, 2] += 0.03 * (corners[:, 2] == extent[0, 2])
    camera = probe.camera
    for T, depth in zip(probe.T_world_cam, probe.true_depth, strict=True):
        x, y, z = ((corners - T[:3, 3]) @ T[:3, :3]).T
        if (z < 0.3).any():
            continue
        u = np.rint(camera.fx * x / z + camera.cx).astype(int)
        v = np.rint(camera.fy * y / z + camera.cy).astype(int)
        if (u < 0).any() or (v < 0).any() or (u >= camera.width).any() or (v >= camera.height).any():
            continue
        behind = depth[v, u]
        if ((behind == 0) | (behind > z)).all():
            return True
    return False


def one_home(root: Path, method: str) -> dict[str, Any]:
    """Build, update, measure."""
    one, two = root / f"one-{method}.l3r", root / f"two-{method}.l3r"
    common = ("--poses", "estimate", "--workers", "1", "--discovery", method)
    if not one.exists():
        part = root / "part.l3r"
        run_list3r("build", str(root / "first"), "-m", str(part), "--force", *common)
        part.rename(one)
    two.unlink(missing_ok=True)
    shutil.copy(one, two)
    report, usage = run_list3r("update", str(two), str(root / "second"), *common)
    out = {"placed": report["placed"], "chunks": report["chunks"], **usage}
    walks = [root / name for name in ("first", "second")]
    with Store.open(one) as before, Store.open(two) as after:
        return out | measure(before, after, walks, KnownPlaces(walks).due(1))


if __name__ == "__main__":
    main()
