"""What kept a build from more, in one line, and how to film so that there is more."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.records import ChunkRow
from list3r.memory.library.overlap.summaries import sample_of
from list3r.memory.library.world.scale import lengths_of
from list3r.memory.store.store import Store

_PICTURES, _OF_EACH = 40, 5
"""Keyframes that are looked at, at most, and of one chunk."""
_DARK, _BLURRED = 45.0, 2.6
"""Mean grey level under which a picture is dark; how much stronger its edges are at 320 px than when blurred by 1.5 px,
under which it is blurred. RedKitchen has 3 to 9, blurred by one or two px 1.8 to 2.5."""
_FEW = 60
"""Frames of a video in which little can be seen."""
_WORTH = 0.3
"""A reason that cost less than this share of the video is not said."""


@dataclass(frozen=True)
class Reason:
    """One thing that kept a build from more."""

    share: float
    """Of the video that it cost, about."""
    text: str
    """What it was, and what to do."""


def film_advice(store: Store, session: int) -> str | None:
    """Return what kept a session from more and what to do, the one or two worst reasons; None where nothing did."""
    found = [r for r in _reasons(store, session) if r.share >= _WORTH]
    worst = sorted(found, key=lambda r: -r.share)[:2]
    return None if not worst else "for more, film again (docs/filming.md): " + "; ".join(r.text for r in worst)


def _reasons(store: Store, session: int) -> list[Reason]:
    frames, chunks = store.frames.all(session), store.chunks.all(session)
    lost = sum(f.state == "lost" for f in frames) / max(1, len(frames))
    out = [Reason(lost, f"the camera was lost in {lost:.0%} of the frames: move slowly, without a jump")]
    if len(frames) < _FEW:
        out.append(Reason(0.5, f"{len(frames)} frames are few: film for ten seconds or more"))
    pictures = [k.jpeg for c in sample_of(chunks) for k in store.keyframes.of(c.chunk_id)[:_OF_EACH] if k.jpeg]
    out += _of_pictures(pictures[:: max(1, len(pictures) // _PICTURES)])
    if chunks and all(c.scale_kind != "metric" for c in chunks):
        out += _of_depth(store, chunks)
    if store.facts.gravity == "unknown":
        text = "which way is up is unknown: hold the camera upright, turn to more sides, show floor and tables"
        out.append(Reason(0.4, text))
    return out


def _of_pictures(pictures: list[bytes]) -> list[Reason]:
    """Return what dark and blurred pictures cost."""
    if not pictures:
        return []
    gray = [np.asarray(cv2.imdecode(np.frombuffer(p, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8) for p in pictures]
    dark = float(np.mean([g.mean() < _DARK for g in gray]))
    blurred = float(np.mean([_sharpness(g) < _BLURRED for g in gray]))
    return [
        Reason(dark, f"{dark:.0%} of the pictures are dark: switch on the light"),
        Reason(blurred, f"{blurred:.0%} of the pictures are blurred: move more slowly, in more light"),
    ]


def _sharpness(gray: NDArray[np.uint8]) -> float:
    """Return what blurring takes of a picture's edges, as in the metric of Crete et al., "The blur effect", 2007."""
    size = (320, max(1, round(320 * gray.shape[0] / gray.shape[1])))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    edges, left = (np.abs(cv2.Laplacian(p, cv2.CV_32F)).mean() for p in (small, cv2.GaussianBlur(small, (0, 0), 1.5)))
    return float(edges / max(float(left), 1e-6))


def _of_depth(store: Store, chunks: list[ChunkRow]) -> list[Reason]:
    """Return what of the picture got no depth, and how far the camera moved beside the distance of things."""
    empty, far, moved = [], [], []
    for c in sample_of(chunks):
        deep = [k for k in store.keyframes.of(c.chunk_id) if k.depth_small.any()][:_OF_EACH]
        scale = float(c.S_world_chunk.scale)
        for k in deep:
            known = k.depth_small > 0
            empty.append(1.0 - float(known.mean()))
            far.append(scale * float(np.quantile(k.depth_small[known], 0.95)))
        posed = np.array([f.T_chunk_cam[:3, 3] for f in store.frames.of(c) if f.state == "posed"]).reshape(-1, 3)
        moved += [scale * float(np.linalg.norm(np.ptp(posed, axis=0)))] if len(posed) else []
    if not empty or not moved:
        return []
    share, lengths = float(np.mean(empty)), str(lengths_of(store))
    unit = {"about m": "m", "m": "m"}.get(lengths, "units")
    about = "about " if lengths == "about m" else ""
    text = (
        f"{share:.0%} of the picture has no depth, what is blank, moves or is farther than {about}{np.median(far):.1f} "
        f"{unit} (the camera moved {about}{np.median(moved):.2g} {unit}): move sideways, by a tenth of the distance"
    )
    return [Reason(share, text)]
