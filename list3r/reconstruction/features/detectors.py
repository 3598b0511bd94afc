"""Detectors of learned local features by name."""

from __future__ import annotations

from pathlib import Path

from list3r.memory.core.errors import OptionError
from list3r.reconstruction.features.learned import LearnedDetector

KINDS = ("aliked",)


def make_detector(kind: str, weights: Path, device: str = "auto") -> LearnedDetector:
    """Return the detector of a name, imported when it is asked for; `auto` is the CPU. Raises `OptionError`."""
    if kind not in KINDS:
        raise OptionError(f"local features {kind} are not known; choose one of sift, {', '.join(KINDS)}")
    from list3r.reconstruction.features.aliked import Aliked

    return Aliked(weights, "cpu" if device == "auto" else device)
