"""Register two chunks by their instances alone, and decide whether to accept the relation.

`matching` finds the matches, `surface_fit` the exact relation. It is accepted by all its evidence: the number of
inlier instances and their misfit, the lead over any other position, the share of surfaces that meet, and that neither
chunk sees through the other's surfaces. The weights were chosen on simulated homes (research/association 0053).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.solver import adjoint
from list3r.association.revisits.constellations.constellation import (
    Constellation,
    ConstellationSettings,
)
from list3r.association.revisits.constellations.matching import (
    ConstellationMatch,
    MatchingSettings,
    match_constellations,
)
from list3r.association.revisits.constellations.surface_fit import (
    ChunkSurfaces,
    KnownRelation,
    SurfaceFit,
    SurfaceFitSettings,
    fit_surfaces,
)
from list3r.association.revisits.cross_check import CrossSettings, Side, cross_check
from list3r.memory.core.geometry import Sim3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RelationOdds:
    """Log odds that a relation is right, fitted to 277 of them in 27 simulated homes (research/association 0053)."""

    bias: float = -3.1
    match: float = 0.89
    """Of the log of the matched instances' log odds."""
    agreeing: float = 0.33
    """Of each inlier instance, up to 12."""
    after: float = -2.6
    """Of the instances' root mean square misfit, in deviations."""
    agreement: float = 9.7
    """Of the log of the share of surface that is not seen through."""
    fitting: float = 1.0
    """Of the log of the share of surface that meets the other's."""
    likeness: float = 9.3
    """Of the mean similarity rank of instances that overlap, 0.5 by chance."""


@dataclass(frozen=True)
class ConstellationRegistrationSettings:
    """How chunks are registered by their instances."""

    constellation: ConstellationSettings = field(default_factory=ConstellationSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    surfaces: SurfaceFitSettings = field(default_factory=SurfaceFitSettings)
    cross: CrossSettings = field(default_factory=CrossSettings)
    tried: int = 3
    """Most hypotheses tested on surfaces,"""
    least_pairs: int = 4
    """of those with this many instances,"""
    least_match: float = 5.0
    """whose log odds sum up to this."""
    believed_pairs: int = 4
    """Instances that must still agree after the surface fit for a relation to be accepted."""
    least_belief: float = 3.1
    """Least log odds that an accepted relation is right (`RelationOdds`)."""
    least_fitting: float = 0.1
    """Share of a chunk's surface that must meet the other's: with less a relation is loose."""
    most_rival: float = 0.9
    """Largest support of another relation of the same chunks, as a share of the accepted one's."""
    belief: RelationOdds = field(default_factory=RelationOdds)
    place: float = 0.04
    """Standard deviation of an instance's centre after the surface fit, share of the typical depth,"""
    most_off: float = 2.0
    """and the deviations within which an instance agrees."""
    enough_fitting: float = 0.3
    """Share of a chunk's surface that meets the other's above which more adds no evidence."""
    shift: float = 0.03
    """Standard deviation of an accepted relation, share of the chunk's typical depth,"""
    turn_deg: float = 1.5
    """of its rotation,"""
    log_scale: float = 0.03
    """and of the logarithm of its scale."""


@dataclass(frozen=True)
class RegisteredChunk:
    """Inputs of the registration for one chunk."""

    constellation: Constellation
    surfaces: ChunkSurfaces
    side: Side


@dataclass(frozen=True)
class Registration:
    """A candidate relation of two chunks and its evidence."""

    S_v_u: Sim3
    match: ConstellationMatch
    fit: SurfaceFit
    scores: dict[str, float]


def register(
    u: RegisteredChunk, v: RegisteredChunk, metric: bool, settings: ConstellationRegistrationSettings
) -> Registration | None:
    """Return the likeliest relation of two chunks, None where no three instances agree."""
    cu, cv = u.constellation, v.constellation
    matches = match_constellations(cu, cv, metric, settings.matching)
    found: list[Registration] = []
    likely = [m for m in matches if len(m.pairs) >= settings.least_pairs and m.score >= settings.least_match]
    for match in likely[: settings.tried]:
        S = _lowered(match.S_v_u, cu, cv)
        held = KnownRelation(
            middle_u=cu.center[match.pairs[:, 0]] @ cu.R_up_chunk,
            middle_v=cv.center[match.pairs[:, 1]] @ cv.R_up_chunk,
            up_u=cu.R_up_chunk[2],
            up_v=cv.R_up_chunk[2],
            scale=float(match.S_v_u.scale),
        )
        fit = fit_surfaces(S, u.surfaces, v.surfaces, held, metric, settings.surfaces)
        if fit is not None:
            found.append(_described(u, v, match, fit, settings))
    if not found:
        return None
    found.sort(key=lambda r: -r.scores["support"])
    best = found[0]
    rivals = [r.scores["support"] for r in found[1:] if not _near(r.S_v_u, best.S_v_u, cu, cv)]
    scores = best.scores | {"rival": max(rivals, default=0.0) / max(best.scores["support"], 1e-9)}
    return Registration(best.S_v_u, best.match, best.fit, scores)


def log_odds(scores: Mapping[str, float], weights: RelationOdds) -> float:
    """Return the log odds that a relation of these scores is right."""
    w = weights
    return (
        w.bias
        + w.match * float(np.log(max(scores["match"], 1.0)))
        + w.agreeing * min(scores["agreeing"], 12.0)
        + w.after * scores["after"]
        + w.agreement * float(np.log(max(scores["agreement"], 0.3)))
        + w.fitting * float(np.log(max(scores["fitting"], 0.03)))
        + w.likeness * scores["likeness"]
    )


def refusal(scores: Mapping[str, float], settings: ConstellationRegistrationSettings) -> str | None:
    """Return why a relation of these scores is rejected, or None."""
    if scores["agreeing"] < settings.believed_pairs:
        return f"after the surface fit only {scores['agreeing']:.0f} of them do"
    if (odds := log_odds(scores, settings.belief)) < settings.least_belief:
        return f"too little evidence for it (log odds {odds:.1f}, wanted {settings.least_belief:.1f})"
    if scores["fitting"] < settings.least_fitting:
        return f"too little of the surfaces meets ({scores['fitting']:.0%})"
    if scores["rival"] > settings.most_rival:
        return f"another relation of the two chunks fits as well ({scores['rival']:.0%})"
    return None


def _near(a: Sim3, b: Sim3, u: Constellation, v: Constellation) -> bool:
    """Return whether two relations place the instances of u at about the same position in v."""
    centers = u.center @ u.R_up_chunk
    return bool(np.linalg.norm(a.apply(centers) - b.apply(centers), axis=1).mean() < 0.15 * v.unit)


def _lowered(S: Sim3, u: Constellation, v: Constellation) -> Sim3:
    """Return a similarity of upright frames as one of chunks."""
    tilt_u = Sim3(np.ones(()), u.R_up_chunk, np.zeros(3))
    tilt_v = Sim3(np.ones(()), v.R_up_chunk, np.zeros(3))
    return tilt_v.inverse() @ S @ tilt_u


def _described(
    u: RegisteredChunk,
    v: RegisteredChunk,
    match: ConstellationMatch,
    fit: SurfaceFit,
    settings: ConstellationRegistrationSettings,
) -> Registration:
    check = cross_check(fit.S_v_u, u.side, v.side, None, settings.cross)
    cu, cv = u.constellation, v.constellation
    a = fit.S_v_u.apply(cu.center[match.pairs[:, 0]] @ cu.R_up_chunk)
    b = cv.center[match.pairs[:, 1]] @ cv.R_up_chunk
    size = np.linalg.norm(cv.size[match.pairs[:, 1]], axis=1)
    off = np.linalg.norm(a - b, axis=1) / np.hypot(settings.place * cv.unit, settings.matching.place_of_size * size)
    tilt = float(np.degrees(np.arccos(np.clip((cv.R_up_chunk[2] @ fit.S_v_u.rotation @ cu.R_up_chunk[2]), -1, 1))))
    moved = (fit.S_v_u.inverse() @ _lowered(match.S_v_u, cu, cv)).apply(cu.center.mean(axis=0)[None] @ cu.R_up_chunk)
    away = float(np.linalg.norm(moved - cu.center.mean(axis=0) @ cu.R_up_chunk) / cu.unit)
    scores = {
        "pairs": float(len(match.pairs)),
        "agreeing": float((off < settings.most_off).sum()),
        "match": match.score,
        "misfit": match.misfit,
        "after": float(np.sqrt((np.minimum(off, 3.0) ** 2).mean())),
        "fitting": fit.fitting,
        "residual": fit.residual,
        "directions": fit.spread,
        "overlap": check.overlap,
        "agreement": check.agreement,
        "likeness": check.likeness if np.isfinite(check.likeness) else 0.5,
        "tilt": tilt,
        "away": away,
        "support": match.score * check.agreement**4 * min(1.0, fit.fitting / settings.enough_fitting),
    }
    return Registration(fit.S_v_u, match, fit, scores)


def covariance(u: RegisteredChunk, metric: bool, settings: ConstellationRegistrationSettings) -> Array:
    """Return the covariance of an accepted relation, whose errors are about the centre of u's instances.

    Of x in S_true = S_v_u exp(x), u's units. Shape (7, 7).
    """
    c, s = u.constellation, settings
    middle = c.center.mean(axis=0) @ c.R_up_chunk
    log_scale = 1e-6 if metric else s.log_scale
    deviation = np.array([s.shift * c.unit] * 3 + [np.radians(s.turn_deg)] * 3 + [log_scale])
    moved = adjoint(Sim3(np.ones(()), np.eye(3), middle))
    return np.asarray(moved @ np.diag(deviation**2) @ moved.T)
