"""Settings of the two ways to find movers (objects that move while filmed), and of their tracks."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.reconstruction.base import SensorNoise


@dataclass(frozen=True)
class ResidualMoverSettings:
    """When a surface is a mover because it disagrees with the camera's motion."""

    least_share: float = 0.02
    """Smallest surface that is tested, share of the picture."""
    most_share: float = 0.5
    """Largest one; more than half of the picture is the static scene."""
    depth_step: float = 0.03
    """Steps of depth beyond this share of it, and beyond noise, separate surfaces."""
    suspect_m: float = 0.0025
    """Least shift of a surface by the rest, in addition to one standard deviation, for a full test."""
    suspect_stride: int = 10
    """Every n-th model point is used in the search for suspects."""
    check_stride: int = 3
    """Every n-th model point is used in the full test."""
    gray_sigma: float = 6.0
    """Standard deviation of brightness between views of one surface, grey levels."""
    truncate: float = 3.0
    """Standard deviations beyond which a pixel is an outlier."""
    gain: float = 0.05
    """Least relative gain of the cost of all pixels under the pose of the rest, though the surface itself loses,"""
    rest_gain: float = 0.4
    """or of the rest alone, whatever the surface loses."""
    contrast: float = 2.5
    """Least cost of the surface, against that of the rest, under the pose of the rest."""
    least_seen: float = 0.3
    """Share of a surface that must be comparable for a decision."""
    least_pairs: int = 20
    """Fewest compared points for a surface to count as unknown to the model."""
    trial_frames: int = 10
    """Frames after which a mover is tested again: one that stayed in place no longer moves."""


@dataclass(frozen=True)
class FreeSpaceMoverSettings:
    """When a surface is a mover because other frames see through its place."""

    width: int = 160
    """Width of the small images, px: every n-th pixel of the frame."""
    references: int = 12
    """Frames, spread evenly over the chunk, that every other frame is compared with."""
    search_step: int = 4
    """Every n-th frame and every second small pixel are searched; the rest only around findings."""
    search_frames: int = 2
    """Searched frames in which something must be found."""
    votes: int = 2
    """Frames that must have seen through a point, where more can see it."""
    clear: int = 5
    """Edge of the window, small px, in which a frame must read a surface behind: a pose may be off by half of it."""
    through_m: float = 0.04
    """Least distance behind, in metres,"""
    through_share: float = 0.02
    """in shares of the distance,"""
    through_sigma: float = 4.0
    """and in standard deviations of depth, together."""
    same_m: float = 0.02
    same_share: float = 0.01
    """Two readings within this share, and within as many standard deviations, are of one surface."""
    poses: float = 4.0
    """Multiple of the median disagreement of two frames (pose error) that is added to both."""
    near_share: float = 0.2
    """Readings further apart than this share of the distance are of two surfaces and say nothing of poses."""
    edge_share: float = 0.03
    """Steps of depth beyond this share, and beyond noise, separate surfaces."""
    least_share: float = 0.0015
    """Smallest part of the picture that is tested."""
    part: float = 0.5
    """Share of the compared pixels of a surface, or of its part not seen to stay, that must be seen through."""
    embedded: float = 0.35
    """Share of its outline that may continue a static surface without a step of depth: feet on a floor."""
    hinted: float = 0.15
    """The same for a surface that is a mover of the odometry."""
    continued: float = 0.6
    """Share of a surface that must overlap movers of the frame before, at equal depth, to continue them,"""
    surely_continued: float = 0.8
    """and of a whole surface that continues them though no frame saw through it: an object that is static."""
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class MoverTrackSettings:
    """Which movers of several frames are one object."""

    least_share: float = 0.0015
    """Smallest blob, share of the picture."""
    gap_m: float = 0.15
    """Blobs of one frame whose boxes are within this distance are one object."""
    reach_m: float = 0.25
    """Largest distance of an object from its expected position,"""
    speed_m_per_s: float = 2.5
    """and its growth for each second since it was last seen."""
    most_gap_s: float = 2.0
    """Longest time out of sight."""
    most_color: float = 45.0
    """Largest difference of mean colours, RGB."""
    min_frames: int = 5
    """Fewest frames of a mover."""
    moved_m: float = 0.1
    """Least distance between two of its positions,"""
    moved_share: float = 0.35
    """and in shares of its own width."""
    most_tracks: int = 200
    together: float = 0.6
    """Share of its frames in which a track must be next to another to be a part of the same object."""
