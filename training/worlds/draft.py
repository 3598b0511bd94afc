"""A thing while it is built: its parts, the places where other things can rest, and the loose things on it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from training.worlds.materials import Material, Palette
from training.worlds.mesh import Mesh, Vector, join


@dataclass(frozen=True)
class Zone:
    """A level rectangle of a thing on which others can stand."""

    low: tuple[float, float]
    """Least x and y in the frame of the thing, metres."""
    high: tuple[float, float]
    z: float
    clearance: float = 1.0
    """Room above it, metres."""
    use: str = "top"
    """What is put there: top, desk, shelf, bed, seat, floor, stove."""


@dataclass
class Draft:
    """A thing that grows part by part; its frame has z up, the origin on the floor, its back towards -y."""

    rng: np.random.Generator
    palette: Palette
    parts: list[tuple[Mesh, Material]] = field(default_factory=list)
    zones: list[Zone] = field(default_factory=list)
    loose: list[tuple[str, Draft, NDArray[np.float64]]] = field(default_factory=list)
    """Things of their own that lie on it: class, draft, pose in this frame (4, 4)."""

    def add(self, mesh: Mesh, material: Material) -> None:
        """Add a part."""
        self.parts.append((mesh, material))

    def legs(
        self, size: tuple[float, float], height: float, width: float, material: Material, splay: float = 0.0
    ) -> None:
        """Add four legs under a rectangle, round or square."""
        from training.worlds.mesh import bar, rod

        round_ = self.rng.random() < 0.4
        x, y = size[0] / 2 - width, size[1] / 2 - width
        for sx in (-1, 1):
            for sy in (-1, 1):
                top: Vector = (sx * x, sy * y, height)
                foot: Vector = (sx * (x + splay), sy * (y + splay), 0.0)
                self.add(rod(foot, top, width / 2) if round_ else bar(foot, top, width, width), material)

    def child(self) -> Draft:
        """Return an empty draft for a loose thing."""
        return Draft(self.rng, self.palette)

    def lay(self, name: str, child: Draft, pose: NDArray[np.float64]) -> None:
        """Put a loose thing on this one. `pose` has shape (4, 4)."""
        self.loose.append((name, child, pose))

    def u(self, low: float, high: float) -> float:
        """Return a number between two."""
        return float(self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        """Return true in that share of cases."""
        return bool(self.rng.random() < share)

    def mesh(self) -> Mesh:
        """Return all parts as one mesh."""
        return join([mesh for mesh, _ in self.parts])

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the least and largest coordinates of its own parts. Shape (3,) each."""
        points = np.concatenate([mesh.vertices for mesh, _ in self.parts])
        return points.min(axis=0), points.max(axis=0)


def pose_of(offset: Vector, rotation: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return a rigid transform. Shape (4, 4)."""
    out = np.eye(4)
    out[:3, 3] = offset
    if rotation is not None:
        out[:3, :3] = rotation
    return out
