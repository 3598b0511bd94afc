"""What holds for the whole of a memory."""

from __future__ import annotations

from dataclasses import dataclass

from list3r.memory.core.description.colors import Reference
from list3r.memory.store.facts import Fact


@dataclass(frozen=True)
class World:
    """What every instance of a memory is derived with."""

    unit: float
    """What a metre is in world units."""
    light: Reference
    floor_seen: bool
    """Whether the floor was seen and somebody knows which way is up; its height is found place by place."""
    upright: bool
    """Whether z is up, in the first component."""
    first: int
    """The first component."""
    chunks: int
    """Chunks when this was looked at."""
    posed: int
    """Posed frames, counted up to 80: fewer are asked of an instance in a short memory."""
    space: str
    """The embedding space of all chunks; empty where they have several."""
    sure_of_up: float = 1.0
    """What relations that need up are as sure as at most."""
    guessed: bool = False
    """Whether lengths are guessed metres."""
    upright_parts: tuple[int, ...] = ()
    """Other components in which z is up."""

    def stands(self, component: int) -> bool:
        """Return whether z is up in a component."""
        return (self.upright and component == self.first) or component in self.upright_parts


WORLD = Fact[World | None]("library", World, None)
"""What the library was derived with; None before it was."""
