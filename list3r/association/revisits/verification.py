"""Verify that two keyframes see the same place, and measure their relation.

Local features give a first pose; the small depth images refine it, with the features constraining directions in which
surfaces alone would slide; then each side is checked against the other: overlap is sufficient, depth agrees, and
neither sees through a surface of the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.keyframe_covariance import KeyframeErrorSettings, registration_covariance
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, Keyframe
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.features.local import FeaturePose, match, relative_pose
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.reconstruction.rgbd.frame_registration import FrameRegistration, KnownFeatures, Samples, register
from list3r.reconstruction.rgbd.settings import RegistrationSettings
from list3r.reconstruction.rgbd.view import WorkingFrame, surface

Pose = NDArray[np.float64]


@dataclass(frozen=True)
class VerificationSettings:
    """When a revisit is accepted."""

    features: FeatureSettings = field(default_factory=FeatureSettings)
    least_feature_share: float = 0.15
    """Least share of the matched features that agree on the pose."""
    registration: RegistrationSettings = field(
        default_factory=lambda: RegistrationSettings(
            photometric_weight=0.0, gate_m=0.08, gate_halvings=1, iterations=20
        )
    )
    """Features begin within some centimetres: a wider gate takes the wall for the picture that was in front of it
    (research/sessions 0058)."""
    scaled_registration: RegistrationSettings = field(
        default_factory=lambda: RegistrationSettings(photometric_weight=0.0, gate_m=0.15, iterations=20)
    )
    """Of chunks without metric scale, whose depth is coarser."""
    least_overlap: float = 0.25
    """Least share of a side's surface that the other side sees."""
    least_agreement: float = 0.8
    """Least share of it that agrees rather than being seen through."""
    least_changed_agreement: float = 0.6
    """The same of two sessions where the other side agrees: something large was removed or added."""
    one_sided: float = 0.95
    """Agreement of that other side."""
    most_residual: float = 3.0
    """Largest robust deviation of depth, in units of the sensor's noise."""
    residual_scale_m: float = 0.03
    """Residual at which a point counts 1/e in the edge's confidence (sigma_r), metres."""
    least_depth_m: float = 0.1
    """Least depth of a point in front of a camera."""
    seen_through_m: float = 0.03
    """A point is seen through where depth is farther behind it than this and"""
    seen_through_sigmas: float = 3.0
    """this many deviations of the sensor's noise."""
    scale_gate: float = 1.5
    """Gate of matched features while the common scale of two chunks is searched, in gates of the features."""
    noise: SensorNoise = field(default_factory=SensorNoise)
    errors: KeyframeErrorSettings = field(default_factory=KeyframeErrorSettings)


@dataclass(frozen=True)
class _Side:
    """A keyframe as a view."""

    view: WorkingFrame
    samples: Samples


@dataclass(frozen=True)
class _Check:
    """Comparison of the surface of one side with the other's depth image."""

    overlap: float
    agreement: float
    """Of the points that are not hidden: agreeing against agreeing or seen through."""
    closeness: float
    """Mean of exp(-r / sigma_r) over points that are not hidden."""
    residual_m: float
    agreeing: int


def verify(
    keyframe_u: Keyframe,
    keyframe_v: Keyframe,
    u_id: int,
    v_id: int,
    settings: VerificationSettings | None = None,
    later: bool = False,
) -> Edge:
    """Return the loop edge between two chunks by one keyframe of each, accepted or rejected with the reason.

    `later`: they are of two sessions, between which objects may have been added or removed.
    """
    chosen = settings or VerificationSettings()
    build = _EdgeBuilder(keyframe_u, keyframe_v, u_id, v_id)
    matched = match(keyframe_u.keypoint_descriptors, keyframe_v.keypoint_descriptors, chosen.features.ratio)
    a, b = keyframe_u.points_cam[matched[:, 0]], keyframe_v.points_cam[matched[:, 1]]
    pose = relative_pose(a, b, chosen.features, chosen.noise)
    build.scores |= {"matches": float(len(matched)), "feature_inliers": float(pose.inliers if pose else 0)}
    if pose is None or pose.inliers < chosen.least_feature_share * pose.matches:
        agreeing = 0 if pose is None else pose.inliers
        return build.rejected(f"only {agreeing} of {len(matched)} matched features agree on a pose")
    side_u, side_v = _side(keyframe_u), _side(keyframe_v)
    found = _refine(side_u, side_v, pose, a, b, chosen)
    if found is None:
        return build.rejected("the depth images do not meet at the pose that the features give")
    T_v_u: Pose = np.asarray(np.linalg.inv(found.T_model_cam), np.float64)
    checks = (
        _check(side_u, side_v, T_v_u, chosen),
        _check(side_v, side_u, found.T_model_cam, chosen),
    )
    return build.judged(T_v_u, found, checks, pose, chosen, later)


def rejected(keyframe_u: Keyframe, keyframe_v: Keyframe, u_id: int, v_id: int, reason: str) -> Edge:
    """Return a loop edge between two chunks that is kept only for the record."""
    return _EdgeBuilder(keyframe_u, keyframe_v, u_id, v_id).rejected(reason)


def working_view(keyframe: Keyframe) -> WorkingFrame:
    """Return the small depth image of a keyframe as a view: points and normals in camera coordinates."""
    height, width = keyframe.depth_small.shape
    camera = Camera(width, height, *keyframe.camera_small)
    depth = np.ascontiguousarray(keyframe.depth_small, np.float32)
    return WorkingFrame(camera, depth, *surface(depth, camera), np.zeros_like(depth))


def _side(keyframe: Keyframe) -> _Side:
    view = working_view(keyframe)
    return _Side(view, Samples(view.points[view.valid][::2], view.normals[view.valid][::2]))


def _refine(
    side_u: _Side,
    side_v: _Side,
    pose: FeaturePose,
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    settings: VerificationSettings,
) -> FrameRegistration | None:
    """Return T_u_v from depth and the inlier features, in the camera coordinates of u."""
    T = pose.T_a_b
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    a, b = a[known], b[known]
    off = np.linalg.norm(b @ T[:3, :3].T + T[:3, 3] - a, axis=1)
    gate = np.maximum(
        settings.features.gate_least_m,
        settings.features.gate_sigmas * settings.noise.sigma(np.maximum(a[:, 2], b[:, 2])),
    )
    agree = off < gate
    anchors = KnownFeatures(a[agree], b[agree, :2] / b[agree, 2:])
    return register(side_u.samples, side_v.view, T, settings.registration, settings.noise, anchors)


def _check(source: _Side, target: _Side, T_target_source: Pose, settings: VerificationSettings) -> _Check:
    """Project the source's surface into the target's depth image."""
    view = target.view
    camera = view.camera
    p = source.samples.points @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    z = np.maximum(p[:, 2], 1e-3)
    column = np.rint(p[:, 0] / z * camera.fx + camera.cx)
    row = np.rint(p[:, 1] / z * camera.fy + camera.cy)
    inside = (
        (p[:, 2] > settings.least_depth_m)
        & (column >= 0)
        & (row >= 0)
        & (column < camera.width)
        & (row < camera.height)
    )
    pixel = (row[inside] * camera.width + column[inside]).astype(np.int64)
    known = view.valid.ravel()[pixel]
    points, pixel = p[inside][known], pixel[known]
    seen = view.points.reshape(-1, 3)[pixel]
    normal = view.normals.reshape(-1, 3)[pixel]
    distance = np.einsum("ij,ij->i", points - seen, normal)
    limit = settings.seen_through_m + settings.seen_through_sigmas * settings.noise.sigma(seen[:, 2])
    hidden = points[:, 2] > seen[:, 2] + limit
    through = points[:, 2] < seen[:, 2] - limit
    near = np.abs(distance) < limit
    agreeing = near & ~(through & ~near)
    judged = agreeing | (through & ~near)
    counted = ~hidden | near
    residual = np.abs(distance[counted])
    total = max(1, int(judged.sum()))
    return _Check(
        overlap=len(pixel) / max(1, len(p)),
        agreement=float(agreeing.sum()) / total,
        closeness=float(np.exp(-residual / settings.residual_scale_m).mean()) if len(residual) else 0.0,
        residual_m=float(np.sqrt(np.mean(distance[agreeing] ** 2))) if agreeing.any() else float("inf"),
        agreeing=int(agreeing.sum()),
    )


class _EdgeBuilder:
    """Puts an edge together, with its scores."""

    def __init__(self, keyframe_u: Keyframe, keyframe_v: Keyframe, u_id: int, v_id: int) -> None:
        self._ends = (keyframe_u, keyframe_v)
        self._ids = (u_id, v_id)
        self.scores: dict[str, float] = {}

    def rejected(self, reason: str) -> Edge:
        """Return an edge that is kept only for the record."""
        return self._edge(Sim3.identity(), 0.0, 0, 0.0, False, reason)

    def judged(
        self,
        T_v_u: Pose,
        found: FrameRegistration,
        checks: tuple[_Check, _Check],
        pose: FeaturePose,
        settings: VerificationSettings,
        later: bool,
    ) -> Edge:
        """Accept or reject by the checks of both sides."""
        overlap = max(c.overlap for c in checks)
        agreement = min(c.agreement for c in checks)
        confidence = min(c.closeness for c in checks)
        changed = later and max(c.agreement for c in checks) >= settings.one_sided
        least = settings.least_changed_agreement if changed else settings.least_agreement
        self.scores |= {"overlap": overlap, "agreement": agreement, "residual_sigmas": found.residual}
        fit = f"{pose.inliers} features agree, {overlap:.0%} seen by both, of it {agreement:.0%} agrees"
        reason, good = fit, True
        if min(c.overlap for c in checks) < settings.least_overlap / 2 or overlap < settings.least_overlap:
            reason, good = f"too little is seen by both ({fit})", False
        elif agreement < least:
            reason, good = f"one side sees through surfaces of the other ({fit})", False
        elif found.residual > settings.most_residual:
            reason, good = f"depth differs by {found.residual:.1f} times the sensor's noise ({fit})", False
        u, v = self._ends
        S_v_u = Sim3.from_matrix(v.T_chunk_cam @ T_v_u @ np.linalg.inv(u.T_chunk_cam))
        S_v_u = Sim3(np.ones(()), S_v_u.rotation, S_v_u.translation)
        edge = self._edge(S_v_u, confidence, sum(c.agreeing for c in checks), checks[0].residual_m, good, reason)
        seen = u.depth_small[u.depth_small > 0]
        depth = float(np.median(seen)) if seen.size else 1.0
        return replace(edge, covariance=registration_covariance(found, u.T_chunk_cam, depth, settings.errors))

    def _edge(
        self, S_v_u: Sim3, confidence: float, inliers: int, residual_m: float, accepted: bool, reason: str
    ) -> Edge:
        return Edge(
            u=self._ids[0],
            v=self._ids[1],
            kind="loop",
            S_v_u=S_v_u,
            confidence=confidence,
            weight=confidence if accepted else 0.0,
            inliers=inliers,
            residual_m=residual_m,
            accepted=accepted,
            reason=reason,
            scores=self.scores,
            frames=(self._ends[0].frame_index, self._ends[1].frame_index),
        )
