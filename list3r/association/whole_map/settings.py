"""Settings of the map of a whole video."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.frames.chunking.chunks import ChunkSettings
from list3r.reconstruction.sfm.settings import AdjustmentSettings, FinderSettings, FramePoseSettings, MappingSettings


@dataclass(frozen=True)
class RevisitPairSettings:
    """Which frames are compared, and when a revisit is believed."""

    apart: int = 12
    """Frames (of those that are mapped) from which on it is a revisit."""
    partners: int = 6
    """Others that each is compared with because they share most by their poses,"""
    least_shared: float = 0.2
    """at least so much of the middle of the picture,"""
    most_turn_deg: float = 70.0
    """and are turned by no more;"""
    alike: int = 3
    """and others that look most alike."""
    away: float = 0.05
    """A place comes back, and counts as a loop, where between the two the camera saw no more than this share of it."""
    least_matches: int = 20
    """Fewest features that two have in common."""
    tells_scale: int = 8
    """Points that both hold, from which they tell the scale."""
    shift: tuple[float, float] = (0.15, 0.04)
    """Drift that a revisit may reveal: share of the depth, and share of the way between."""
    turn_rad: tuple[float, float] = (0.05, 0.002)
    """... of the direction: at once, and for each frame between."""
    log_scale: tuple[float, float] = (0.10, 0.004)
    """... of the logarithm of the scale."""
    pose: FramePoseSettings = field(default_factory=lambda: FramePoseSettings(least_matches=15, least_inliers=12))
    """How one is placed by what the other sees."""


@dataclass(frozen=True)
class DriftSettings:
    """Deviations of relations: share of the depth, radians, logarithm of scale."""

    step: tuple[float, float, float] = (0.004, 0.002, 0.004)
    """From a frame to the next."""
    revisit: tuple[float, float, float] = (0.01, 0.004, 0.02)
    """... and to one that sees the same."""
    gate: float = 3.0
    """A revisit that is off by this many deviations counts a quarter."""
    rounds: int = 5
    """Solutions, each with the trust that follows from the one before."""
    least_trust: float = 0.1
    """Revisits of less trust say nothing."""


@dataclass(frozen=True)
class JoiningSettings:
    """When two maps are joined."""

    partners: int = 4
    """Frames of the larger map that each of the smaller is compared with: those that look most alike,"""
    near: int = 4
    """and those so near to it in time, by frames that are mapped."""
    shift: float = 0.2
    """Relations agree up to so much, as a share of the depth,"""
    turn_rad: float = 0.1
    log_scale: float = 0.15
    least_agreeing: int = 3
    """Fewest relations that agree,"""
    least_share: float = 0.6
    """and their least share of all: what fits several places is not believed."""


@dataclass(frozen=True)
class VideoMapSettings:
    """How a whole video is mapped."""

    least_frames: int = 30
    """Shorter ones are one chunk anyhow."""
    most_frames: int = 600
    """Longer videos are mapped chunk by chunk."""
    least_flow: float = 0.043
    """Steps are wide where the picture moves so far from frame to frame, by its longer side: 0.047 in every eighth
    frame of redkitchen, 0.039 in walks at 12 frames a second."""
    least_posed: float = 0.97
    """Least share of the frames that the map must pose."""
    chunks: ChunkSettings = field(default_factory=lambda: ChunkSettings(70, 12))
    """Chunks whose poses the map tells: as many frames of others cover a tenth of the way."""
    window_frames: int = 32
    """Frames of each of three windows by which the camera is estimated before: they move as far as 100 of others."""
    features: FinderSettings = field(default_factory=lambda: FinderSettings(count=800, contrast=0.006))
    """Before a bare wall the faintest are all there is: four times the right matches of the usual contrast."""
    pair_steps: tuple[int, ...] = (1, 2, 3, 5, 8, 12)
    """Keyframes ahead of each that it is matched with: near ones carry the map along, far ones its scale."""
    least_matches: int = 20
    """Fewest corners or features that make a pair."""
    mapping: MappingSettings = field(
        default_factory=lambda: MappingSettings(
            steady=4.0,
            growth=1.7,
            whole_iterations=10,
            whole_rounds=1,
            part_iterations=6,
            settled=1e-4,
            turned_scale=0.04,
        )
    )
    """Rougher than a chunk's, since all is adjusted afterwards; grown again only where depth jumps: by 17 in a walk of
    wide turns that was bent, by 1.7 at most on redkitchen (research/colour-video 0128)."""
    joining: JoiningSettings = field(default_factory=JoiningSettings)
    """Of maps of its parts."""
    revisits: RevisitPairSettings = field(default_factory=RevisitPairSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    adjustment: AdjustmentSettings = field(default_factory=AdjustmentSettings)
