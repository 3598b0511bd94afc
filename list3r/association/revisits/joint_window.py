"""Joint windows: frames of two places reconstructed together once more (paper 3.2; a loop pair shares no frame).

Each side of the window shares its frames with one chunk, so that u -> window -> v gives their relation. It is accepted
only when both sides fit, the scale is that of the instances' layout, and the rest of the two chunks does not contradict
it (`cross_check`): a model invents a relation between two similar places, and both sides fit that as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.solver import adjoint
from list3r.association.overlap.alignment import align
from list3r.association.overlap.overlap_edge import EdgeEnd, EdgeSettings, measure_edge
from list3r.association.overlap.shared_points import shared_samples
from list3r.association.revisits.cross_check import CrossSettings, Side, cross_check, shared_view
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples, JointWindow

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class JointReconstructor(Protocol):
    """Reconstructs frames of two places together, by the same model that made the chunks."""

    def __call__(
        self, u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]
    ) -> JointWindow | None:
        """The window of frames (Frame.index) of two sessions; None when its two sides cannot be related."""
        ...


@dataclass(frozen=True)
class WindowSettings:
    """How a joint window is made and judged."""

    frames: int = 20
    """Frames of each side (VGGT-Long: 20)."""
    step: int = 1
    """Every this many posed frames."""
    least_confidence: float = 0.2
    """Least confidence m of either side's alignment."""
    rough_pairs: int = 600
    """Pairs of points of the first estimate of either side."""
    least_shared: float = 0.15
    """Least share of surface that two of the window's frames must share: without any the relation is invented."""
    edges: EdgeSettings = field(default_factory=EdgeSettings)
    cross: CrossSettings = field(default_factory=CrossSettings)


@dataclass(frozen=True)
class Place:
    """One end of a candidate revisit."""

    chunk_id: int
    session_id: int
    frame: int
    """Frame.index of the frame that is similar to one of the other end."""
    metric: bool
    side: Side

    @property
    def end(self) -> tuple[int, int]:
        """Chunk id and Frame.index."""
        return self.chunk_id, self.frame


Objection = Callable[[Sim3], str | None]
"""Why a relation S_v_u is false, or None."""


def joint_edge(
    joint: JointReconstructor,
    u: Place,
    v: Place,
    objection: Objection | None = None,
    settings: WindowSettings | None = None,
) -> Edge:
    """Return the loop edge from u to v through a joint window, accepted or rejected with the reason.

    Without `objection` every edge that can be measured is accepted (the paper's baseline, VGGT-Long). With it a first
    estimate is tested, and only accepted ones are measured with care.
    """
    chosen = settings or WindowSettings()
    frames_u, frames_v = window_frames(u, chosen), window_frames(v, chosen)
    window = joint(u.session_id, frames_u.tolist(), v.session_id, frames_v.tolist())
    if window is None:
        return no_edge(u.end, v.end, "the frames of the two places cannot be reconstructed together")
    verdict = _Verdict(u, v, (frames_u, frames_v), objection, chosen)
    try:
        if objection is not None:
            rough = _rough(window.v, v.side.samples, chosen) @ _rough(u.side.samples, window.u, chosen)
            if against := verdict.of(rough):
                return replace(no_edge(u.end, v.end, against), S_v_u=rough, scores=verdict.scores)
        to_window = _half(u.side.samples, window.u, u, window, chosen.edges)
        to_v = _half(window.v, v.side.samples, v, window, chosen.edges)
    except DegenerateError as error:
        return no_edge(u.end, v.end, f"the joint window does not fit its chunks: {error}")
    edge = _composed(u, v, to_window, to_v)
    if objection is None:
        return edge
    against = _misfit(to_window, to_v, chosen) or verdict.of(edge.S_v_u)
    return replace(
        edge,
        accepted=against is None,
        weight=0.0 if against else edge.confidence,
        reason=f"{edge.reason}; {against or verdict.seen}",
        scores=edge.scores | verdict.scores,
    )


class _Verdict:
    """The test of a relation; `scores` and `seen` are those of the last one."""

    def __init__(
        self, u: Place, v: Place, made_from: tuple[Ints, Ints], objection: Objection | None, settings: WindowSettings
    ) -> None:
        self._u, self._v, self._made_from, self._objection = u, v, made_from, objection
        self._settings = settings.cross
        self._least_shared = settings.least_shared
        self.scores: dict[str, float] = {}
        self.seen = ""

    def of(self, S_v_u: Sim3) -> str | None:
        """Return why it is false, or None."""
        if self._objection is not None and (against := self._objection(S_v_u)):
            return against
        shared = shared_view(S_v_u, self._u.side, self._v.side, self._made_from, self._settings)
        self.scores = {"shared_view": shared}
        if shared < self._least_shared:
            return f"under it no two frames of the places share surface ({shared:.0%} at most)"
        check = cross_check(S_v_u, self._u.side, self._v.side, self._made_from, self._settings)
        self.scores |= {"overlap": check.overlap, "agreement": check.agreement, "kinds": float(check.kinds)}
        if np.isfinite(check.likeness):
            self.scores["likeness"] = check.likeness
        self.seen = f"{check.overlap:.0%} of the surface is seen by both chunks, {check.agreement:.0%} of it agrees"
        return check.contradiction(self._settings)


def window_frames(place: Place, settings: WindowSettings) -> Ints:
    """Return the posed frames of a place's chunk around its frame, ascending (Frame.index)."""
    posed = place.side.samples.camera_frames
    middle = int(np.argmin(np.abs(posed - place.frame))) if len(posed) else 0
    span = settings.frames * settings.step
    first = max(0, min(middle - span // 2, len(posed) - span))
    return posed[first : first + span : settings.step]


def no_edge(u: tuple[int, int], v: tuple[int, int], reason: str) -> Edge:
    """Return an edge that is kept only for the record; `u` and `v` are chunk id and Frame.index."""
    return Edge(
        u=u[0],
        v=v[0],
        kind="loop",
        S_v_u=Sim3.identity(),
        confidence=0.0,
        weight=0.0,
        inliers=0,
        residual_m=0.0,
        accepted=False,
        reason=reason,
        frames=(u[1], v[1]),
    )


def _rough(a: FrameSamples, b: FrameSamples, settings: WindowSettings) -> Sim3:
    """Return a first estimate of the similarity from a to b, by some of the samples that they share."""
    at_a, at_b = shared_samples(a, b)
    pick = np.linspace(0, len(at_a) - 1, min(len(at_a), settings.rough_pairs)).astype(np.int64)
    at_a, at_b = at_a[pick], at_b[pick]
    weight = np.sqrt(a.confidence[at_a] * b.confidence[at_b])
    return align(a.points[at_a], b.points[at_b], weight, a.frame[at_a], False, settings.edges.alignment).S_v_u


def _half(a: FrameSamples, b: FrameSamples, place: Place, window: JointWindow, settings: EdgeSettings) -> Edge:
    """Return the edge between a chunk and its side of the window."""
    metric = place.metric and window.scale_kind == "metric"
    ends = EdgeEnd(place.chunk_id, a), EdgeEnd(place.chunk_id, b)
    return measure_edge(*ends, place.side.camera, metric, settings, kind="loop").edge


def _composed(u: Place, v: Place, to_window: Edge, to_v: Edge) -> Edge:
    """Compose u -> window -> v. The weaker half decides the confidence."""
    halves = (to_window, to_v)
    confidence = min(e.confidence for e in halves)
    scale = float(to_v.S_v_u.scale)
    return Edge(
        u=u.chunk_id,
        v=v.chunk_id,
        kind="loop",
        S_v_u=to_v.S_v_u @ to_window.S_v_u,
        confidence=confidence,
        weight=confidence,
        inliers=min(e.inliers for e in halves),
        residual_m=float(np.hypot(scale * to_window.residual_m, to_v.residual_m)),
        accepted=True,
        reason=f"{to_window.inliers} and {to_v.inliers} points agree with the joint window",
        scores={
            "spread": min(scale * to_window.scores["spread"], to_v.scores["spread"]),
            "confidence_u": to_window.confidence,
            "confidence_v": to_v.confidence,
        },
        frames=(u.frame, v.frame),
        covariance=composed_covariance(to_window, to_v),
    )


def composed_covariance(first: Edge, second: Edge) -> Array | None:
    """Return covariance of S_second S_first: second exp(x) first exp(y) = second first exp(Ad(first^-1) x) exp(y)."""
    if first.covariance is None or second.covariance is None:
        return None
    moved = adjoint(first.S_v_u.inverse())
    return np.asarray(moved @ second.covariance @ moved.T + first.covariance)


def _misfit(to_window: Edge, to_v: Edge, settings: WindowSettings) -> str | None:
    for half in (to_window, to_v):
        if not half.accepted or half.confidence < settings.least_confidence:
            return f"the joint window does not fit chunk {half.u}: {half.reason}"
    return None
