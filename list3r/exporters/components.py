"""Read the memory for exporters: one connected component, one coordinate frame at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.output import part_path
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkRow, FrameRow, Instance, Support
from list3r.memory.store.store import Store


@dataclass(frozen=True)
class Component:
    """Chunks and instances in one coordinate frame. Components are not placed against each other: do not overlay
    them."""

    id: int
    """The smallest chunk id of it."""
    main: bool
    """True for the component with the most posed frames."""
    chunks: tuple[ChunkRow, ...]
    poses: tuple[tuple[FrameRow, Sim3], ...]
    """Posed frames in the order of sessions and frames, with their S_world_cam."""
    instances: tuple[Instance, ...]
    """By id."""

    @property
    def name(self) -> str:
        """Empty for the main component, else `component_7`."""
        return "" if self.main else f"component_{self.id}"


def read_components(store: Store) -> list[Component]:
    """Return the components of a memory, the main one first; an empty memory has one empty component."""
    chunks = store.chunks.all()
    component_of = {c.chunk_id: c.component for c in chunks}
    poses = store.trajectory.poses()
    instances = store.instances.all()
    counts = dict.fromkeys([*component_of.values(), *(i.component for i in instances)], 0)
    for frame, _ in poses:
        counts[component_of[frame.chunk_id]] += 1
    order = sorted(counts, key=lambda k: (-counts[k], k)) or [0]
    return [
        Component(
            id=k,
            main=k == order[0],
            chunks=tuple(c for c in chunks if c.component == k),
            poses=tuple(p for p in poses if component_of[p[0].chunk_id] == k),
            instances=tuple(i for i in instances if i.component == k),
        )
        for k in order
    ]


def component_files(store: Store, path: str | Path) -> list[tuple[Path, Component]]:
    """Return the components, each with the file that it is written to; the main one has `path` itself."""
    return [(part_path(Path(path), component.name), component) for component in read_components(store)]


def thinned_support(store: Store, instance: Instance, limit: int | None) -> Support:
    """Return the surface points in the world, at most `limit` of them, finite; the same ones every time."""
    support = store.surfaces.of_instance(instance)
    keep = np.flatnonzero(np.isfinite(support.points).all(axis=1))
    if limit is not None and len(keep) > limit:
        keep = np.sort(np.random.default_rng(instance.id).choice(keep, limit, replace=False))
    if len(keep) == len(support.points):
        return support
    return Support(support.points[keep], support.confidence[keep], support.rgb[keep])


def point_spacing(points: NDArray[np.float32]) -> float:
    """Return width that lets neighbouring points of a surface touch: from the area that they cover on a coarse grid.

    The occupied cells of a grid with about sixteen points a cell estimate the area; `points` has shape (N, 3), N >= 1.
    """
    extent = np.sort(np.ptp(points, axis=0).astype(np.float64))[::-1]
    if not extent[0] > 0:
        return 0.01
    cell = max(np.sqrt(extent[0] * max(extent[1], extent[0] / 50) * 16 / len(points)), extent[0] / 500)
    at = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    occupied = np.unique(at @ [1 << 20, 1 << 10, 1])  # a side has 500 cells at most
    return float(np.sqrt(len(occupied) * cell**2 / len(points)))


def has_box(instance: Instance) -> bool:
    """Return whether the instance has finite geometry."""
    box = instance.box
    return bool(np.isfinite([*box.center, *box.size, *box.rotation.ravel()]).all())


def frames_per_second(frames: list[FrameRow]) -> float | None:
    """Return the median rate of one session in frames of the source per second, None where the clock says nothing."""
    known = [f for f in frames if f.state != "bad"]
    steps = np.diff([f.time_s for f in known]), np.diff([f.frame_index for f in known])
    rates = steps[1][steps[0] > 0] / steps[0][steps[0] > 0]
    return float(np.median(rates)) if len(rates) else None
