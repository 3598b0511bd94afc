"""What merging asks about local instances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.voxels import ChunkShapes, Ints


@dataclass(frozen=True)
class Nodes:
    """Local instances in one numbering, world coordinates: what merging asks about them."""

    keys: list[Key]
    start: dict[int, int]
    center: Array
    size: Array
    plane: Array
    truncated: Array
    structure: NDArray[np.bool_]
    feature: NDArray[np.float32]
    tolerance: Array
    unit: Array
    lab: Array
    low: Array
    high: Array
    """Corners of the boxes of their points, world. Shape (N, 3) each."""

    @cached_property
    def chunk(self) -> Ints:
        """The chunk of each. Shape (N,)."""
        return np.array([k for k, _ in self.keys], np.int64)

    @staticmethod
    def of(chunks: Sequence[ChunkShapes], S_world_chunk: Mapping[int, Sim3]) -> Nodes:
        keys: list[Key] = []
        start, center, size, plane, tolerance, unit, low, high = {}, [], [], [], [], [], [], []
        for c in chunks:
            lower, upper = c.spans(S_world_chunk[c.chunk_id])
            low.append(lower)
            high.append(upper)
            placed = S_world_chunk[c.chunk_id]
            start[c.chunk_id] = len(keys)
            keys += [(c.chunk_id, int(n)) for n in c.local_id]
            center.append(placed.apply(c.center))
            size.append(c.size * float(placed.scale))
            normal = c.plane[:, :3] @ placed.rotation.T
            plane.append(np.column_stack([normal, c.plane[:, 3] * float(placed.scale) - normal @ placed.translation]))
            tolerance.append(np.full(len(c.local_id), 2.0 * c.grain * float(placed.scale)))
            unit.append(np.full(len(c.local_id), c.unit * float(placed.scale)))
        features = [c.feature for c in chunks if len(c.local_id)]
        return Nodes(
            keys,
            start,
            np.concatenate(center) if center else np.zeros((0, 3)),
            np.concatenate(size) if size else np.zeros(0),
            np.concatenate(plane) if plane else np.zeros((0, 4)),
            np.concatenate([c.truncated for c in chunks]) if chunks else np.zeros(0),
            np.concatenate([c.structure for c in chunks]) if chunks else np.zeros(0, bool),
            np.concatenate(features) if features else np.zeros((0, 1), np.float32),
            np.concatenate(tolerance) if tolerance else np.zeros(0),
            np.concatenate(unit) if unit else np.zeros(0),
            np.concatenate([c.lab for c in chunks]) if chunks else np.zeros((0, 3)),
            np.concatenate(low) if low else np.zeros((0, 3)),
            np.concatenate(high) if high else np.zeros((0, 3)),
        )

    def coplanar(self, a: Ints, b: Ints, angle_deg: float) -> NDArray[np.bool_]:
        """Return whether pairs of flat nodes lie in one plane; false where one is not flat."""
        one, two = self.plane[a], self.plane[b]
        cosine = np.einsum("ij,ij->i", one[:, :3], two[:, :3])
        off_b = np.abs(np.einsum("ij,ij->i", one[:, :3], self.center[b]) + one[:, 3])
        off_a = np.abs(np.einsum("ij,ij->i", two[:, :3], self.center[a]) + two[:, 3])
        near = np.maximum(off_a, off_b) <= 2.0 * np.maximum(self.tolerance[a], self.tolerance[b])
        return np.asarray((cosine > np.cos(np.radians(angle_deg))) & near)
