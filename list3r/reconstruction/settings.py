"""Settings of every reconstruction, and of the stored parts of a chunk's frames."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.memory.core.masks import FULL_SIDE_PX
from list3r.reconstruction.base import KeyframeSpacing, SensorNoise
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.reconstruction.rgbd.settings import RgbdSettings
from list3r.reconstruction.sfm.settings import SfmSettings


@dataclass(frozen=True)
class KeyframeSettings:
    """The stored parts of a keyframe."""

    depth_width: int = 160
    """Width of the small depth image, px."""
    jpeg_quality: int = 85
    shown_share: float = 0.8
    """A further frame is kept as a picture where the others show less than this share of the surface of an instance
    that it shows; in [0, 1], with 0 keyframes alone are kept."""
    full_side_px: float = FULL_SIDE_PX
    """As in `list3r.memory.core.masks.shown_surface`."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    learned_count: int = 800
    """Most learned features on a frame."""
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class SampleSettings:
    """Which points of its frames a chunk keeps for alignment.

    Three nested grids, fixed in the picture, so that two chunks that share a frame share pixels whatever each detected:
    every fourth column and row of the finest in frames of the interior, every second in frames near the ends, which
    neighbouring chunks share, and one grid finer on small instances.
    """

    columns: int = 64
    """Columns of the finest grid."""
    rows: int = 48
    """Rows of the finest grid."""
    end_frames: int = 30
    """Frames at either end of the chunk that count as near it: the usual overlap."""
    small_share: float = 0.02
    """Share of the picture up to which a mask counts as small."""
    resolution_bits: int = 15
    """Points are rounded to 2^-bits of their extent (0.2 mm in 6 m), so that they compress."""


@dataclass(frozen=True)
class NetworkSettings:
    """How the output of a network becomes a chunk."""

    edge_step: float = 0.03
    """Depth step between neighbours that makes an edge, as a share of depth (the examples of pi3's authors)."""
    edge_confidence: float = 0.1
    """Factor of the confidence next to an edge, where a network smears one surface into the next."""
    keyframes: KeyframeSpacing = field(default_factory=KeyframeSpacing)


@dataclass(frozen=True)
class ReconstructionSettings:
    """Settings of all reconstruction models, of which one runs, and of the stored parts of every chunk."""

    rgbd: RgbdSettings = field(default_factory=RgbdSettings)
    sfm: SfmSettings = field(default_factory=SfmSettings)
    networks: NetworkSettings = field(default_factory=NetworkSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    samples: SampleSettings = field(default_factory=SampleSettings)
