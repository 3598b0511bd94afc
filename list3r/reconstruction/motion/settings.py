"""Settings of the two ways to find movers (what moves while it is filmed), and of their tracks."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.reconstruction.base import SensorNoise


@dataclass(frozen=True)
class ResidualMoverSettings:
    """When a surface counts as a mover because it disagrees with the motion of the camera."""

    least_share: float = 0.02
    """Smallest surface that is looked at, share of the picture."""
    most_share: float = 0.5
    """Largest one; more than half of the picture is what the camera moves against."""
    depth_step: float = 0.03
    """Steps of depth beyond this share of it, and beyond noise, part surfaces."""
    suspect_m: float = 0.0025
    """The rest must want to shift a surface by at least this, and by a standard deviation, for a closer look."""
    suspect_stride: int = 10
    """Every n-th model point takes part in the search for suspects."""
    check_stride: int = 3
    """Every n-th model point takes part in the closer look."""
    gray_sigma: float = 6.0
    """Standard deviation of brightness between views of one surface, grey levels."""
    truncate: float = 3.0
    """Standard deviations beyond which a pixel counts as plainly not explained."""
    gain: float = 0.05
    """What all pixels together must gain of their cost under the pose of the rest, though the surface itself loses."""
    rest_gain: float = 0.4
    """Or what the rest alone must gain, whatever the surface loses."""
    contrast: float = 2.5
    """Least cost of the surface, against that of the rest, under the pose of the rest."""
    least_seen: float = 0.3
    """Share of a surface that must be comparable for a verdict."""
    least_pairs: int = 20
    """Fewest compared points for a surface to count as one that the model does not know."""
    trial_frames: int = 10
    """Frames after which a mover is looked at again: one that stayed where it was moves no more."""


@dataclass(frozen=True)
class FreeSpaceMoverSettings:
    """When a surface counts as a mover because other frames see through its place."""

    width: int = 160
    """Width of the small images, px: every n-th pixel of the frame."""
    references: int = 12
    """Frames, spread evenly over the chunk, that every other frame is compared with."""
    search_step: int = 4
    """Every n-th frame and every second small pixel are searched; the rest only where something was found."""
    search_frames: int = 2
    """Searched frames in which something must be found."""
    votes: int = 2
    """Frames that must have seen through a point, where more than that have looked."""
    clear: int = 5
    """Edge of the window, small px, in which a frame must read a surface behind: a pose may be wrong by half of it."""
    through_m: float = 0.04
    """How far behind, in metres,"""
    through_share: float = 0.02
    """in shares of the distance,"""
    through_sigma: float = 4.0
    """and in standard deviations of depth, together."""
    same_m: float = 0.02
    same_share: float = 0.01
    """Two readings this near to each other, and within as many standard deviations, are of one surface."""
    poses: float = 4.0
    """Times the median disagreement of two frames, as of poses that are a little wrong, is added to both."""
    near_share: float = 0.2
    """Readings further apart than this share of the distance are of two surfaces and say nothing about poses."""
    edge_share: float = 0.03
    """Steps of depth beyond this share, and beyond noise, part surfaces."""
    least_share: float = 0.0015
    """Smallest part of the picture that is looked at."""
    part: float = 0.5
    """Share of the compared pixels of a surface, or of what of it was not seen to stay, that must be seen through."""
    embedded: float = 0.35
    """Share of its outline at which it may go on, without a step of depth, as a surface that stays: feet on a floor."""
    hinted: float = 0.15
    """The same for a surface that the odometry found to move of its own."""
    carried: float = 0.6
    """Share of a surface that must lie on what moved in the frame before, as far away, to go on with it,"""
    surely_carried: float = 0.8
    """and of a whole surface that goes on with it though nobody saw through it: a thing that stands still."""
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class MoverTrackSettings:
    """Which movers of several frames are one thing."""

    least_share: float = 0.0015
    """Smallest blob, share of the picture."""
    gap_m: float = 0.15
    """Blobs of one frame whose boxes come this near to each other are one thing."""
    reach_m: float = 0.25
    """How far from where it is expected a thing may be,"""
    speed_m_per_s: float = 2.5
    """and how much further for each second since it was last seen."""
    most_gap_s: float = 2.0
    """Longest time out of sight."""
    most_color: float = 45.0
    """Largest difference of mean colours, RGB."""
    min_frames: int = 5
    """Fewest frames of a thing that moves."""
    moved_m: float = 0.1
    """Least way between two of its places,"""
    moved_share: float = 0.35
    """and in shares of its own width."""
    most_tracks: int = 200
    together: float = 0.6
    """Share of its frames in which a track must be beside another to be part of the same thing."""
