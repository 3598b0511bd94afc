"""Settings of dense depth by plane sweep. Pixels are those of the working widths."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SweepViewSettings:
    """How keyframes and their sources are chosen. Angles are of triangulation."""

    stride: int = 8
    """Most frames from one keyframe to the next; the sharpest of each run is taken."""
    least_keyframes: int = 6
    """Short chunks have shorter runs, to give about this many keyframes."""
    step: float = 0.06
    """A run also ends when the camera has moved by this share of the depth,"""
    turn_deg: float = 8.0
    """or turned by this."""
    sources: int = 6
    neighbours: int = 6
    """Other keyframes that a keyframe's depth is compared with."""
    ideal_deg: float = 5.0
    """Best angle between precision and change of appearance."""
    angle_spread: float = 0.6
    """Rate at which other angles lose weight, natural logarithm."""
    least_deg: float = 0.6
    """Sources with less parallax are not used."""
    most_deg: float = 30.0
    least_overlap: float = 0.3
    """Share of the picture that a source must see."""
    reach: tuple[float, float] = (0.6, 2.0)
    """Depths are searched from this share of the nearest triangulated points to this multiple of the farthest."""


@dataclass(frozen=True)
class SweepSettings:
    """How one keyframe is matched with its sources."""

    coarse_width_px: int = 160
    """Width at which all depths are tested."""
    width_px: int = 320
    """Width at which depth is refined, fused and filtered."""
    planes: int = 96
    radius_px: int = 2
    """Half the matching window, at either width."""
    image_noise: float = 0.006
    """Standard deviation of a small picture's brightness; weaker texture is noise."""
    path_small: float = 0.03
    """Cost of a step of one plane between neighbours; matching costs are in [0, 1]."""
    path_large: float = 0.22
    """Cost of a larger step between neighbours of equal brightness."""
    path_edge: float = 0.04
    """Difference of brightness that halves the cost of a larger step."""
    refine_steps: tuple[float, ...] = (0.5, 0.25)
    """Spacing of the depths that each refinement tests, planes."""
    edge_reach_px: int = 5
    """Reach of the coarse windows beyond a surface's edge, within which depth is chosen anew at the refined width."""
    edge_likeness: float = 0.05
    """Difference of brightness at which a neighbour's weight is divided by e."""
    edge_doubt: float = 0.02
    """Least cost between two surfaces close by; with less it is unknown which of them a pixel shows."""


@dataclass(frozen=True)
class DepthFusionSettings:
    """How depth is checked, fused and filled."""

    match_px: float = 0.35
    """Deviation of a match along its line, px at the refined width."""
    drift: float = 0.006
    """Disagreement of keyframes with perfect matches, share of depth (poses, rounding)."""
    gate: float = 2.5
    """Deviations within which two keyframes agree."""
    most_gate: float = 0.04
    """Largest such difference, share of depth."""
    least_agree: int = 2
    """Other keyframes that must agree; all of them where fewer see the place, but never none."""
    fill_radius_px: int = 8
    """Half the window that holes are filled from; a pixel must be known this near on all four sides."""
    fill_share: float = 0.35
    """Share of the window that must be known,"""
    fill_residual: float = 0.012
    """and its flatness: deviation from a plane, share of depth."""
    fill_sigma: float = 0.04
    """Stated deviation of filled depth, share of depth."""
    projected_from: int = 6
    """Keyframes whose depth is projected into a frame."""
    projected_least: int = 2
    """Least keyframes that see each part of a frame, where there are as many."""
    projected_tolerance: float = 0.03
    """Depths of a pixel that are averaged are at most this share behind the nearest."""
    enlarged_step: float = 0.04
    """Depth difference of two surfaces when a picture is enlarged, share of depth."""
    rim_px: int = 2
    """Outer pixels of foreground surfaces that are left out of a keyframe,"""
    projected_rim_px: int = 1
    """and of a frame with projected depth: the nearest surface wins there and grows by as much."""
    rim_step: float = 0.04
    """Step of depth, share of it, between foreground and background."""
    speckle_radius_px: int = 2
    """Half the window in which a pixel needs neighbours,"""
    speckle_share: float = 0.35
    """and the share of it that must be known."""


@dataclass(frozen=True)
class RegionFillSettings:
    """Which regions are filled. Pixels are those of the working width, 320."""

    edge: float = 9.0
    """Change of colour across two pixels that separates regions, grey levels."""
    least_px: int = 12
    most_share: float = 0.2
    """Larger regions, as a share of the picture, are left unknown."""
    rim_px: int = 4
    """Width of the rim."""
    rim_color: float = 20.0
    """Largest colour difference of rim and region, grey levels: an object before a wall is no rim of the wall."""
    rim_least: int = 24
    tolerance: float = 0.015
    """Distance from the plane, share of depth."""
    agree: float = 0.6
    """Share of the rim that must be on the plane,"""
    around: float = 0.6
    """and share of the region that this part of the rim must surround."""
    sigma: float = 0.05
    """Stated deviation of filled depth, share of depth."""
    hypotheses: int = 80


@dataclass(frozen=True)
class MatchTrustSettings:
    """Which matches are valid, and their confidence."""

    most_cost: float = 0.35
    """Matching cost above which a match is none (ZNCC 0.3)."""
    least_margin: float = 0.02
    """Least cost margin of the best depth over any different one,"""
    sure_margin: float = 0.15
    """and the margin of a match without doubt, by which the span of depths is found."""
    least_texture: float = 0.5
    """Variance of the window over that of noise below which there is no texture to match."""
    half_sigma: float = 0.02
    """Deviation, share of depth, at which confidence is one half."""
    noise_frames: int = 12
    """Frames of a chunk from which the noise of depth is measured."""


@dataclass(frozen=True)
class SweepNetworkSettings:
    """Where the network's depth replaces missing matches (research/colour-video 0199)."""

    most_error: float = 0.06
    """Expected mean error, share of depth, above which it is left out."""
    reach_px: int = 10
    """Half the window, px at the refined width, in which there must be matches that it agrees with: the middle of a
    large blank or glossy surface cannot be verified,"""
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
