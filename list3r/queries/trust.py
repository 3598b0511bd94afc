"""How far a path can be trusted: where it breaks, where little supports it, and how sure its chunks' places are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from list3r.memory.core.records import UNSURE, ChunkRow, FrameRow


def path_trust(frames: Sequence[FrameRow], chunks: Sequence[ChunkRow]) -> dict[str, Any]:
    """Return it as plain values. `lost` and `unsure` are stretches [session, first frame, last frame].

    `unsure` has a pose that little supports. From the frames `breaks`, [session, frame], on the path is in another
    part. Each of the `parts` has its frames and the largest standard deviation of a chunk's place from the first's,
    units, along the worst axis; None where it is not known.
    """
    part = {c.chunk_id: c.component for c in chunks}
    posed = [f for f in frames if f.state == "posed"]
    others = [b for a, b in pairwise(posed) if a.session_id == b.session_id and part[a.chunk_id] != part[b.chunk_id]]
    return {
        "lost": _stretches(f for f in frames if f.state == "lost"),
        "unsure": _stretches(f for f in posed if f.note == UNSURE),
        "breaks": [[f.session_id, f.frame_index] for f in others],
        "parts": [
            {
                "part": k,
                "frames": sum(part[f.chunk_id] == k for f in posed),
                "deviation": _deviation([c for c in chunks if c.component == k]),
            }
            for k in sorted(set(part.values()))
        ],
    }


def path_in_words(path: dict[str, Any], units: str) -> str:
    """Return the same as a line for people."""
    told, parts = [], path["parts"]
    far = [p["deviation"] for p in parts if p["deviation"] is not None]
    if far:
        told.append(f"places known to {max(far):g} {units}")
    if len(parts) > 1:
        told.append(f"{len(parts)} parts of {', '.join(str(p['frames']) for p in parts)} frames")
    for name, said in (("lost", "lost"), ("unsure", "little support")):
        count = sum(last - first + 1 for _, first, last in path[name])
        where = ", ".join(f"{a}" if a == b else f"{a} to {b}" for _, a, b in path[name][:5])
        told += [f"{said} in {count} frames ({where}{', ...' * (len(path[name]) > 5)})"] if count else []
    return "; ".join(told) or "no frame is lost or of little support"


def _stretches(frames: Iterable[FrameRow]) -> list[list[int]]:
    runs = groupby(enumerate(frames), lambda row: (row[1].session_id, row[1].frame_index - row[0]))
    ends = [(found[0][1], found[-1][1]) for found in (list(run) for _, run in runs)]
    return [[first.session_id, first.frame_index, last.frame_index] for first, last in ends]


def _deviation(chunks: Sequence[ChunkRow]) -> float | None:
    placed = [(c.S_world_chunk.scale, c.covariance[:3, :3]) for c in chunks if c.covariance is not None]
    worst = [float(scale * np.sqrt(max(np.linalg.eigvalsh(C)[-1], 0.0))) for scale, C in placed]
    return float(f"{max(worst):.2g}") if any(worst) else None
