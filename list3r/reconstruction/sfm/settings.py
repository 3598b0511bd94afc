"""Settings of reconstruction `sfm`."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.reconstruction.base import KeyframeSpacing
from list3r.reconstruction.mvs.settings import MvsSettings

MIDDLE_DEPTH = 2.0
"""Where the middle of what a chunk sees is put."""


@dataclass(frozen=True)
class CornerSettings:
    """How corners are found and followed."""

    width: int = 1024
    """Pictures are shrunk to at most this many px on their longer side."""
    corners: int = 600
    """Corners followed at a time."""
    quality: float = 0.003
    """Least strength of a corner by that of the strongest."""
    least_strength: float = 2e-4
    """Least smaller eigenvalue of a corner's gradients; below is sensor noise (black frames, bare walls)."""
    spacing: float = 0.0125
    """Corners are no nearer to each other, by the longer side (8 px of 640)."""
    window_px: int = 21
    levels: int = 4
    """Halvings of the picture in which corners are looked for, the smallest first."""
    near_levels: int = 2
    """Those after a frame that moved little, from where the same motion leads."""
    near_flow: float = 0.02
    """Most that half of the corners then move, by the longer side (13 px of 640)."""
    least_near: float = 0.9
    """Where less than this share is found, all levels are looked at after all."""
    refined_every: int = 3
    """Places are refined in every so many frames, and in keyframes."""
    most_creep_px: float = 2.0
    """Farthest that the refined position may lie from where the corner was followed to."""
    most_back_px: float = 1.0
    """Farthest from its start that a corner may come out when it is followed back."""
    most_difference: float = 22.0
    """Largest mean difference of grey values between a corner and where it was first seen."""
    least_brightening: float = 3.0
    """Grey values that a picture has to be brighter or darker than another to be brought to its brightness first."""
    brightness_samples: int = 512
    """About so many corners at the most tell that."""
    keyframe_flow: float = 0.05
    """A frame is a keyframe when half of the corners of the last one have moved so far, by the longer side."""
    keyframe_survival: float = 0.55
    """... or when no more than this share of them is left."""
    least_survival: float = 0.25
    """Less than this share left from one frame to the next means that the corners were lost."""
    look_past: int = 3
    """Frames in which corners are lost and found again behind."""
    least_corners: int = 30
    """Fewer corners than this are not followed."""


@dataclass(frozen=True)
class FinderSettings:
    """How features of keyframes are found and matched."""

    width: int = 1024
    """Pictures are shrunk to at most this many px on their longer side before SIFT features are sought."""
    count: int = 2000
    """SIFT features of a keyframe."""
    learned_count: int = 1200
    """Learned ones."""
    contrast: float = 0.015
    """SIFT's contrast threshold."""
    ratio: float = 0.85
    """Lowe's ratio of SIFT."""
    few: int = 300
    """The surest features, by which keyframes worth matching are chosen."""
    least_few: int = 4
    """Fewest of them that must agree."""
    partners: int = 8
    """Keyframes that one is matched with, those that most agree."""


@dataclass(frozen=True)
class LinkSettings:
    """Which keyframes are related, and how features are found."""

    features: FinderSettings = field(default_factory=FinderSettings)
    least_matches: int = 20
    """Fewest shared corners or features that make a pair."""
    beside: int = 8
    """Frames on either side of a chunk that are mapped with it."""
    beside_step: float = 2.0
    """How far apart they are, by the distance of the chunk's keyframes."""
    most_step: int = 25
    """... and no more frames than this."""
    ahead: int = 6
    """Keyframes that each is matched with, ahead of it."""
    ahead_features: int = 600
    """Features of each for that,"""
    ahead_width: int = 448
    """and the width of the pictures. It takes half the time of 640, and maps come out alike (research/colour-video
    0182)."""


@dataclass(frozen=True)
class ConsistencySettings:
    """When a keyframe is contradicted."""

    most_px: float = 4.0
    """Largest epipolar error of a match that agrees, px of a picture 640 wide."""
    least_share: float = 0.75
    """Least share of a keyframe's matches that must agree."""


@dataclass(frozen=True)
class TurningSettings:
    """When a camera only turns."""

    most_px: float = 2.0
    """Error that matches have anyhow, px of a picture 640 wide."""
    share: float = 0.8
    """So many of the matches must be explained."""
    least_matches: int = 20
    """Fewest matches of a pair."""
    most_pairs: int = 16
    """About so many pairs at the most are looked at, spread evenly."""
    focal_ratio: float = 1.6
    """Focal lengths that are tried differ from the camera's by no more than this."""
    rounds: int = 3
    """Rotations fitted to a pair, each to the matches that the one before explains best."""


@dataclass(frozen=True)
class MappingSettings:
    """How keyframes become a map. Errors in px of a picture 640 wide."""

    least_matches: int = 20
    """Fewest correspondences of two keyframes that count."""
    matched_share: float = 1.0 / 3.0
    """Share of what two keyframes matched by looks that must agree on their geometry. On redkitchen (every 20th and
    30th frame) and simulated walks 99 % of the right pairs have 0.34 and more; what only chance relates 0.2 to 0.3."""
    pair_error_px: float = 2.0
    """Largest epipolar error of a match."""
    pair_trials: int = 1000
    """Most samples by which the geometry of a pair is sought, where it is sought by MAGSAC."""
    pose_error_px: float = 4.0
    """Largest error of a correspondence of structure and picture when a keyframe is added."""
    point_error_px: float = 2.0
    """Largest error of an observation that stays."""
    first_angle_deg: float = 6.0
    """Least angle between the rays of the first two keyframes, where a known camera lets the mapper choose them."""
    given_angle_deg: float = field(default=3.0, metadata={"formerly": "told_angle_deg"})
    """The same where the pair is given, or the camera is estimated as well."""
    given_steps: tuple[int, int] = field(default=(4, 7), metadata={"formerly": "told_steps"})
    """Fewest and most keyframes from the first to the second one of a given pair."""
    given_pairs: int = field(default=2, metadata={"formerly": "told"})
    """Most pairs from which a map is grown besides the one that the mapper chooses."""
    steady: float = 0.0
    """None is tried where the depth of what is seen changes by less than this factor from each keyframe to the next;
    0 for maps that are always compared with others."""
    same_error: float = 1.005
    """Two maps whose errors are that near are the same, and no third is grown: right ones of one chunk differ by 0.1 to
    0.7 %, bent ones are 9 to 12 % off (simulated walks 101 to 104)."""
    growth: float = 1.4
    """The whole map is adjusted each time it has grown by this factor."""
    whole_iterations: int = 25
    """Most iterations of that,"""
    whole_rounds: int = 3
    """and so many times at most, each without what the one before contradicts."""
    part_iterations: int = 10
    """Most iterations of the adjustment of a new keyframe with those around it,"""
    part_rounds: int = 2
    """so many times at most,"""
    part_views: int = 6
    """and so many keyframes at most."""
    rough_iterations: int = 0
    """Most iterations of the whole map while it grows, then once each time; the map that is kept is adjusted as above
    when it is whole. 0 for maps that are adjusted so all the time."""
    settled: float = 0.0
    """Adjustments end when a step gains less than this share of the error."""
    turned_scale: float = 0.0
    """A map of all keyframes at once is tried where turns lose that much of the scale, or maps leave apart what shares
    matches; 0 for never. Maps of chunks that were broken have 0.06 to 0.16, others at most 0.046 (research/colour-video
    0208)."""
    alike: float = 0.95
    """Maps with at least this share of the keyframes of the largest are compared by their error."""
    point_angle_deg: float = 1.0
    """Least angle between the rays to a point."""
    least_points: int = 40
    """Fewest points of a map that is believed."""
    seed: int = 1
    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)
    turning: TurningSettings = field(default_factory=TurningSettings)


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
    """and of those before it, which still hold outliers: poses are as near to the truth as with 30
    (research/colour-video 0145)."""
    least_points: int = 12
    """Fewest points of a keyframe whose pose is believed."""
    mapping: MappingSettings = field(default_factory=MappingSettings)


@dataclass(frozen=True)
class FramePoseSettings:
    """How the frames between keyframes are posed."""

    bridge: int = 4
    """Frames without corners in a row, between two that are posed, that are looked for by the structure known there."""
    bridge_window_px: int = 31
    """Window by which its points are looked for."""
    least_matches: int = 20
    """Fewest points of the map that a frame must see."""
    pose_error_px: float = 4.0
    """Largest error of a point that agrees with a pose, px of a picture 640 wide."""
    refined_share: float = 0.6
    """Share of the points that must agree with a pose refined from the frame before; else a pose is sampled."""
    sampled_share: float = 0.3
    """... and with a sampled one."""
    bridged_share: float = 0.5
    """... and with the pose of a bridged frame."""
    bridge_return_px: float = 2.0
    """Farthest from its start that a point of a bridged frame may come out when it is followed back, px."""
    least_inliers: int = 12
    """Fewest points that agree with a pose."""
    seed: int = 1


@dataclass(frozen=True)
class CameraCalibrationSettings:
    """Which frames are looked at, and what is believed."""

    windows: int = 5
    """Stretches of the video that are looked at."""
    frames: int = 100
    """Frames in each."""
    least_frames: int = 60
    """... and in each of a video too short for so many: the windows of a short one overlap by half, so that where it
    stands still, shows a wall or jumps in the middle there is one without that. One window of four clips of 160 frames
    of redkitchen tells focal lengths 8, 12, 6 and (a guess) 38 % off, three of 80 frames 11, 0, 3 and 1 %."""
    least_windows: int = 3
    """Windows of such a video."""
    most_window_ratio: float = 1.3
    """Windows whose own focal length is farther off the middle of all say nothing: theirs has too little parallax."""
    zoom_ratio: float = 1.5
    """Windows whose focal length is farther off than this are reported: more than four deviations of one window.
    Windows shorter than `frames` say too little for that."""
    zoom_distortion: float = 0.2
    """... unless their k1 is farther off than this, see below."""
    most_error_px: float = 2.0
    """Observations farther from their point's image than this are left out."""
    rounds: int = 3
    """Joint adjustments, each without what the one before contradicts."""
    settled: float = 1e-5
    """The last of them ends when a step gains less than this share of the error,"""
    early_settled: float = 1e-3
    """and those before it, which only tell what is contradicted."""
    focal_range: tuple[float, float] = (0.4, 3.0)
    """Focal lengths believed, by the longer side of the picture."""
    distortion_range: tuple[float, float] = (-0.5, 0.2)
    """k1 believed. With little parallax a map bends a focal length that is too long straight by a large positive k1,
    as no lens of a camera has it: of 19 windows of redkitchen three say 887, 971 and 2947 px of 524, with 0.26, 0.32
    and 5.3."""
    least_shift_px: float = 0.3
    """Distortion that shifts the corners of the picture by less is none."""
    window_sigma: float = 0.09
    """Standard deviation of the logarithm of one window's focal length (redkitchen, 60 to 100 frames: 0.087)."""
    window_weight: float = 4.0
    """So many windows' worth is that belief when the windows of a video tell their own spread."""
    mapping: MappingSettings = field(default_factory=MappingSettings)
    """How they are mapped: a focal length is told by the last of the error."""
    doubted_sigmas: float = 2.5
    """A given focal length farther off than this is doubted aloud."""


def maps_of_chunks() -> MappingSettings:
    """Return how the keyframes of a chunk are mapped: maps settle, and grow roughly, which is as near to the truth and
    to the pictures (research/speed 0157 and 0181)."""
    return MappingSettings(
        settled=1e-4, growth=2.0, part_iterations=5, part_rounds=1, part_views=4, rough_iterations=10, turned_scale=0.05
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
    """A camera whose picture moves less than this through a whole chunk, by the longer side, stands still."""
    least_side_px: int = 128
    """In pictures whose longer side is shorter than this nothing can be followed because of that."""
    least_segment: int = 8
    """Frames of a part of a chunk, besides the largest, that is worth keeping."""
