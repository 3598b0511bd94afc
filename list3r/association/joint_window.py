"""Joint windows: frames of two places reconstructed together once more (paper 3.2; a loop pair shares no frame)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from list3r.memory.records import JointWindow


class JointReconstructor(Protocol):
    """Reconstructs frames of two places together, by the same model that made the chunks."""

    def __call__(
        self, u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]
    ) -> JointWindow | None:
        """The window of frames (Frame.index) of two sessions; None when its two sides cannot be related."""
        ...
