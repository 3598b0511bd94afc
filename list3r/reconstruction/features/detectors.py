"""Which learned local features there are, by name; a network is imported when it is asked for."""

from __future__ import annotations

from pathlib import Path

from list3r.memory.errors import OptionError
from list3r.reconstruction.features.learned import LearnedDetector

KINDS = ("aliked", "xfeat")


def make_detector(kind: str, weights: Path, device: str = "cpu") -> LearnedDetector:
    """The detector of that kind, aliked or xfeat. Raises `OptionError`."""
    if kind == "aliked":
        from list3r.reconstruction.features.aliked import Aliked

        return Aliked(weights, device)
    if kind == "xfeat":
        from list3r.reconstruction.features.xfeat import XFeat

        return XFeat(weights)
    raise OptionError(f"local features {kind} are not known; choose one of sift, {', '.join(KINDS)}")
