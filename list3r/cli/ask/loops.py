"""info --loops: every loop candidate with its scores and verdict, and how surely each chunk is placed."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

from list3r.cli.terminal import say

if TYPE_CHECKING:
    from list3r.memory.core.records import ChunkRow, Edge
    from list3r.memory.store.store import Store

_WIDTH = 100
_SCORES = ("s_det", "s_sem", "s_rel", "s_loop")
_ALSO_DET = "cosine"
"""Name of the similarity of two frames where instances were not compared."""


def loop_report(store: Store) -> dict[str, Any]:
    """Edges, components and uncertainties as plain numbers."""
    times = {(f.session_id, f.frame_index): f.time_s for f in store.frames.all() if f.state != "bad"}
    sessions = {c.chunk_id: c.session_id for c in store.chunks.all()}
    return {
        "edges": [_edge(e, sessions, times) for e in store.edges.all()],
        "parts": _components(store.chunks.all()),
        "chunk_poses": [_chunk(c) for c in store.chunks.all()],
    }


def _edge(edge: Edge, sessions: dict[int, int], times: dict[tuple[int, int], float]) -> dict[str, Any]:
    frames = edge.frames
    pair = None if frames is None else [(sessions.get(c, 0), f) for c, f in zip((edge.u, edge.v), frames, strict=True)]
    return {
        "u": edge.u,
        "v": edge.v,
        "kind": edge.kind,
        "frames": None if frames is None else list(frames),
        "times_s": None if pair is None else [times.get(p) for p in pair],
        "inliers": edge.inliers,
        "residual_m": edge.residual_m,
        "confidence": edge.confidence,
        "weight": edge.weight,
        "accepted": edge.accepted,
        "reason": edge.reason,
        "scores": edge.scores,
    }


def _components(chunks: list[ChunkRow]) -> list[dict[str, Any]]:
    names = sorted({c.component for c in chunks})
    members = {k: [c for c in chunks if c.component == k] for k in names}
    return [
        {
            "component": k,
            "chunks": [c.chunk_id for c in members[k]],
            "frames": [[c.session_id, c.first_frame, c.last_frame] for c in members[k]],
        }
        for k in names
    ]


def _chunk(chunk: ChunkRow) -> dict[str, Any]:
    """Standard deviations of a chunk's place, in the tangent's first order: along and about the worst axis."""
    import numpy as np

    entry: dict[str, Any] = {"chunk": chunk.chunk_id, "component": chunk.component, "sigma": None}
    if chunk.covariance is not None:
        C = chunk.covariance
        position, rotation = (
            float(np.sqrt(max(np.linalg.eigvalsh(C[k, k])[-1], 0.0))) for k in (slice(3), slice(3, 6))
        )
        entry["sigma"] = {
            "position": float(chunk.S_world_chunk.scale) * position,
            "rotation_deg": float(np.rad2deg(rotation)),
            "scale": float(np.sqrt(max(C[6, 6], 0.0))),
        }
    return entry


def print_loop_report(report: dict[str, Any], units: str) -> None:
    """The report for people, at most 100 columns wide."""
    loops = [e for e in report["edges"] if e["kind"] == "loop"]
    accepted = sum(e["accepted"] for e in loops)
    say("")
    for line in _component_lines(report):
        say(line)
    for line in _adjacent_lines([e for e in report["edges"] if e["kind"] == "adjacent"], units):
        say(line)
    say(f"loops: {len(loops)} candidates, {accepted} accepted, {len(loops) - accepted} rejected")
    if loops:
        say("")
        for line in _loop_lines(loops, units):
            say(line)
    placed = [c for c in report["chunk_poses"] if c["sigma"] is not None]
    if placed:
        say("")
        for line in _sigma_lines(placed, units):
            say(line)


def _component_lines(report: dict[str, Any]) -> list[str]:
    parts = report["parts"]
    if not parts:
        return ["no chunk is stored yet"]
    if len(parts) == 1:
        return [f"one part: all {len(parts[0]['chunks'])} chunks share one frame of reference"]
    lines = [f"{len(parts)} parts that could not be joined; positions of different parts must not be compared:"]
    for part in parts:
        frames = ", ".join(f"{a}-{b}" if s == 1 else f"session {s}: {a}-{b}" for s, a, b in _runs(part["frames"]))
        text = f"part {part['component']}: {_list(part['chunks'], 'chunk')}, frames {frames}"
        lines += textwrap.wrap(text, _WIDTH, initial_indent="  ", subsequent_indent="    ")
    return lines


def _runs(frames: list[list[int]]) -> list[list[int]]:
    """Stretches of frames of chunks that follow on one another: [session, first, last]."""
    out: list[list[int]] = []
    for session, first, last in sorted(frames):
        if out and out[-1][0] == session and first <= out[-1][2] + 1:
            out[-1][2] = max(out[-1][2], last)
        else:
            out.append([session, first, last])
    return out


def _adjacent_lines(edges: list[dict[str, Any]], units: str) -> list[str]:
    if not edges:
        return ["adjacent chunks: none joined by shared frames"]
    used = [e for e in edges if e["accepted"]]
    text = f"adjacent chunks: {len(edges)} pairs, {len(used)} joined by shared frames"
    if used:
        residuals = [e["residual_m"] for e in used]
        weak = min(used, key=lambda e: (e["weight"], e["u"], e["v"]))
        text += (
            f"; residual {min(residuals):.3f} to {max(residuals):.3f} {units}, "
            f"weakest {weak['u']}-{weak['v']} with weight {weak['weight']:.2f}"
        )
    lines = textwrap.wrap(text, _WIDTH, subsequent_indent="  ")
    for e in edges:
        if not e["accepted"]:
            text = f"{e['u']}-{e['v']} not joined: {e['reason']}"
            lines += textwrap.wrap(text, _WIDTH, initial_indent="  ", subsequent_indent="    ")
    return lines


def _loop_lines(loops: list[dict[str, Any]], units: str) -> list[str]:
    names = [s for s in _SCORES if any(_score(e, s) is not None for e in loops)]
    header = ["chunks", "frames", "times (s)", *names, "inliers", f"resid {units}", "weight", "verdict"]
    rows = []
    for e in loops:
        a, b = e["frames"] or ("?", "?")
        u_s, v_s = e["times_s"] or (None, None)
        times = f"{_two(u_s)}-{_two(v_s)}"
        scores = [_two(_score(e, s)) for s in names]
        verdict = "accepted" if e["accepted"] else "rejected"
        residual = f"{e['residual_m']:.3f}" if e["inliers"] else "-"
        weight = f"{e['weight']:.3f}" if e["accepted"] else "-"
        rows.append([f"{e['u']}-{e['v']}", f"{a}-{b}", times, *scores, str(e["inliers"]), residual, weight, verdict])
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    right = range(3, len(header) - 1)
    lines = [_row(header, widths, right)]
    for e, row in zip(loops, rows, strict=True):
        lines.append(_row(row, widths, right))
        lines += textwrap.wrap(e["reason"], _WIDTH, initial_indent="    ", subsequent_indent="    ")
    return lines


def _sigma_lines(placed: list[dict[str, Any]], units: str) -> list[str]:
    header = ["chunk", f"position +- ({units})", "rotation +- (deg)", "scale +- (%)"]
    rows = [
        [
            str(c["chunk"]),
            f"{c['sigma']['position']:.4f}",
            f"{c['sigma']['rotation_deg']:.3f}",
            f"{100 * c['sigma']['scale']:.3f}",
        ]
        for c in placed
    ]
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    title = "uncertainty of chunk positions relative to the first chunk of their part (one sigma, worst axis)"
    return [title, *(_row(row, widths, range(1, 4)) for row in [header, *rows])]


def _row(cells: list[str], widths: list[int], right: range) -> str:
    padded = [c.rjust(w) if k in right else c.ljust(w) for k, (c, w) in enumerate(zip(cells, widths, strict=True))]
    return "  ".join(padded).rstrip()


def _score(edge: dict[str, Any], name: str) -> float | None:
    scores = edge["scores"]
    value = scores.get(name, scores.get(_ALSO_DET) if name == "s_det" else None)
    return None if value is None else float(value)


def _two(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _list(numbers: list[int], what: str) -> str:
    return f"{what} {numbers[0]}" if len(numbers) == 1 else f"{what}s {', '.join(map(str, numbers))}"
