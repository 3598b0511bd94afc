"""How surely sessions are placed on each other: what the relations between them leave open."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.core.geometry import Array, Sim3, stack
from list3r.memory.core.records import ChunkRow, Edge
from list3r.memory.library.uncertainty import point_covariances


def keyframes_of(edge: Edge, session_of: Mapping[int, int]) -> set[tuple[int, int]]:
    """Return session and Frame.index of the keyframes that a relation rests on."""
    if edge.frames is None:
        return set()
    return {(session_of[chunk], frame) for chunk, frame in zip((edge.u, edge.v), edge.frames, strict=True)}


def counted_once(edges: Sequence[Edge], session_of: Mapping[int, int]) -> list[Edge]:
    """Return edges of which those between sessions that share a keyframe tell together as much as one of them.

    The depth of a keyframe errs for all its relations alike. `session_of` gives the session of every chunk.
    """
    out = list(edges)
    if len(set(session_of.values())) < 2:
        return out
    ties = [
        k for k, e in enumerate(edges) if session_of[e.u] != session_of[e.v] and (e.accepted or "trust" in e.scores)
    ]
    uses = Counter(key for k in ties for key in keyframes_of(edges[k], session_of))
    for k in ties:
        often = max((uses[key] for key in keyframes_of(edges[k], session_of)), default=1)
        covariance = edges[k].covariance
        if often > 1 and covariance is not None:
            out[k] = replace(edges[k], covariance=covariance * often)
    return out


class SessionTies:
    """The relations between sessions that the graph believes."""

    def __init__(self, edges: Iterable[Edge], rows: Mapping[int, ChunkRow]) -> None:
        session_of = {k: c.session_id for k, c in rows.items()}
        believed = [e for e in edges if e.accepted and e.u in rows and e.v in rows]
        self._of: dict[int, list[tuple[Sim3, Array]]] = {}
        """By the later session: the pose of chunk u of each relation, and the covariance that it states."""
        for e in counted_once(believed, session_of):
            later = max(session_of[e.u], session_of[e.v])
            if session_of[e.u] != session_of[e.v] and e.covariance is not None:
                factor = max(e.scores.get("variance_factor", 1.0), 1.0)
                self._of.setdefault(later, []).append((rows[e.u].S_world_chunk, e.covariance * factor))

    def covariance(self, session: int, at: Array) -> Array:
        """Return the covariance of a place (3,) of a session in the world of the sessions before it, world units.

        The places that single relations give are averaged, which says no more than all of them together. Zero where no
        relation states how surely it is known, as where poses were given. Shape (3, 3).
        """
        information = [np.linalg.inv(_of_place(S, C, at)) for S, C in self._of.get(session, ())]
        return np.asarray(np.linalg.inv(np.sum(information, axis=0))) if information else np.zeros((3, 3))

    def shifts(self, session: int, at: Array, deviations: float, known: float) -> list[Array]:
        """Return by how much a session may be off at a place: this many deviations each way along the axes of its
        covariance, less what is `known` to be left open anyway, world units. Shape (3,) each."""
        squares, axes = np.linalg.eigh(self.covariance(session, at))
        reach = deviations * np.sqrt(np.maximum(squares, 0.0)) - known
        return [sign * r * axis for r, axis in zip(reach, axes.T, strict=True) if r > 0.0 for sign in (1.0, -1.0)]


def _of_place(S_world_u: Sim3, covariance: Array, at: Array) -> Array:
    """Return the covariance of a place (3,), world units, by that of x in S_true = S_v_u exp(x). Shape (3, 3)."""
    spread = point_covariances(stack([S_world_u]), covariance, at[None])[0]
    return np.asarray(spread + 1e-12 * max(float(np.trace(spread)), 1e-12) * np.eye(3))
