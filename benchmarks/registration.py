"""Registration by objects alone, in simulated homes that are seen again from elsewhere or changed.

python benchmarks/registration.py --preset opposite --seeds 161-180 --json FILE
python benchmarks/registration.py --preset opposite --seeds 161-180 --sensor --json FILE

A home is filmed twice (`benchmarks.simulation.returns`): rooms and at last one of them, then that room again. The
chunks of the first run are put into a memory by the program itself. Then those of the second run follow, and after them
those of another home; for each, `find_loops` returns its edges. There is no joint window and keyframes have no
features, so that only instances can join the runs. Masks are as of discovery in unseen homes, appearance changes with
the side and with the light. Edges are not added to the memory, so that each chunk is scored alone.

A relation is right when its error at the older chunk's points is within 0.35 m and 8 degrees (chunks are deformed, and
a scale error of 5 % moves a far wall by 0.2 m); the number within 0.1 m and 3 degrees is given too. A home is joined
when a correct relation is accepted; its error is that of the best supported one, placed by the pose graph with all
accepted ones. With `--sensor` the geometry is that of a depth sensor: metric, chunks bent by millimetres; masks and
appearance are as bad as without.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import machine, write_json

RIGHT_M, RIGHT_DEG = 0.35, 8.0
CLOSE_M, CLOSE_DEG = 0.1, 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="opposite")
    parser.add_argument("--seeds", default="61-80", help="first-last")
    parser.add_argument("--sensor", action="store_true", help="geometry of a depth sensor")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split("-"))
    pairs: list[dict[str, Any]] = []
    other: Home | None = None
    for seed in range(first, last + 1):
        started = time.process_time()
        home = Home(args.preset, seed, args.sensor)
        with tempfile.TemporaryDirectory() as scratch:
            for store, chunk_id, truth, same in home.arrivals(Path(scratch) / "memory.l3r", other):
                judged = judged_loops(store, chunk_id, truth, same)
                pairs += [{"seed": seed, **row} for row in judged if row["u"] < home.second]
        other = home
        found = summary(pairs)
        print(f"seed {seed}: {time.process_time() - started:.1f} s of CPU; so far {found}", flush=True)
        write_json(args.json, {"preset": args.preset, "sensor": args.sensor, "total": found, "pairs": pairs})
    print(machine())


def summary(pairs: list[dict[str, Any]]) -> dict[str, Any]:
    """Joined homes, precision and errors."""
    homes = sorted({p["seed"] for p in pairs})
    believed = [p for p in pairs if p["believed"]]
    best = {s: max((p for p in believed if p["seed"] == s), key=lambda p: p["support"], default=None) for s in homes}
    right = [p for p in best.values() if p and p["right"]]
    close = [p for p in right if p["placed_m"] <= CLOSE_M and p["placed_deg"] <= CLOSE_DEG]
    return {
        "homes": len(homes),
        "joined": len({p["seed"] for p in believed if p["right"]}),
        "joined_wrongly": len({p["seed"] for p in believed if not p["right"]}),
        "within_0.1_m_and_3_deg": len(close),
        "pairs": len(pairs),
        "believed": len(believed),
        "precision": round(sum(p["right"] for p in believed) / len(believed), 4) if believed else None,
        "median_m": round(statistics.median(p["placed_m"] for p in right), 3) if right else None,
        "median_deg": round(statistics.median(p["placed_deg"] for p in right), 2) if right else None,
    }


class Home:
    """Chunks of both runs of a home; of each run the ones named by `kept`."""

    def __init__(
        self, preset: str, seed: int, sensor: bool = False, kept: tuple[slice, slice] = (slice(None), slice(None))
    ) -> None:
        from benchmarks.feedforward_sim.feedforward import FeedForwardModel, FeedForwardSettings
        from benchmarks.simulation.returns import make_return
        from list3r.association.overlap.motion import flag_dynamic
        from list3r.frames.base import Camera
        from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks

        errors = FeedForwardSettings.unseen_home(preset == "halls")
        if sensor:
            errors = replace(_sensor(), instances=errors.instances, descriptors=errors.descriptors)
        self.video = make_return(preset, seed)
        model = FeedForwardModel(self.video, errors, seed=seed)
        spans = plan_chunks(len(self.video.time_s), ChunkSettings(), self.video.cuts)
        self.runs: list[list[Any]] = []
        for second, part in enumerate(kept):
            self.runs.append([])
            for span in [s for s in spans if (s.start >= self.video.cuts[0]) == second][part]:
                made = model.chunk(span)
                height, width = made.image_size
                flagged = flag_dynamic(made.samples, made.library, Camera(width, height, *made.intrinsics))
                kind = "metric" if sensor else made.scale_kind
                self.runs[-1].append(replace(made, library=flagged, scale_kind=kind))
        self.second = 0
        """Chunk id of the first one of the second run, once it arrived."""

    def arrivals(self, path: Path, other: Home | None) -> Iterator[tuple[Any, int, dict[int, Any], bool]]:
        """A memory of the first run, the chunk that came last, S_truth_chunk of all of this home, and whether that
        chunk is of this home."""
        from list3r.memory.store.store import Store
        from list3r.pipeline.mapping import add_chunk
        from list3r.pipeline.settings import AssociationSettings

        usual = AssociationSettings()
        alone = replace(usual.revisits, instances=replace(usual.revisits.instances, enabled=False))
        settings = replace(usual, revisits=alone)
        kind = self.runs[0][0].scale_kind
        truth: dict[int, Any] = {}
        with Store.create(path) as store:
            with store.transaction():
                store.facts.scale_kind, store.facts.gravity, store.facts.poses = kind, "unknown", "estimate"
                session = store.sessions.add("simulation", "", {}, len(self.video.time_s))
            for run, results in enumerate(self.runs):
                for result in results:
                    chunk_id = add_chunk(store, session, result, None, settings, library=False)
                    truth[chunk_id] = to_truth(self.video, store.chunks.samples(chunk_id))
                    if run:
                        self.second = self.second or chunk_id
                        yield store, chunk_id, truth, True
            if other is None:
                return
            with store.transaction():
                session = store.sessions.add("another home", "", {}, len(other.video.time_s))
            for result in other.runs[1]:
                chunk_id = add_chunk(store, session, result, None, settings, library=False)
                yield store, chunk_id, truth, False


def _sensor() -> Any:
    """Geometry as of a depth sensor and its odometry: no gauge, 1 % of noise, chunks bent by millimetres."""
    from benchmarks.feedforward_sim.feedforward import FeedForwardSettings

    usual, exact = FeedForwardSettings(), FeedForwardSettings.exact()
    poses = replace(exact.poses, bending=usual.poses.bending / 10)
    depth = replace(exact.depth, noise=0.01)
    return replace(usual, gauge_scale=0.0, poses=poses, depth=depth, movers=exact.movers)


def judged_loops(store: Any, chunk_id: int, truth: dict[int, Any], same: bool) -> list[dict[str, Any]]:
    """Registration of a chunk by objects, and its error."""
    from list3r.association.revisits.search import find_loops

    edges = [e for e in find_loops(store, chunk_id) if "things_pairs" in e.scores]
    placed = _placed(store, chunk_id, [e for e in edges if e.accepted]) if same else {}
    rows = []
    for edge in edges:
        row: dict[str, Any] = {"u": edge.u, "v": edge.v, "same_home": same, "believed": edge.accepted, "right": False}
        if same:
            off_m, off_deg = _off(store, truth, edge.u, chunk_id, edge.S_v_u)
            row |= {"right": off_m <= RIGHT_M and off_deg <= RIGHT_DEG, "off_m": off_m, "off_deg": off_deg}
        if edge.u in placed:
            row["placed_m"], row["placed_deg"] = _off(store, truth, edge.u, chunk_id, placed[edge.u])
        row |= {k.removeprefix("things_"): round(v, 4) for k, v in edge.scores.items() if k.startswith("things_")}
        rows.append(row | {"reason": edge.reason})
    return rows


def _off(store: Any, truth: dict[int, Any], u: int, v: int, S_v_u: Any) -> tuple[float, float]:
    """Error of a relation at the points of u: metres (median) and degrees."""
    error = truth[v] @ S_v_u @ truth[u].inverse()
    points = store.chunks.samples(u).points
    points = truth[u].apply(points[np.isfinite(points).all(axis=1)][::40].astype(np.float64))
    off_m = float(np.median(np.linalg.norm(error.apply(points) - points, axis=1)))
    off_deg = float(np.degrees(np.arccos(np.clip((np.trace(error.rotation) - 1) / 2, -1, 1))))
    return round(off_m, 4), round(off_deg, 3)


class _Undone(Exception):
    """Ends a transaction that only asks."""


def _placed(store: Any, chunk_id: int, believed: list[Any]) -> dict[int, Any]:
    """S_v_u to the chunks that a chunk is joined to, where the pose graph puts them by all that is believed."""
    from list3r.pipeline.placing import place_chunks

    placed: dict[int, Any] = {}
    try:
        with store.transaction():
            store.edges.add(believed)
            place_chunks(store, None, chunk_id)
            world = {c.chunk_id: c.S_world_chunk for c in store.chunks.all()}
            placed = {e.u: world[chunk_id].inverse() @ world[e.u] for e in believed}
            raise _Undone
    except _Undone:
        return placed


def to_truth(video: Any, samples: Any) -> Any:
    """The similarity that lays a chunk's samples on the world best."""
    from list3r.memory.core.geometry import umeyama

    row, column = np.divmod(samples.pixel, video.camera.width)
    known = video.depth[samples.frame, row, column] > 0
    there = video.points(samples.frame, row, column)[known]
    here = samples.points[known].astype(np.float64)
    off = np.linalg.norm(umeyama(here, there, with_scale=True).apply(here) - there, axis=1)
    good = off < 2 * np.median(off)
    return umeyama(here[good], there[good], with_scale=True)


if __name__ == "__main__":
    main()
