"""Settings that the feed-forward networks share."""

from __future__ import annotations

from dataclasses import dataclass, field

from list3r.reconstruction.base import KeyframeSpacing


@dataclass(frozen=True)
class NetworkSettings:
    """How the output of a network becomes a chunk."""

    edge_step: float = 0.03
    """Depth step between neighbours that makes an edge, as a share of depth (the examples of pi3's authors)."""
    edge_confidence: float = 0.1
    """Factor of the confidence next to an edge, where a network smears one surface into the next."""
    keyframes: KeyframeSpacing = field(default_factory=KeyframeSpacing)
