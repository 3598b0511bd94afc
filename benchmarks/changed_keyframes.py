"""Second sessions after heavy change, by their keyframes alone: how often are they placed, and how often wrongly?

python benchmarks/changed_keyframes.py --seeds 441-460 --json benchmarks/results/changed-keyframes.json

The homes and walks of `changed_homes.py`, of which only every --every-th frame is rendered and taken as a keyframe at
its true pose, so that a home costs seconds. All keyframes of the second session are compared with all of the first one
(`place_by_all_keyframes`, nothing else), and with those of the previous home, and the reverse: strangers, which must
never be placed. Right means that the cameras of the first session are within 0.1 m and 3 degrees (medians) of where
they are. `rule_of_two` is the placement by two agreeing relations alone: right, wrong or none.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from changed_homes import MOST_DEG, MOST_M
from machine import STARTED_AT, machine, write_json

from benchmarks.simulation.walks import HomeSessionWalk
from list3r.association.revisits.all_keyframes import place_by_all_keyframes
from list3r.association.revisits.session_edges import defer_session_edges
from list3r.association.revisits.verification import VerificationSettings, verify
from list3r.frames.base import Frame
from list3r.memory.core.records import Edge, Keyframe
from list3r.reconstruction.keyframe_record import make_keyframes
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.rendering.sensor import sense
from list3r.simulation.rendering.shading import EVENING

Sessions = tuple[list[Keyframe], list[Keyframe]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="441-460", help="first-last")
    parser.add_argument("--every", type=int, default=5, help="frames between keyframes")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split("-"))
    rows: list[dict[str, Any]] = []
    before: Sessions | None = None
    for seed in range(first, last + 1):
        started = time.process_time()
        home = _filmed(seed, args.every)
        row = {"seed": seed, "commit": STARTED_AT, **_judged(home)}
        if before is not None:
            mixed = (before[0], home[1]), (home[0], before[1])
            row["strangers_placed"] = sum(bool(_placed(*sessions)) for sessions in mixed)
        rows.append(row | {"cpu_s": round(time.process_time() - started, 1)})
        before = home
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.json, {"every": args.every, "homes": rows, "total": total(rows)})
    print(machine())
    print(json.dumps(total(rows), indent=1))


def _filmed(seed: int, every: int) -> Sessions:
    """Return the keyframes of both sessions of a home, in its world."""
    walks = (
        HomeSessionWalk(seed=seed, walk_seed=seed),
        HomeSessionWalk(seed=seed, walk_seed=seed + 1000, second=True, lighting=EVENING),
    )
    return _keyframes(walks[0], every), _keyframes(walks[1], every)


def _keyframes(walk: HomeSessionWalk, every: int) -> list[Keyframe]:
    renderer, frames = Renderer(walk.world(), walk.camera(), [], walk.lighting), []
    assert walk.walk_seed is not None
    for index, (time_s, pose) in enumerate(zip(*walk.poses(), strict=True)):
        if index % every == 0:
            seen = sense(renderer.render(pose), walk.sensor, walk.walk_seed, index, float(time_s))
            frames.append(Frame(index, float(time_s), seen.color, seen.depth, pose))
    made = RgbdReconstructor(poses="given")(frames, walk.camera())
    return list(make_keyframes(frames, replace(made, keyframes=np.flatnonzero(made.posed)), keep_jpeg=False))


def _placed(first: list[Keyframe], second: list[Keyframe]) -> list[Edge]:
    return place_by_all_keyframes((1, first), (2, second), VerificationSettings())


def _judged(home: Sessions) -> dict[str, Any]:
    """Outcome of the second session."""
    found = _placed(*home)
    pairs = [verify(a, b, 1, 2, later=True) for a, b in itertools.product(*home)]
    accepted = [e for e in pairs if e.accepted]
    row: dict[str, Any] = {"placed": _verdict(found[:1], home[0]), "pairs": len(pairs), "accepted": len(accepted)}
    row["accepted_wrong"] = sum(_verdict([e], home[0]) == "wrong" for e in accepted)
    row["rule_of_two"] = _verdict([e for e in defer_session_edges(accepted, {1: 1, 2: 2}) if e.accepted][:1], home[0])
    if found:
        off_m, off_deg = _off(found[0], home[0])
        row |= {"off_m": round(off_m, 4), "off_deg": round(off_deg, 3), "witnessed": found[0].scores["witnessed"]}
    return row


def _off(edge: Edge, first: Sequence[Keyframe]) -> tuple[float, float]:
    """Return by how many metres and degrees a relation moves the cameras of the first session; none is the truth."""
    eyes = np.array([k.T_chunk_cam[:3, 3] for k in first])
    turned = np.degrees(np.arccos(np.clip((np.trace(edge.S_v_u.rotation) - 1.0) / 2.0, -1.0, 1.0)))
    return float(np.median(np.linalg.norm(edge.S_v_u.apply(eyes) - eyes, axis=1))), float(turned)


def _verdict(found: Sequence[Edge], first: Sequence[Keyframe]) -> str:
    if not found:
        return "apart"
    off_m, off_deg = _off(found[0], first)
    return "right" if off_m <= MOST_M and off_deg <= MOST_DEG else "wrong"


def total(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """How many sessions are in their place, in a wrong one or apart."""
    off = [r["off_m"] for r in rows if r["placed"] == "right"]
    counts = {f"{way}_{said}": sum(r[way] == said for r in rows) for way in ("placed", "rule_of_two") for said in SAID}
    return {
        "homes": len(rows),
        **counts,
        "relations_accepted": sum(r["accepted"] for r in rows),
        "relations_wrong": sum(r["accepted_wrong"] for r in rows),
        "strangers": 2 * (len(rows) - 1),
        "strangers_placed": sum(r.get("strangers_placed", 0) for r in rows),
        "median_off_m": float(np.median(off)) if off else None,
        "worst_off_m": max(off, default=None),
    }


SAID = ("right", "wrong", "apart")

if __name__ == "__main__":
    main()
