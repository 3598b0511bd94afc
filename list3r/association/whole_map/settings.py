"""Settings of the map of a whole video."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.frames.chunking.chunks import ChunkSettings
from list3r.reconstruction.sfm.settings import AdjustmentSettings, FinderSettings, FramePoseSettings, MappingSettings


@dataclass(frozen=True)
class RevisitPairSettings:
    """Which frames are compared, and when a revisit is accepted."""

    apart: int = 12
    """Least distance of a revisit, in mapped frames."""
    partners: int = 6
    """Frames compared with each, those that share most by their poses,"""
    least_shared: float = 0.2
    """at least this share of the middle of the picture,"""
    most_turn_deg: float = 70.0
    """within this rotation;"""
    alike: int = 3
    """and the frames with the most similar descriptors."""
    away: float = 0.05
    """A revisit counts as a loop where the camera in between saw no more than this share of the place."""
    least_scale_points: int = 8
    """Fewest common points that determine the scale."""
    shift: tuple[float, float] = (0.15, 0.04)
    """Largest drift at a revisit: share of the depth, and share of the path between."""
    turn_rad: tuple[float, float] = (0.05, 0.002)
    """... of the direction: at once, and per frame between."""
    log_scale: tuple[float, float] = (0.10, 0.004)
    """... of the logarithm of the scale."""
    pose: FramePoseSettings = field(default_factory=lambda: FramePoseSettings(least_matches=15, least_inliers=12))
    """How one view is posed by the other's points."""


@dataclass(frozen=True)
class DriftSettings:
    """Standard deviations of relations: share of the depth, radians, log scale."""

    step: tuple[float, float, float] = (0.004, 0.002, 0.004)
    """Of a frame to the next."""
    revisit: tuple[float, float, float] = (0.01, 0.004, 0.02)
    """... and of a revisit."""
    gate: float = 3.0
    """A revisit that is off by this many deviations counts a quarter."""
    rounds: int = 5
    """Solutions, each with the trust from the one before."""
    least_trust: float = 0.1
    """Revisits of less trust are ignored."""


@dataclass(frozen=True)
class JoiningSettings:
    """When two maps are joined."""

    partners: int = 4
    """Frames of the larger map that each of the smaller is compared with: those with the most similar descriptors,"""
    near: int = 4
    """and those so near to it in time, by mapped frames."""
    shift: float = 0.2
    """Relations agree within this, as a share of the depth,"""
    turn_rad: float = 0.1
    log_scale: float = 0.15
    least_agreeing: int = 3
    """Fewest relations that agree,"""
    least_share: float = 0.6
    """and their least share of all: a relation that fits several places is rejected."""


@dataclass(frozen=True)
class VideoMapSettings:
    """How a whole video is mapped."""

    least_frames: int = 30
    """Shorter ones are one chunk anyhow."""
    most_frames: int = 600
    """Longer videos are mapped chunk by chunk."""
    least_flow: float = 0.043
    """Steps are wide where the picture moves this far from frame to frame, by its longer side: 0.047 in every eighth
    frame of redkitchen, 0.039 in walks at 12 frames a second."""
    least_posed: float = 0.97
    """Least share of the frames that the map must pose."""
    chunks: ChunkSettings = field(default_factory=lambda: ChunkSettings(70, 12))
    """Chunks with poses from the map: as many frames of other videos cover a tenth of the path."""
    window_frames: int = 32
    """Frames of each of three windows that estimate the camera before: they move as far as 100 of other videos."""
    features: FinderSettings = field(default_factory=lambda: FinderSettings(count=800, contrast=0.006))
    """In front of a bare wall there are only faint features: four times the right matches of the usual contrast."""
    pair_steps: tuple[int, ...] = (1, 2, 3, 5, 8, 12)
    """Keyframes ahead with which each is matched: near ones continue the map, far ones its scale."""
    mapping: MappingSettings = field(
        default_factory=lambda: MappingSettings(
            steady=4.0,
            growth=1.7,
            whole_iterations=10,
            whole_rounds=1,
            part_iterations=6,
            tolerance=1e-4,
            turned_scale=0.04,
        )
    )
    """Rougher than a chunk's, since all is adjusted afterwards; grown again only where depth jumps: by 17 in a deformed
    map of a walk with wide turns, by 1.7 at most on redkitchen (research/colour-video 0128)."""
    joining: JoiningSettings = field(default_factory=JoiningSettings)
    """Of maps of its parts."""
    revisits: RevisitPairSettings = field(default_factory=RevisitPairSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    adjustment: AdjustmentSettings = field(default_factory=AdjustmentSettings)
