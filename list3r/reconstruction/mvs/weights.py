"""The weights of the plane sweep's network, read without torch, so that a build can check them before it begins."""

from __future__ import annotations

from pathlib import Path

from list3r.weights import Float, WeightsFormat

FORMAT = WeightsFormat("the plane sweep's network", version=1)
SHIPPED = Path(__file__).with_name("weights.npz")


def read_weights(path: Path | None = None) -> dict[str, Float]:
    """Return the arrays of a file, by default the shipped one. Raises `OptionError` for an invalid file."""
    return FORMAT.read(path or SHIPPED, "make it again with training/sweep.py" if path else "install list3r again")
