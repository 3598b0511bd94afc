"""Settings of reconstruction `rgbd`. Lengths are metres."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.reconstruction.base import KeyframeSpacing, SensorNoise
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.reconstruction.motion.settings import FreeSpaceMoverSettings, MoverTrackSettings, ResidualMoverSettings
from list3r.reconstruction.pose_prior import PriorSettings


@dataclass(frozen=True)
class RegistrationSettings:
    """How a view is registered."""

    iterations: int = 12
    gate_m: float = 0.10
    """First limit of the point-to-plane distance."""
    gate_halvings: int = 2
    """Number of halvings of that limit."""
    gate_hold: int = 1
    """Iterations before it is halved again."""
    huber: float = 1.345
    """Limit of the quadratic part of the kernel, in robust standard deviations."""
    normal_agreement: float = 0.7
    """Least cosine between the normals of a pair."""
    photometric_weight: float = 2.0
    """Weight of a brightness residual against a depth residual of the same number of standard deviations."""
    normal_noise: float = 0.05
    """Standard deviation of a measured normal, radians, whose spurious information is subtracted."""
    gradient_noise: float = 2.0
    """Brightness gradients below this are noise, grey levels per pixel."""
    least_pairs: int = 150
    converged: float = 3e-5
    """Largest component of the last step, metres and radians."""


@dataclass(frozen=True)
class SurfelSettings:
    """How views are fused into a model."""

    weight_cap: float = 50.0
    """Most views that an element averages, so that it can still follow a change."""
    normal_agreement: float = 0.6
    """Least cosine between an element and a measurement that update it."""
    exposure_step: float = 10.0
    """Change of brightness that is another exposure, about grey levels; less is shading, which is averaged."""
    drop_below: float = 0.02
    """Weight under which an element that later views saw through is dropped."""


@dataclass(frozen=True)
class ConfidenceSettings:
    """How confidence falls off."""

    half_sigma_m: float = 0.01
    """Depth noise at which confidence is one half, metres."""
    full_cosine: float = 0.5
    """Cosine between ray and normal above which the angle does not lower confidence."""
    edge_step: float = 0.02
    """Depth step between neighbours that makes an edge, as a share of depth."""
    edge_confidence: float = 0.1
    """Factor at pixels next to an edge, where depth mixes two surfaces."""
    working_width: int = 160
    """Width of the image on which the angle is measured, px."""
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class OdometrySettings:
    """How the camera is tracked."""

    working_width: int = 160
    """Width of the images that are registered, px."""
    samples: int = 6000
    """Model points used for one frame."""
    least_known: float = 0.08
    """Least share of pixels with depth and normal for a frame to be used."""
    least_overlap: float = 0.2
    """Least share of the model points in view that fall on known depth, relative to the frame's known share."""
    least_inliers: float = 0.6
    """Least share of inliers among them."""
    most_residual: float = 3.0
    """Largest robust deviation of the depth residuals, in units of the sensor's noise."""
    least_correlation: float = 0.5
    """Least correlation of brightness with the model's, where either has any."""
    most_looseness_m: float = 0.02
    """Largest standard deviation of the least determined motion, at the median depth: guards against bare walls."""
    doubt: float = 0.85
    """A frame that agrees less than this share of the usual, in depth times brightness, is searched for as well."""
    forget: float = 0.98
    """Decay of the usual agreement from one frame to the next that has less."""
    most_speed_m_per_s: float = 3.0
    most_turn_deg_per_s: float = 360.0
    foretold_px: float = 2.0
    """A registration this close to its start is the minimum that was foretold: brightness and its slope, smoothed over
    three pixels of the working images, reach no farther. Others are verified by features."""
    most_gap_s: float = 1.5
    """Frames further apart than this are searched for by features only."""
    short_segment: int = 5
    """Frames from which on a new segment is independent."""
    feature_width: int = 448
    """Width of the pictures whose features are compared, px."""
    search_keyframes: int = 6
    """Most keyframes whose features are compared in a search."""
    join_keyframes: int = 8
    """Keyframes of a segment by which it is joined to another, each compared with three times as many of that one."""
    sweep_samples: int = 800
    """Model points used by the coarse registrations of a search."""
    start_shift: float = 0.1
    """Sideways starts of a search, share of the median depth: the motion of a slow video between frames."""
    start_turn_deg: float = 12.0
    """Starts of a search that rotate about a point at the median depth."""
    sweep: RegistrationSettings = field(
        default_factory=lambda: RegistrationSettings(
            iterations=10, gate_m=0.4, gate_halvings=4, gate_hold=2, huber=3.0, normal_agreement=0.6
        )
    )
    """Those coarse registrations: a wide gate that closes slowly."""
    keyframes: KeyframeSpacing = field(default_factory=KeyframeSpacing)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    fusion: SurfelSettings = field(default_factory=SurfelSettings)
    features: FeatureSettings = field(default_factory=FeatureSettings)
    movers: ResidualMoverSettings = field(default_factory=ResidualMoverSettings)
    prior: PriorSettings = field(default_factory=PriorSettings)
    """Of poses that the source gives as a prior."""
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class RgbdSettings:
    """How a chunk of RGB-D frames is reconstructed."""

    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    confidence: ConfidenceSettings = field(default_factory=ConfidenceSettings)
    movers: FreeSpaceMoverSettings = field(default_factory=FreeSpaceMoverSettings)
    mover_tracks: MoverTrackSettings = field(default_factory=MoverTrackSettings)
    most_step: int = 2
    """Largest step between frames of a slow video that get depth, unless another is asked for (research/speed 0159)."""
