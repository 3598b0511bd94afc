"""A view as a short code for a link."""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import asdict, dataclass, fields

from list3r.memory.core.unpacking import parse_json
from list3r.viewer.world import COLOR_MODES

_LONGEST = 2000
_LARGEST = 2**63 - 1
"""Number of an instance or a session."""


@dataclass(frozen=True)
class ViewState:
    """The state that a link restores, besides the camera."""

    selected: int | None = None
    colors: str = COLOR_MODES[0]
    session: int | None = None
    points: bool = True
    labels: bool = True
    structure: bool = True
    path: bool = False
    dark: bool = False

    def encode(self) -> str:
        """Return the code."""
        usual = ViewState()
        fields = {k: v for k, v in asdict(self).items() if v != getattr(usual, k)}
        return base64.urlsafe_b64encode(json.dumps(fields, separators=(",", ":")).encode()).decode().rstrip("=")

    @staticmethod
    def decode(code: str) -> ViewState:
        """Return the view of a code; invalid parts take their defaults."""
        try:
            padded = code[:_LONGEST] + "=" * (-len(code[:_LONGEST]) % 4)
            given = parse_json(base64.urlsafe_b64decode(padded))
        except (ValueError, binascii.Error):
            return ViewState()
        if not isinstance(given, dict):
            return ViewState()
        return ViewState(
            **{f.name: given[f.name] for f in fields(ViewState) if f.name in given and _sound(f.name, given[f.name])}
        )


def _sound(name: str, value: object) -> bool:
    if name in ("selected", "session"):
        return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _LARGEST
    return value in COLOR_MODES if name == "colors" else isinstance(value, bool)
