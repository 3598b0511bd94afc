"""info --loops: every loop candidate with its scores and verdict, and how surely each chunk is placed."""

from __future__ import annotations

from dataclasses import fields
from itertools import groupby
from typing import TYPE_CHECKING, Any

from list3r.cli.common import print_table
from list3r.cli.terminal import say

if TYPE_CHECKING:
    from list3r.memory.core.records import ChunkRow, Edge
    from list3r.memory.store.store import Store

_SCORES = ("s_det", "s_sem", "s_rel", "s_loop")
_ALSO_DET = "cosine"
"""Name of the similarity of two frames where instances were not compared."""


def loop_report(store: Store) -> dict[str, Any]:
    """Edges, components and uncertainties as plain numbers."""
    times = {(f.session_id, f.frame_index): f.time_s for f in store.frames.all() if f.state != "bad"}
    chunks = store.chunks.all()
    sessions = {c.chunk_id: c.session_id for c in chunks}
    parts = groupby(sorted(chunks, key=lambda c: (c.component, c.chunk_id)), lambda c: c.component)
    return {
        "edges": [_edge(e, sessions, times) for e in store.edges.all()],
        "parts": [_part(k, list(members)) for k, members in parts],
        "chunk_poses": [_chunk(c) for c in chunks],
    }


def _edge(edge: Edge, sessions: dict[int, int], times: dict[tuple[int, int], float]) -> dict[str, Any]:
    said = {f.name: getattr(edge, f.name) for f in fields(edge) if f.name not in ("S_v_u", "covariance")}
    pairs = None if edge.frames is None else zip((edge.u, edge.v), edge.frames, strict=True)
    return {**said, "times_s": None if pairs is None else [times.get((sessions.get(c, 0), f)) for c, f in pairs]}


def _part(component: int, chunks: list[ChunkRow]) -> dict[str, Any]:
    frames = [[c.session_id, c.first_frame, c.last_frame] for c in chunks]
    return {"component": component, "chunks": [c.chunk_id for c in chunks], "frames": frames}


def _chunk(chunk: ChunkRow) -> dict[str, Any]:
    """Standard deviations of a chunk's place, in the tangent's first order: along and about the worst axis."""
    import numpy as np

    entry: dict[str, Any] = {"chunk": chunk.chunk_id, "component": chunk.component, "sigma": None}
    if chunk.covariance is not None:
        C = chunk.covariance
        worst = (float(np.sqrt(max(np.linalg.eigvalsh(C[k, k])[-1], 0.0))) for k in (slice(3), slice(3, 6)))
        position, rotation = worst
        entry["sigma"] = {
            "position": float(chunk.S_world_chunk.scale) * position,
            "rotation_deg": float(np.rad2deg(rotation)),
            "scale": float(np.sqrt(max(C[6, 6], 0.0))),
        }
    return entry


def print_loop_report(report: dict[str, Any], units: str) -> None:
    """The report for people."""
    say("")
    _print_parts(report["parts"])
    _print_adjacent([e for e in report["edges"] if e["kind"] == "adjacent"], units)
    loops = [e for e in report["edges"] if e["kind"] == "loop"]
    accepted = sum(e["accepted"] for e in loops)
    say(f"loops: {len(loops)} candidates, {accepted} accepted, {len(loops) - accepted} rejected")
    if loops:
        say("")
        _print_loops(loops, units)
    placed = [(c["chunk"], c["sigma"]) for c in report["chunk_poses"] if c["sigma"] is not None]
    if placed:
        say("", "uncertainty of chunk positions relative to the first chunk of their part (one sigma, worst axis)")
        header = ["chunk", f"position +- ({units})", "rotation +- (deg)", "scale +- (%)"]
        print_table(([k, s["position"], s["rotation_deg"], 100 * s["scale"]] for k, s in placed), header)


def _print_parts(parts: list[dict[str, Any]]) -> None:
    if len(parts) < 2:
        say(
            f"one part: all {len(parts[0]['chunks'])} chunks share one frame of reference"
            if parts
            else "no chunk is stored yet"
        )
        return
    say(f"{len(parts)} parts that could not be joined; positions of different parts must not be compared:")
    for part in parts:
        frames = ", ".join(f"{a}-{b}" if s == 1 else f"session {s}: {a}-{b}" for s, a, b in _runs(part["frames"]))
        chunks = part["chunks"]
        named = f"chunk{'s' * (len(chunks) > 1)} {', '.join(map(str, chunks))}"
        say(f"  part {part['component']}: {named}, frames {frames}")


def _runs(frames: list[list[int]]) -> list[list[int]]:
    """Stretches of frames of chunks that follow on one another: [session, first, last]."""
    out: list[list[int]] = []
    for session, first, last in sorted(frames):
        if out and out[-1][0] == session and first <= out[-1][2] + 1:
            out[-1][2] = max(out[-1][2], last)
        else:
            out.append([session, first, last])
    return out


def _print_adjacent(edges: list[dict[str, Any]], units: str) -> None:
    if not edges:
        say("adjacent chunks: none joined by shared frames")
        return
    used = [e for e in edges if e["accepted"]]
    text = f"adjacent chunks: {len(edges)} pairs, {len(used)} joined by shared frames"
    if used:
        residuals = [e["residual_m"] for e in used]
        weak = min(used, key=lambda e: (e["weight"], e["u"], e["v"]))
        text += f"; residual {min(residuals):.3f} to {max(residuals):.3f} {units}, weakest {weak['u']}-{weak['v']}"
        text += f" with weight {weak['weight']:.2f}"
    say(text, *(f"  {e['u']}-{e['v']} not joined: {e['reason']}" for e in edges if not e["accepted"]))


def _print_loops(loops: list[dict[str, Any]], units: str) -> None:
    names = [s for s in _SCORES if any(_score(e, s) is not None for e in loops)]
    rows = [
        [
            f"{e['u']}-{e['v']}",
            "-".join(map(str, e["frames"] or "??")),
            "-".join(map(_two, e["times_s"] or (None, None))),
            *(_two(_score(e, s)) for s in names),
            e["inliers"],
            e["residual_m"] if e["inliers"] else "-",
            e["weight"] if e["accepted"] else "-",
            "accepted" if e["accepted"] else "rejected",
            e["reason"],
        ]
        for e in loops
    ]
    print_table(
        rows,
        ["chunks", "frames", "times (s)", *names, "inliers", f"resid {units}", "weight", "verdict", "why"],
    )


def _score(edge: dict[str, Any], name: str) -> float | None:
    scores = edge["scores"]
    value = scores.get(name, scores.get(_ALSO_DET) if name == "s_det" else None)
    return None if value is None else float(value)


def _two(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
