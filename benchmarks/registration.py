"""Registration of chunks by their things alone, in simulated homes that are seen again from elsewhere or changed.

python benchmarks/registration.py --preset opposite --seeds 66-80 --json FILE
python benchmarks/registration.py --judge FILE FILE --json BOTH     # stored scores by the thresholds as they are now

A home is filmed twice (`benchmarks.simulation.returns`): rooms and at last one of them, then that room again. Every
chunk of the second run is registered to the last five of the first, and to as many of another home, with
`list3r.association.revisits.constellations` and nothing else: no frame descriptor, no local feature, no joint window.
Masks are as discovery makes them in homes that it never saw, looks change with the side and with the light. A relation
is right when it puts what the older chunk saw within 0.35 m and 8 degrees of where it is (chunks bend, and a scale that
is 5 % off moves a far wall by 0.2 m); how many lie within 0.1 m and 3 degrees is told beside. A home is joined when a
relation is believed that is right, and its error is that of the best supported one.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, write_json

RIGHT_M, RIGHT_DEG = 0.35, 8.0
CLOSE_M, CLOSE_DEG = 0.1, 3.0
CHUNKS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="opposite")
    parser.add_argument("--seeds", default="61-80", help="first-last")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--judge", type=Path, nargs="+")
    words = parser.parse_args()
    if words.judge:
        return _judged_again(words.judge, words.json)
    first, last = (int(n) for n in words.seeds.split("-"))
    pairs: list[dict[str, Any]] = []
    before: Any = None
    for seed in range(first, last + 1):
        started = time.process_time()
        home = _home(words.preset, seed)
        pairs += _registered(home, home, seed) + (_registered(before, home, seed) if before else [])
        before = home
        found = summary(pairs)
        print(f"seed {seed}: {time.process_time() - started:.1f} s of CPU; so far {found}", flush=True)
        write_json(words.json, {"preset": words.preset, "total": found, "pairs": pairs})
    print(machine())


def _judged_again(paths: list[Path], out: Path | None) -> None:
    """Judge stored scores by the thresholds as they are now."""
    from list3r.association.revisits.constellations.registration import ConstellationRegistrationSettings, doubt

    held = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    pairs = [p for h in held for p in h["pairs"]]
    for pair in pairs:
        pair["believed"] = "agreeing" in pair and doubt(pair, ConstellationRegistrationSettings()) is None
    found = summary(pairs)
    print(json.dumps(found))
    scored_at = [h["commit"] for h in held]
    write_json(out, {"preset": held[0]["preset"], "scored_at": scored_at, "total": found, "pairs": pairs})


def summary(pairs: list[dict[str, Any]]) -> dict[str, Any]:
    """What was joined, how rightly and how well."""
    homes = sorted({p["seed"] for p in pairs})
    believed = [p for p in pairs if p["believed"]]
    best = {s: max((p for p in believed if p["seed"] == s), key=lambda p: p["support"], default=None) for s in homes}
    right = [p for p in best.values() if p and p["right"]]
    close = [p for p in right if p["off_m"] <= CLOSE_M and p["off_deg"] <= CLOSE_DEG]
    return {
        "homes": len(homes),
        "joined": len({p["seed"] for p in believed if p["right"]}),
        "by_two_relations": sum(sum(p["right"] for p in believed if p["seed"] == s) >= 2 for s in homes),
        "within_0.1_m_and_3_deg": len(close),
        "pairs": len(pairs),
        "believed": len(believed),
        "precision": round(sum(p["right"] for p in believed) / len(believed), 4) if believed else None,
        "median_m": round(statistics.median(p["off_m"] for p in right), 3) if right else None,
        "median_deg": round(statistics.median(p["off_deg"] for p in right), 2) if right else None,
    }


def _home(preset: str, seed: int) -> dict[str, Any]:
    """Chunks of both runs of a home, and where they truly are."""
    from benchmarks.feedforward_sim.feedforward import FeedForwardModel, FeedForwardSettings
    from benchmarks.simulation.returns import make_return
    from list3r.association.revisits.constellations.registration import ConstellationRegistrationSettings
    from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks

    video = make_return(preset, seed)
    model = FeedForwardModel(video, FeedForwardSettings.unseen_home(preset == "halls"), seed=seed)
    spans = plan_chunks(len(video.time_s), ChunkSettings(), video.cuts)
    runs = [s for s in spans if s.stop <= video.cuts[0]][-CHUNKS:], [s for s in spans if s.start >= video.cuts[0]]
    settings = ConstellationRegistrationSettings()
    return {
        "settings": settings,
        "runs": [[_place(video, model.chunk(span), settings) for span in run] for run in runs],
    }


def _place(video: Any, result: Any, settings: Any) -> tuple[Any, Any]:
    """A chunk as registration looks at it, and its S_truth_chunk."""
    from list3r.association.revisits.constellations.constellation import make_constellation
    from list3r.association.revisits.constellations.registration import RegisteredChunk
    from list3r.association.revisits.constellations.surface_fit import ChunkSurfaces
    from list3r.association.revisits.cross_check import Side
    from list3r.association.revisits.cues import CueSettings, instance_set
    from list3r.frames.base import Camera
    from list3r.memory.store.tables.local_instances import LocalNode

    height, width = result.image_size
    nodes = [
        LocalNode(
            *(result.index, i.local_id, 1, i.stability, i.structure, i.dynamic, i.plane, i.feature, i.support),
            *(i.track.frames, i.track.boxes_xyxy, i.track.areas_px, i.track.visible_fraction),
        )
        for i in result.library.instances
    ]
    space = result.library.feature_space
    instances = instance_set(nodes, result.samples.T_chunk_cam, space, CueSettings())
    side = Side(result.samples, Camera(width, height, *result.intrinsics), instances)
    constellation = make_constellation(nodes, side, space, settings.constellation)
    surfaces = ChunkSurfaces(side, constellation.unit, settings.surfaces)
    return RegisteredChunk(constellation, surfaces, side), _to_truth(video, result.samples)


def _to_truth(video: Any, samples: Any) -> Any:
    """The similarity that lays a chunk's samples on the world best."""
    from list3r.memory.geometry import umeyama

    camera = video.camera
    row, column = np.divmod(samples.pixel, camera.width)
    z = video.depth[samples.frame, row, column].astype(np.float64)
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(row))], axis=1)
    T = video.T_world_cam[samples.frame]
    there = np.einsum("nij,nj->ni", T[:, :3, :3], z[:, None] * rays) + T[:, :3, 3]
    here, there = samples.points[z > 0].astype(np.float64), there[z > 0]
    off = np.linalg.norm(umeyama(here, there, with_scale=True).apply(here) - there, axis=1)
    good = off < 2 * np.median(off)
    return umeyama(here[good], there[good], with_scale=True)


def _registered(old: dict[str, Any], new: dict[str, Any], seed: int) -> list[dict[str, Any]]:
    """All pairs of a chunk of the first run of one home and one of the second run of another, or of the same."""
    from list3r.association.revisits.constellations.registration import doubt, register

    rows = []
    for place_u, S_truth_u in old["runs"][0]:
        for place_v, S_truth_v in new["runs"][1]:
            found = register(place_u, place_v, False, new["settings"])
            row = {"seed": seed, "same_home": old is new, "believed": False, "right": False, "support": 0.0}
            if found is not None:
                error = S_truth_v @ found.S_v_u @ S_truth_u.inverse()
                points = S_truth_u.apply(place_u.surfaces.points[::40])
                off_m = float(np.median(np.linalg.norm(error.apply(points) - points, axis=1)))
                off_deg = float(np.degrees(np.arccos(np.clip((np.trace(error.rotation) - 1) / 2, -1, 1))))
                right = old is new and off_m <= RIGHT_M and off_deg <= RIGHT_DEG
                row |= {"believed": doubt(found.scores, new["settings"]) is None, "right": right}
                row |= {"off_m": round(off_m, 4), "off_deg": round(off_deg, 3)}
                row |= {name: round(value, 4) for name, value in found.scores.items()}
            rows.append(row)
    return rows


if __name__ == "__main__":
    main()
