"""Settings of reconstruction `sfm`."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.frames.sift import CONTRAST
from list3r.reconstruction.base import KeyframeSpacing
from list3r.reconstruction.mvs.settings import MvsSettings

LEAST_MATCHES = 20
"""Fewest corners or features that two pictures must share."""
SEED = 1
"""Of all random samples."""
MIDDLE_DEPTH = 2.0
"""Median depth to which a chunk is scaled."""


@dataclass(frozen=True)
class CornerSettings:
    """How corners are found and tracked."""

    width: int = 1024
    """Pictures are shrunk to at most this many px on their longer side."""
    corners: int = 600
    """Corners tracked at a time."""
    quality: float = 0.003
    """Least strength of a corner, as a share of the strongest."""
    least_strength: float = 2e-4
    """Least smaller eigenvalue of a corner's gradients; below is sensor noise (black frames, bare walls)."""
    spacing: float = 0.0125
    """Least distance of corners, by the longer side (8 px of 640)."""
    window_px: int = 21
    levels: int = 4
    """Pyramid levels in which corners are searched, the smallest first."""
    near_levels: int = 2
    """The same after a frame of little motion, from the position that the same motion predicts."""
    near_flow: float = 0.02
    """Largest such motion of half of the corners, by the longer side (13 px of 640)."""
    least_near: float = 0.9
    """Where less than this share is found, all levels are searched after all."""
    refined_every: int = 3
    """Positions are refined in every n-th frame, and in keyframes."""
    most_creep_px: float = 2.0
    """Largest distance of the refined position from the tracked one."""
    most_back_px: float = 1.0
    """Largest distance from its start of a corner that is tracked back."""
    most_difference: float = 22.0
    """Largest mean difference of grey values between a corner and its first observation."""
    least_brightening: float = 3.0
    """Least difference of grey values for a picture to be brought to another's brightness first."""
    brightness_samples: int = 512
    """About the most corners that determine that."""
    keyframe_flow: float = 0.05
    """A frame is a keyframe when half of the corners of the last one have moved so far, by the longer side."""
    keyframe_survival: float = 0.55
    """... or when no more than this share of them is left."""
    least_survival: float = 0.25
    """Share below which the corners count as lost from one frame to the next."""
    most_lost: int = 3
    """Frames in which corners may be lost and still be found again behind."""
    least_corners: int = 30
    """Fewer corners than this are not tracked."""


@dataclass(frozen=True)
class FinderSettings:
    """How features of keyframes are found and matched."""

    width: int = 1024
    """Pictures are shrunk to at most this many px on their longer side before SIFT features are sought."""
    count: int = 2000
    """SIFT features of a keyframe."""
    learned_count: int = 1200
    """Learned ones."""
    contrast: float = CONTRAST
    """SIFT's contrast threshold."""
    few: int = 300
    """The best features, by which keyframes worth matching are chosen."""
    least_few: int = 4
    """Fewest of them that must agree."""
    partners: int = 8
    """Keyframes that each is matched with, those of most agreement."""


@dataclass(frozen=True)
class LinkSettings:
    """Which keyframes are matched, and how features are found."""

    features: FinderSettings = field(default_factory=FinderSettings)
    context: int = 8
    """Frames on either side of a chunk that are mapped with it."""
    context_step: float = 2.0
    """Their distance, by that of the chunk's keyframes."""
    most_step: int = 25
    """... and at most this many frames."""
    ahead: int = 6
    """Keyframes ahead that each is matched with."""
    ahead_features: int = 600
    """Features of each for that,"""
    ahead_width: int = 448
    """and the width of the pictures. It takes half the time of 640, and maps are equally good (research/colour-video
    0182)."""


@dataclass(frozen=True)
class ConsistencySettings:
    """When a keyframe is contradicted."""

    most_px: float = 4.0
    """Largest epipolar error of a match that agrees, px of a picture 640 wide."""
    least_share: float = 0.75
    """Least share of a keyframe's matches that must agree."""


@dataclass(frozen=True)
class PureRotationSettings:
    """When a camera only rotates."""

    most_px: float = 2.0
    """Usual error of matches, px of a picture 640 wide."""
    share: float = 0.8
    """Share of the matches that must be explained."""
    most_pairs: int = 16
    """About the most pairs that are tested, spread evenly."""
    focal_ratio: float = 1.6
    """Largest ratio of the tested focal lengths to the camera's."""
    rounds: int = 3
    """Rotations fitted to a pair, each to the matches that the one before explains best."""


@dataclass(frozen=True)
class MappingSettings:
    """How keyframes become a map. Errors in px of a picture 640 wide."""

    matched_share: float = 1.0 / 3.0
    """Share of two keyframes' descriptor matches that must agree on their geometry. On redkitchen (every 20th and
    30th frame) and simulated walks 99 % of the right pairs have 0.34 and more; chance pairs 0.2 to 0.3."""
    pair_error_px: float = 2.0
    """Largest epipolar error of a match."""
    pair_trials: int = 1000
    """Most samples by which the geometry of a pair is searched by MAGSAC."""
    pose_error_px: float = 4.0
    """Largest error of a correspondence of structure and picture when a keyframe is added."""
    point_error_px: float = 2.0
    """Largest error of an observation that is kept."""
    first_angle_deg: float = 6.0
    """Least angle between the rays of the first two keyframes, where a known camera lets the mapper choose them."""
    given_angle_deg: float = 3.0
    """The same where the pair is given, or the camera is estimated as well."""
    given_steps: tuple[int, int] = (4, 7)
    """Fewest and most keyframes from the first to the second one of a given pair."""
    given_pairs: int = 2
    """Most pairs from which a map is grown in addition to the one that the mapper chooses."""
    steady: float = 0.0
    """No other pair is tried where the points' depth changes by less than this factor from each keyframe to the next;
    0 for maps that are always compared with others."""
    same_error: float = 1.005
    """Two maps of errors within this ratio are the same, and no third is grown: right ones of one chunk differ by 0.1
    to 0.7 %, deformed ones are 9 to 12 % off (simulated walks 101 to 104)."""
    growth: float = 1.4
    """The whole map is adjusted each time it has grown by this factor."""
    whole_iterations: int = 25
    """Most iterations of that,"""
    whole_rounds: int = 3
    """and most rounds, each without the outliers of the one before."""
    part_iterations: int = 10
    """Most iterations of the adjustment of a new keyframe with those around it,"""
    part_rounds: int = 2
    """most rounds,"""
    part_views: int = 6
    """and most keyframes."""
    rough_iterations: int = 0
    """Most iterations of the whole map while it grows, then once each time; the kept map is adjusted as above
    when it is complete. 0 for maps that are always adjusted so."""
    tolerance: float = 0.0
    """Adjustments end when a step gains less than this share of the error."""
    turned_scale: float = 0.05
    """A map of all keyframes at once is tried where rotations lose that much of the scale, or maps separate keyframes
    with matches. Maps of chunks that were broken have 0.06 to 0.16, others at most 0.046 (research/colour-video 0208).
    """
    alike: float = 0.95
    """Maps with at least this share of the keyframes of the largest are compared by their error."""
    point_angle_deg: float = 1.0
    """Least angle between the rays to a point."""
    least_points: int = 40
    """Fewest points of an accepted map."""
    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)
    turning: PureRotationSettings = field(default_factory=PureRotationSettings)


@dataclass(frozen=True)
class AdjustmentSettings:
    """How keyframes are adjusted. Errors in px of a picture 640 wide."""

    gates_px: tuple[float, ...] = (8.0, 2.0, 1.5)
    """Observations farther from their point's image than this are left out, round by round."""
    loss_px: float = 0.5
    """Errors larger than this count less (soft L1)."""
    iterations: int = 30
    """Most of the last round;"""
    early_iterations: tuple[int, ...] = (5, 10)
    """and of those before it, which still contain outliers: poses are as near to the truth as with 30
    (research/colour-video 0145)."""
    least_points: int = 12
    """Fewest points of a keyframe with an accepted pose."""
    mapping: MappingSettings = field(default_factory=MappingSettings)


@dataclass(frozen=True)
class FramePoseSettings:
    """How the frames between keyframes are posed."""

    bridge: int = 4
    """Frames without corners in a row, between two posed ones, that are posed by tracking known points."""
    bridge_window_px: int = 31
    """Window in which these are tracked."""
    least_matches: int = LEAST_MATCHES
    """Fewest points of the map that a frame must see."""
    pose_error_px: float = 4.0
    """Largest error of a pose's inlier, px of a picture 640 wide."""
    refined_share: float = 0.6
    """Least share of inliers of a pose refined from the frame before; else a pose is sampled,"""
    sampled_share: float = 0.3
    """of a sampled pose,"""
    bridged_share: float = 0.5
    """and of the pose of a bridged frame."""
    bridge_return_px: float = 2.0
    """Largest distance from its start of a point of a bridged frame that is tracked back, px."""
    least_inliers: int = 12
    """Fewest inliers of a pose."""


@dataclass(frozen=True)
class CameraCalibrationSettings:
    """Which frames are used, and what is accepted."""

    windows: int = 5
    """Windows of the video that are used."""
    frames: int = 100
    """Frames in each."""
    least_frames: int = 60
    """... and in each of a video too short for so many: the windows of a short one overlap by half, so that one is free
    of a pause, a wall or a jump in the middle. The focal length of one window of four clips of 160 frames of redkitchen
    is 8, 12, 6 and (a guess) 38 % off, that of three of 80 frames 11, 0, 3 and 1 %."""
    least_windows: int = 3
    """Windows of such a video."""
    most_window_ratio: float = 1.3
    """Windows of focal lengths farther off the median of all are ignored: they have too little parallax."""
    zoom_ratio: float = 1.5
    """Windows of focal lengths farther off than this are reported: more than four deviations of one window.
    Windows shorter than `frames` are too inaccurate for that."""
    zoom_distortion: float = 0.2
    """... unless their k1 is farther off than this, see below."""
    most_error_px: float = 2.0
    """Observations farther from their point's image than this are left out."""
    rounds: int = 3
    """Joint adjustments, each without the outliers of the one before."""
    tolerance: float = 1e-5
    """The last of them ends when a step gains less than this share of the error,"""
    early_tolerance: float = 1e-3
    """and those before it, which only find outliers."""
    focal_range: tuple[float, float] = (0.4, 3.0)
    """Accepted focal lengths, by the longer side of the picture."""
    distortion_range: tuple[float, float] = (-0.5, 0.2)
    """Accepted k1. With little parallax a map compensates a focal length that is too long by a large positive k1 that
    no camera lens has: of 19 windows of redkitchen three have 887, 971 and 2947 px of 524, with 0.26, 0.32 and 5.3."""
    least_shift_px: float = 0.3
    """Distortion that shifts the corners of the picture by less is none."""
    window_sigma: float = 0.09
    """Standard deviation of the logarithm of one window's focal length (redkitchen, 60 to 100 frames: 0.087)."""
    window_weight: float = 4.0
    """Weight of that prior, in windows, against the spread of the windows of a video."""
    mapping: MappingSettings = field(default_factory=MappingSettings)
    """How they are mapped: the last of the error determines a focal length."""
    doubted_sigmas: float = 2.5
    """A given focal length farther off than this is reported."""


def maps_of_chunks() -> MappingSettings:
    """Return how the keyframes of a chunk are mapped: to convergence, and grown roughly, which is as near to the truth
    and to the pictures (research/speed 0157 and 0181)."""
    return MappingSettings(
        tolerance=1e-4,
        growth=2.0,
        part_iterations=5,
        part_rounds=1,
        part_views=4,
        rough_iterations=10,
    )


@dataclass(frozen=True)
class SfmSettings:
    """How a chunk of RGB frames is reconstructed."""

    tracks: CornerSettings = field(default_factory=CornerSettings)
    links: LinkSettings = field(default_factory=LinkSettings)
    mapping: MappingSettings = field(default_factory=maps_of_chunks)
    fill: FramePoseSettings = field(default_factory=FramePoseSettings)
    calibration: CameraCalibrationSettings = field(default_factory=CameraCalibrationSettings)
    keyframes: KeyframeSpacing = field(default_factory=KeyframeSpacing)
    dense: MvsSettings = field(default_factory=MvsSettings)
    least_flow: float = 0.01
    """A camera whose picture moves less than this through a whole chunk, by the longer side, is static."""
    least_side_px: int = 128
    """Shorter longer sides of pictures are reported as the reason where nothing can be tracked."""
    least_segment: int = 8
    """Least frames of a further part of a chunk that is kept."""
