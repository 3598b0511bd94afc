"""Settings of the local instance library. Lengths are metres; a chunk without scale is measured by its depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from list3r.memory.core.errors import OptionError
from list3r.reconstruction.rgbd.settings import ConfidenceSettings

FEATURE_SPACE = "geometric-color@1/64"
"""Colour and metric shape, see `features`."""


@dataclass(frozen=True)
class DepthNoiseSettings:
    """Standard deviation of one depth reading: base + quadratic * z^2 (structured light and stereo)."""

    base_m: float = 0.0015
    quadratic_per_m: float = 0.0019


@dataclass(frozen=True)
class AnchorViewSettings:
    """How neighbouring frames are fused into an anchor's view."""

    width_px: int = 320
    """Images are worked on at about this width."""
    reach: int = 10
    """Frames on either side that are fused into an anchor."""
    step: int = 2
    """Every how many of them."""
    max_sigma_m: float = 0.05
    """Depth noisier than this (5 m away with the default noise) shows no objects and is left out,"""
    max_computed: float = 0.025
    """unless it was computed and its deviation is less than this share of depth: walls far off still bound the room."""
    noise: DepthNoiseSettings = field(default_factory=DepthNoiseSettings)


@dataclass(frozen=True)
class SegmentSettings:
    """How the fused chunk is cut into objects."""

    voxel_m: float = 0.016
    """Voxel edge of the chunk's cloud: coarser than in training, with better results (research/discovery 0176)."""
    computed_voxel_m: float = 0.01
    """The same where no sensor measured depth: larger voxels lose objects there."""

    def grain_m(self, *, sensed: bool) -> float:
        """Return the size of voxels, metres, for depth that a sensor measured or that was computed."""
        return self.voxel_m if sensed else self.computed_voxel_m


@dataclass(frozen=True)
class MaskTrackSettings:
    """How masks are followed and which tracks are kept."""

    min_frames: int = 5
    """Fewer are asked of a chunk of few frames: `short_share` of them, but never fewer than three."""
    short_share: float = 0.15
    min_share: float = 0.08
    """Of the chunk's posed frames."""
    min_stability: float = 0.4
    min_area_px: int = 60
    """Smallest mask worth keeping in a frame, pixels of a 640 x 480 image; scaled with the image."""
    cannot_link_frames: int = 3
    """Frames in which a pair must be seen side by side."""
    support_points: int = 3000

    def least_frames(self, posed: int) -> float:
        """Frames in which a track of a chunk with so many posed frames must be seen to be kept."""
        least = min(self.min_frames, max(3, math.ceil(self.short_share * posed)), posed)
        return max(least, self.min_share * posed)


@dataclass(frozen=True)
class CandidateSettings:
    """Which masks of a network become candidates."""

    min_score: float = 0.3
    """Class probability (or predicted quality) times the mean probability inside the mask."""
    max_overlap: float = 0.7
    """A mask with a larger share under better ones is redundant (the ratio that panoptic networks use)."""
    min_area_share: float = 0.0002
    """Of the picture: 60 pixels of 640 x 480."""
    flat_rms: float = 2.0
    """A mask is flat when its points are off their best plane by less than this many deviations of the noise."""

    def __post_init__(self) -> None:
        if not 0.0 < self.max_overlap <= 1.0:
            raise OptionError(f"max overlap {self.max_overlap} must be in (0, 1]")


@dataclass(frozen=True)
class SamMaskSettings:
    """Prompts of a picture, and which masks are kept."""

    points_per_side: int = 24
    """Prompts along each side of the picture (32 in the authors' generator, for larger pictures)."""
    points_at_once: int = 64
    """Prompts decoded together; halved when the device's memory does not hold them."""
    min_quality: float = 0.7
    """Predicted IoU."""
    min_stability: float = 0.85
    """IoU of the masks cut at logits of plus and minus one."""
    max_iou: float = 0.7
    """Of two masks that overlap more, the better one stays."""
    candidates: CandidateSettings = field(default_factory=CandidateSettings)

    def __post_init__(self) -> None:
        if self.points_per_side < 1:
            raise OptionError(f"points per side {self.points_per_side} must be at least 1")


@dataclass(frozen=True)
class VideoTrackerSettings:
    """How objects are followed and handed over."""

    most_live: int = 60
    """Objects followed at one time; cost and memory of a frame grow with each."""
    same_iou: float = 0.5
    """A candidate that overlaps a followed object's mask by this is a view of that object."""
    covered: float = 0.7
    """A candidate is no new object when this share of it is followed already."""

    def __post_init__(self) -> None:
        if self.most_live < 1:
            raise OptionError(f"at least 1 object must be followed, not {self.most_live}")


@dataclass(frozen=True)
class MoverInstanceSettings:
    """Views and points kept of a moving object."""

    whole: float = 0.5
    """Share of its largest mask that a view must have to show where it was last."""
    neighbours: int = 2
    """Frames on either side of that view whose points are added, moved to where it was then."""
    rest_m: float = 0.05
    """Places this near to the last one are one place of rest."""
    support_points: int = 3000
    cannot_link_frames: int = 3
    """Frames in which a pair must be seen side by side to be two objects."""
    confidence: ConfidenceSettings = field(default_factory=ConfidenceSettings)


@dataclass(frozen=True)
class LowConfidenceSettings:
    """Segments kept of objects that are not listed."""

    least_anchors: int = 2
    """Anchors that must see it, where a chunk has so many."""
    least_points: int = 10
    support_points: int = 400
    """Surface points kept of one."""


@dataclass(frozen=True)
class InstanceSettings:
    """The local instance library of a chunk."""

    anchor_step: int = 12
    """Frames from one anchor to the next; the sharpest of each run is taken (paper: at least every 50)."""
    min_score: float = 0.2
    """Prompts below this confidence are not followed."""
    view: AnchorViewSettings = field(default_factory=AnchorViewSettings)
    segment: SegmentSettings = field(default_factory=SegmentSettings)
    track: MaskTrackSettings = field(default_factory=MaskTrackSettings)
    movers: MoverInstanceSettings = field(default_factory=MoverInstanceSettings)
    low_confidence: LowConfidenceSettings = field(default_factory=LowConfidenceSettings)

    candidates: CandidateSettings = field(default_factory=CandidateSettings)
    """Of networks that detect objects."""
    sam: SamMaskSettings = field(default_factory=SamMaskSettings)
    video_tracker: VideoTrackerSettings = field(default_factory=VideoTrackerSettings)

    @property
    def feature_space(self) -> str:
        """Embedding space of the default discoverer's features, `model@revision/dim`."""
        return FEATURE_SPACE

    def __post_init__(self) -> None:
        if self.anchor_step < 1:
            raise OptionError(f"anchor step {self.anchor_step} must be at least 1 frame")
        for voxel in (self.segment.voxel_m, self.segment.computed_voxel_m):
            if not voxel > 0:
                raise OptionError(f"voxel size {voxel} m must be positive")
