"""Which further pairs of keyframes of two chunks are compared, where a single relation joins two sessions.

A short session has few chunks, and frames of a changed room in another light propose few pairs. One relation alone does
not place a session; but it predicts which other keyframes overlap (research/sessions 0056).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples
from list3r.memory.library.world.session_ties import keyframes_of


@dataclass(frozen=True)
class FramesApart:
    """When two pairs of frames are independent."""

    each: int = 4
    """Least frames between them on either side, and"""
    both: int = 20
    """on both sides together."""

    def of(self, one: tuple[int, int], other: tuple[int, int]) -> bool:
        """Return whether two pairs of Frame.index are independent."""
        gaps = [abs(a - b) for a, b in zip(one, other, strict=True)]
        return min(gaps) >= self.each and sum(gaps) >= self.both


def are_independent(e: Edge, f: Edge, session_of: Mapping[int, int], apart: FramesApart) -> bool:
    """Return whether two relations of two sessions support each other.

    Two of one pair of chunks do where their frames are apart, or where one is by frames and the other by instances.
    Two of different pairs do unless they share a keyframe, and so its error (research/sessions 0058).
    `session_of` gives the session of every chunk.
    """
    one_pair = (e.u, e.v) == (f.u, f.v)
    if e.frames is None or f.frames is None:
        return not one_pair
    if one_pair:
        return e.by_things != f.by_things or apart.of(e.frames, f.frames)
    return not keyframes_of(e, session_of) & keyframes_of(f, session_of)


@dataclass(frozen=True)
class FurtherPairSettings:
    """Which further pairs of keyframes are compared."""

    most: int = 64
    """Pairs of keyframes."""
    apart: FramesApart = field(default_factory=FramesApart)
    """Their frames are apart from those of the relation,"""
    turn_deg: float = 50.0
    """their optical axes enclose at most this,"""
    depths: float = 1.0
    """and a distance of one median depth of the chunk counts as much as this whole angle."""


def similar_views(
    edge: Edge,
    samples: tuple[FrameSamples, FrameSamples],
    keyframes: tuple[Sequence[int], Sequence[int]],
    settings: FurtherPairSettings,
) -> list[tuple[int, int]]:
    """Return pairs of keyframes (Frame.index) with similar views under an edge, the most similar first.

    `samples` and `keyframes` are those of chunks u and v.
    """
    assert edge.frames is not None
    u, v = _views(samples[0], keyframes[0], edge.S_v_u), _views(samples[1], keyframes[1], Sim3.identity())
    reach = settings.depths * _reach(samples[1])
    found = []
    for frame_u, (at_u, axis_u) in u.items():
        for frame_v, (at_v, axis_v) in v.items():
            turn = float(np.degrees(np.arccos(np.clip(axis_u @ axis_v, -1.0, 1.0)))) / settings.turn_deg
            if turn <= 1.0 and settings.apart.of(edge.frames, (frame_u, frame_v)):
                found.append((turn + float(np.linalg.norm(at_u - at_v)) / reach, frame_u, frame_v))
    return [(frame_u, frame_v) for _, frame_u, frame_v in sorted(found)][: settings.most]


def _views(
    samples: FrameSamples, keyframes: Sequence[int], S: Sim3
) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return positions and optical axes of the keyframes of a chunk, moved by a similarity."""
    poses = dict(zip(samples.camera_frames.tolist(), samples.T_chunk_cam, strict=True))
    return {k: (S.apply(poses[k][:3, 3]), S.rotation @ poses[k][:3, 2]) for k in keyframes if k in poses}


def _reach(samples: FrameSamples) -> float:
    """Return the median distance of a chunk's points from its cameras' centre, chunk units."""
    if not len(samples.points) or not len(samples.T_chunk_cam):
        return 1.0
    middle = samples.T_chunk_cam[:, :3, 3].mean(axis=0)
    return max(float(np.median(np.linalg.norm(samples.points - middle, axis=1))), 1e-6)
