"""Instances found because they changed: surfaces of one session that another session sees through.

Discovery may miss an object or segment it as part of its support. Once the object is gone, its surface is in the
keyframes of one session and carved free by those of another. Such surfaces, clustered per chunk, become local instances
of the chunk that saw them, with masks in its frames, so that merging and change detection treat them like any other.
Only surfaces that no instance of the chunk explains are added.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from list3r.frames.decoding.decode import decode_rgb
from list3r.instances.carving.carved_surfaces import (
    Bools,
    CarvedSurfaces,
    ChangedPlaceSettings,
    Ints,
    ask,
    compared,
    gone,
    lift,
)
from list3r.instances.geometric.features import object_feature
from list3r.instances.geometric.support import thin
from list3r.instances.settings import FEATURE_SPACE
from list3r.instances.tracking.reprojection import encode_labels, mask_track
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import ChunkRow, FrameRow, LocalInstance, MaskTrack, Support
from list3r.memory.library.overlap.visibility import DepthView, chunk_views
from list3r.memory.store.store import Store
from list3r.memory.store.tables.local_instances import LocalNode

__all__ = ["ChangedPlaceSettings", "add_changed_places"]


def add_changed_places(store: Store, session_id: int, settings: ChangedPlaceSettings | None = None) -> int:
    """Add local instances for changed surfaces that no instance explains; returns how many.

    Call inside a transaction, after the chunks are placed. Chunks with features of another embedding space are left
    unchanged.
    """
    s = settings or ChangedPlaceSettings()
    chunks = store.chunks.all()
    worlds = {c.component for c in chunks if c.session_id == session_id}
    near = [c for c in chunks if c.component in worlds and c.session_id <= session_id]
    if len({c.session_id for c in near}) < 2:
        return 0
    keyframes = {c.chunk_id: store.keyframes.of(c.chunk_id) for c in near}
    upright = store.facts.gravity != "unknown"
    asked: list[tuple[ChunkRow, list[DepthView], float, CarvedSurfaces]] = []
    for chunk in near:
        others = [c for c in near if c.component == chunk.component and _is(c, session_id) != _is(chunk, session_id)]
        if others and store.chunks.feature_space(chunk.chunk_id) == FEATURE_SPACE:
            unit = float(chunk.S_world_chunk.scale) if chunk.scale_kind != "metric" else 1.0
            own = chunk_views(chunk, keyframes[chunk.chunk_id], unit)
            across = [view for c in others for view in chunk_views(c, keyframes[c.chunk_id], unit)]
            asked.append((chunk, own, unit, ask(own, across, unit, s)))
    added = 0
    left = {chunk.chunk_id: gone(seen, s) for chunk, _, _, seen in asked}
    for chunk, own, unit, seen in asked:
        here = [c for c, *_ in asked if c.component == chunk.component]
        came = [left[c.chunk_id] for c in here if _is(c, session_id) != _is(chunk, session_id)]
        nodes = store.local_instances.nodes([chunk.chunk_id])
        place = _Change(left[chunk.chunk_id], came, compared(seen, s), unit, s)
        explain = [place.explains(chunk.S_world_chunk.apply(n.support.points.astype(np.float64))) for n in nodes]
        clusters = _unexplained(place, nodes, explain, chunk)
        if not clusters:
            continue
        frames = [f for f in store.frames.all(chunk.session_id) if f.chunk_id == chunk.chunk_id and f.state == "posed"]
        pictures = [decode_rgb(k.jpeg) for k in keyframes[chunk.chunk_id] if k.depth_small.size]
        maker = _Maker(chunk, list(zip(own, pictures, strict=True)), frames, unit, upright, s)
        in_chunk = unit / float(chunk.S_world_chunk.scale)
        following = store.local_instances.next_id(chunk.chunk_id)
        for cluster in clusters:
            obj = maker.make(following, cluster)
            if obj is not None:
                store.local_instances.add(chunk.chunk_id, obj)
                store.chunks.add_cannot_links(chunk.chunk_id, _mixed_with(obj, nodes, explain, in_chunk, s))
                following += 1
                added += 1
    return added


def _is(chunk: ChunkRow, session_id: int) -> bool:
    return chunk.session_id == session_id


# ------------------------------------------------------------------------------------------------- explained by


def _clusters(points: Array, unit: float, s: ChangedPlaceSettings) -> list[Ints]:
    """Rows of connected surfaces that are large enough for an object, the largest first."""
    if len(points) < s.least_cells:
        return []
    pairs = cKDTree(points).query_pairs(s.link_m * unit, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    rows = [np.flatnonzero(label == n) for n in range(int(label.max()) + 1)]
    kept = [r for r in rows if _is_object(points[r], unit, s)]
    return sorted(kept, key=lambda r: (-len(r), int(r[0])))


def _is_object(points: Array, unit: float, s: ChangedPlaceSettings) -> bool:
    sides = np.sort(np.ptp(points, axis=0))
    large = float(np.linalg.norm(sides)) > s.largest_m * unit
    return len(points) >= s.least_cells and sides[1] >= s.least_side_m * unit and not large


class _Change:
    """Changed surfaces of one chunk, world coordinates.

    `gone` are its surfaces that the other sessions see through, `came` the surfaces of others that it sees through,
    `compared` all that the others observe. Shapes (N, 3).
    """

    def __init__(
        self, gone: Array, came: Sequence[Array], compared: Array, unit: float, settings: ChangedPlaceSettings
    ) -> None:
        self.gone, self.unit, self.settings = gone, unit, settings
        self._compared = cKDTree(compared)
        self._either = cKDTree(np.concatenate([gone, *came]))

    def explains(self, support: Array) -> bool:
        """Return whether a whole instance has changed: its points are carved free or replaced by another surface.

        Two solid objects at one place share surfaces that both sessions measure, so not all of an instance must be seen
        through. An instance that extends beyond the change mixes removed and unchanged surfaces.
        """
        reach, link = 1.5 * self.settings.voxel_m * self.unit, self.settings.link_m * self.unit
        if len(support) == 0 or len(self.gone) == 0:
            return False
        near = np.asarray(self._either.query(support, distance_upper_bound=link)[0] < np.inf)
        if float(np.mean(near)) >= self.settings.explained or not near.any():
            return bool(near.any())
        known = np.asarray(self._compared.query(support, distance_upper_bound=reach)[0] < np.inf)
        return bool(known.any() and float(np.mean(near[known])) >= self.settings.explained)


def _unexplained(place: _Change, nodes: Sequence[LocalNode], explain: Sequence[bool], chunk: ChunkRow) -> list[Array]:
    """Clusters of surfaces that are gone and that no instance of the chunk explains. Shapes (N, 3)."""
    s, unit, points = place.settings, place.unit, place.gone
    clusters = _clusters(points, unit, s)
    if not clusters:
        return []
    reach = 1.5 * s.voxel_m * unit
    taken = np.zeros(len(points), bool)
    for node, does in zip(nodes, explain, strict=True):
        if does:
            support = chunk.S_world_chunk.apply(node.support.points.astype(np.float64))
            taken |= cKDTree(support).query(points, distance_upper_bound=reach)[0] < np.inf
    out = []
    for rows in clusters:
        left = rows[~taken[rows]]
        if len(left) >= (1.0 - s.explained_share) * len(rows):
            out.append(points[rows])
        else:
            out += [points[left[r]] for r in _clusters(points[left], unit, s) if len(r) >= s.part * len(rows)]
    return out


def _mixed_with(
    obj: LocalInstance, nodes: Sequence[LocalNode], explain: Sequence[bool], unit: float, s: ChangedPlaceSettings
) -> list[tuple[int, int]]:
    """Cannot-link pairs of an object with the chunk's instances that mix part of it with unchanged surfaces."""
    reach = 1.5 * s.voxel_m * unit
    out = []
    for node, does in zip(nodes, explain, strict=True):
        if does or len(node.support.points) == 0:
            continue
        covered = cKDTree(node.support.points).query(obj.support.points, distance_upper_bound=reach)[0] < np.inf
        if float(np.mean(covered)) >= s.mixed:
            out.append((node.local_id, obj.local_id))
    return out


# ------------------------------------------------------------------------------------------------------- result


class _Maker:
    """Makes local instances of clusters for one chunk."""

    def __init__(
        self,
        chunk: ChunkRow,
        shown: Sequence[tuple[DepthView, NDArray[np.uint8] | None]],
        frames: Sequence[FrameRow],
        unit: float,
        upright: bool,
        settings: ChangedPlaceSettings,
    ) -> None:
        """`shown` are the chunk's keyframes as views, with their pictures where they were kept."""
        self._chunk, self._s, self._unit = chunk, settings, unit
        self._shown, self._frames = shown, frames
        R = chunk.S_world_chunk.rotation
        self._up = R.T @ np.array([0.0, 0.0, 1.0]) if upright else np.array([0.0, -1.0, 0.0])

    def make(self, local_id: int, cluster: Array) -> LocalInstance | None:
        """Return the local instance of a cluster, or None where its keyframes show too little of it."""
        tree = cKDTree(cluster)
        reach = 1.5 * self._s.voxel_m * self._unit
        points, rgb, masks = [], [], {}
        for view, picture in self._shown:
            lifted, row, column = lift(view)
            low, high = cluster.min(axis=0) - reach, cluster.max(axis=0) + reach
            near = np.flatnonzero(((lifted > low) & (lifted < high)).all(axis=1))
            near = near[tree.query(lifted[near], distance_upper_bound=reach)[0] < np.inf] if len(near) else near
            if len(near) < self._s.least_mask_px:
                continue
            mask = np.zeros(view.depth.shape, bool)
            mask[row[near], column[near]] = True
            masks[view.frame_index] = mask
            points.append(lifted[near])
            rgb.append(_colors(picture, row[near], column[near], view.depth.shape))
        if len(masks) < 1:
            return None
        S_chunk_world = self._chunk.S_world_chunk.inverse()
        inside = S_chunk_world.apply(np.concatenate(points)).astype(np.float32)
        in_chunk = self._unit / float(self._chunk.S_world_chunk.scale)
        support = thin(inside, np.concatenate(rgb), np.ones(len(inside), np.float32), in_chunk, self._s.max_points)
        feature = object_feature(support.points, support.rgb, self._up, in_chunk)
        return LocalInstance(local_id, self._track(masks, support), feature, support, 0.8)

    def _track(self, masks: dict[int, Bools], support: Support) -> MaskTrack:
        """Masks in the keyframes, and by projection in the frames between two of them."""
        size = self._chunk.image_size
        full = {k: _fill(_enlarge(m, size)) for k, m in masks.items()}
        keys = sorted(v.frame_index for v, _ in self._shown)
        for f in self._frames:
            n = int(np.searchsorted(keys, f.frame_index))
            around = keys[max(0, n - 1) : n + 1]
            if f.frame_index not in full and len(around) == 2 and all(k in masks for k in around):
                mask = self._projected(support.points, f)
                if mask.any():
                    full[f.frame_index] = mask
        coded = {k: encode_labels(mask.astype(np.int32), 1, size)[0] for k, mask in sorted(full.items())}
        areas = np.array([m.area for m in coded.values()])
        visible = np.minimum(1.0, areas / max(float(np.quantile(areas, 0.9)), 1.0))
        return mask_track(list(coded), list(coded.values()), visible, size)

    def _projected(self, points: NDArray[np.float32], frame: FrameRow) -> Bools:
        """Mask of surface points in a frame between keyframes."""
        fx, fy, cx, cy = self._chunk.intrinsics
        height, width = self._chunk.image_size
        p = Sim3.from_matrix(frame.T_chunk_cam).inverse().apply(points.astype(np.float64))
        p = p[p[:, 2] > 1e-6]
        column = np.rint(p[:, 0] / p[:, 2] * fx + cx).astype(np.int64)
        row = np.rint(p[:, 1] / p[:, 2] * fy + cy).astype(np.int64)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        mask = np.zeros((height, width), bool)
        mask[row[inside], column[inside]] = True
        return _fill(mask)


def _colors(picture: NDArray[np.uint8] | None, row: Ints, column: Ints, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Colours at pixels of the small depth image; grey where no picture was kept. Shape (N, 3)."""
    if picture is None:
        return np.full((len(row), 3), 128, np.uint8)
    r = np.minimum(((row + 0.5) * picture.shape[0] / shape[0]).astype(np.int64), picture.shape[0] - 1)
    c = np.minimum(((column + 0.5) * picture.shape[1] / shape[1]).astype(np.int64), picture.shape[1] - 1)
    return np.asarray(picture[r, c])


def _enlarge(mask: Bools, size: tuple[int, int]) -> Bools:
    return np.asarray(cv2.resize(mask.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def _fill(mask: Bools) -> Bools:
    """Holes of a few pixels closed."""
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0)
