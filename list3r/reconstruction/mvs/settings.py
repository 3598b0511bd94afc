"""Settings of dense depth by plane sweep. Pixels are those of the working widths."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SweepViewSettings:
    """How keyframes and their sources are chosen. Angles are of triangulation."""

    stride: int = 8
    """Most frames from one keyframe to the next; the sharpest of each run is taken."""
    least_keyframes: int = 6
    """Short chunks have shorter runs, so that there are about so many."""
    step: float = 0.06
    """A run also ends when the camera has moved by this share of the depth,"""
    turn_deg: float = 8.0
    """or turned by this."""
    sources: int = 6
    neighbours: int = 6
    """Other keyframes that a keyframe's depth is compared with."""
    ideal_deg: float = 5.0
    """Angle that trades precision against change of looks best."""
    angle_spread: float = 0.6
    """How soon another angle counts less, natural logarithm."""
    least_deg: float = 0.6
    """Sources with less parallax tell nothing."""
    most_deg: float = 30.0
    least_overlap: float = 0.3
    """Share of the picture that a source must see."""
    reach: tuple[float, float] = (0.6, 2.0)
    """Depths are looked for from this share of the nearest triangulated points to so many times the farthest."""


@dataclass(frozen=True)
class SweepSettings:
    """How one keyframe is matched with its sources."""

    coarse_width_px: int = 160
    """Width at which all depths are tried."""
    width_px: int = 320
    """Width at which depth is refined, fused and filtered."""
    planes: int = 96
    radius_px: int = 2
    """Half the matching window, at either width."""
    image_noise: float = 0.006
    """Standard deviation of a small picture's brightness; texture below it tells nothing."""
    path_small: float = 0.03
    """Cost of a step of one plane between neighbours; matching costs lie in [0, 1]."""
    path_large: float = 0.22
    """Cost of a larger step between neighbours of equal brightness."""
    path_edge: float = 0.04
    """Difference of brightness that halves the cost of a larger step."""
    refine_steps: tuple[float, ...] = (0.5, 0.25)
    """Spacing of the depths that each refinement tries, planes."""
    edge_reach_px: int = 5
    """How far the coarse windows carry a surface beyond its edge; so far depth is chosen anew, at the refined width."""
    edge_likeness: float = 0.05
    """Difference of brightness at which a neighbour's evidence counts e times less."""
    edge_doubt: float = 0.02
    """Cost that must lie between two surfaces close by; with less it is unknown which of them a pixel shows."""


@dataclass(frozen=True)
class DepthFusionSettings:
    """How depth is checked, fused and filled."""

    match_px: float = 0.35
    """Deviation of a match along its line, px at the refined width."""
    drift: float = 0.006
    """Disagreement of keyframes that is left where matches are perfect, share of depth (poses, rounding)."""
    gate: float = 2.5
    """Deviations within which two keyframes agree."""
    most_gate: float = 0.04
    """They never agree further apart than this share of depth."""
    least_agree: int = 2
    """Other keyframes that must agree; all of them where fewer see the place, but never none."""
    fill_radius_px: int = 8
    """Half the window that holes are filled from; something must be known this near on all four sides."""
    fill_share: float = 0.35
    """Share of the window that must be known,"""
    fill_residual: float = 0.012
    """and how flat it must be: deviation from a plane, share of depth."""
    fill_sigma: float = 0.04
    """Deviation that filled depth is said to have, share of depth."""
    carried_from: int = 6
    """Keyframes whose depth is carried into a frame."""
    carried_least: int = 2
    """Keyframes that see each part of a frame at least, where there are as many."""
    carried_tolerance: float = 0.03
    """Depths of a pixel that are averaged lie no farther behind the nearest than this share of it."""
    enlarged_step: float = 0.04
    """Depths that lie on two surfaces when a picture is enlarged, share of depth."""
    rim_px: int = 2
    """Outer pixels of what stands before something farther that are left out of a keyframe,"""
    carried_rim_px: int = 1
    """and of a frame that depth was carried into: the nearest surface wins there and grows by as much."""
    rim_step: float = 0.04
    """Step of depth, share of it, from which something stands before something."""
    speckle_radius_px: int = 2
    """Half the window in which a pixel needs neighbours,"""
    speckle_share: float = 0.35
    """and the share of it that must be known."""


@dataclass(frozen=True)
class RegionFillSettings:
    """Which regions are filled. Pixels are those of the working width, 320."""

    edge: float = 9.0
    """Change of colour across two pixels that parts regions, grey levels."""
    least_px: int = 12
    most_share: float = 0.2
    """Larger regions, as a share of the picture, are left unknown."""
    rim_px: int = 4
    """Width of the rim."""
    rim_color: float = 20.0
    """The rim looks like its region within this, grey levels: what stands before a wall is no rim of the wall."""
    rim_least: int = 24
    tolerance: float = 0.015
    """Distance from the plane, share of depth."""
    agree: float = 0.6
    """Share of the rim that must lie on the plane,"""
    around: float = 0.6
    """and share of the region that this part of the rim must surround."""
    sigma: float = 0.05
    """Deviation that filled depth is said to have, share of depth."""
    hypotheses: int = 80


@dataclass(frozen=True)
class MatchTrustSettings:
    """Which matches mean something, and what confidence says."""

    most_cost: float = 0.35
    """Matching cost above which a match is none (ZNCC 0.3)."""
    least_margin: float = 0.02
    """A different depth must cost this much more, or it may be that one."""
    sure_margin: float = 0.15
    """... and this much for a match that leaves no doubt, by which the span of depths is found."""
    least_texture: float = 0.5
    """Variance of the window over that of noise below which there is nothing to match."""
    half_sigma: float = 0.02
    """Deviation, share of depth, at which confidence is one half."""
    noise_frames: int = 12
    """Frames of a chunk by which the roughness of depth is measured."""


@dataclass(frozen=True)
class SweepNetworkSettings:
    """What of the network's depth is taken where matches tell none (research/colour-video 0199)."""

    most_error: float = 0.06
    """Mean error that it expects, share of depth, above which it is left out."""
    reach_px: int = 10
    """Half the window, px at the refined width, in which there must be matches that it agrees with: in the middle of a
    large blank or glossy surface nothing shows that it is right,"""
    least_share: float = 0.08
    """and the share of the window that they cover."""


@dataclass(frozen=True)
class MvsSettings:
    """Dense depth of a chunk."""

    views: SweepViewSettings = field(default_factory=SweepViewSettings)
    sweep: SweepSettings = field(default_factory=SweepSettings)
    fusion: DepthFusionSettings = field(default_factory=DepthFusionSettings)
    fill: RegionFillSettings = field(default_factory=RegionFillSettings)
    trust: MatchTrustSettings = field(default_factory=MatchTrustSettings)
    network: SweepNetworkSettings | None = field(default_factory=SweepNetworkSettings)
    """None: by matches alone."""
