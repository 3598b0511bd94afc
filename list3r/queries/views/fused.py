"""The surface of a scene and of each instance: stored depth fused into a grid of signed distances, then triangles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import ChunkRow, Instance, Keyframe, Observation
from list3r.memory.store.store import Store
from list3r.queries.pictures import decode_picture
from list3r.queries.relations import unit_of
from list3r.queries.views.surfaces import inside_box

REST = 0
"""Stands for the id of what belongs to no instance."""
_STEP = 0.04
"""Neighbours whose depth differs by this share lie on two surfaces; what is between them was never seen."""
_GREY = 150


@dataclass(frozen=True)
class FusionSettings:
    """How depth is fused."""

    voxel_m: float = 0.02
    """Edge of a cell of the grid."""
    truncation_voxels: float = 3.0
    """Distances are kept so far before and behind a surface; what is thinner than that is one surface."""
    most_depth_m: float = 4.5
    """Depth beyond is too coarse."""
    least_weight: float = 0.9
    """Frames that must have seen a cell."""
    block: int = 8
    """Cells along a block."""


@dataclass(frozen=True)
class Surface:
    """Triangles with colours, or points alone. World coordinates."""

    vertices: NDArray[np.float32]
    """Shape (V, 3)."""
    faces: NDArray[np.int32]
    """Counter-clockwise as seen from where the camera was; none where points alone are known. Shape (F, 3)."""
    rgb: NDArray[np.uint8]
    """Of vertices, sRGB. Shape (V, 3)."""

    def part(self, chosen: NDArray[np.bool_]) -> Surface:
        """Return some of the faces with their vertices. Shape (F,)."""
        used, faces = np.unique(self.faces[chosen], return_inverse=True)
        return Surface(self.vertices[used], faces.reshape(-1, 3).astype(np.int32), self.rgb[used])


def instance_surface(store: Store, instance_id: int) -> Surface | None:
    """Return the triangles that were seen of an instance, world coordinates; open where nothing was seen.

    None where no stored depth shows it where it is now. Raises `UnknownIdError`.
    """
    instance = store.instances.get(instance_id)
    return fused_surfaces(store, instance.component).get(instance.id)


def fused_surfaces(store: Store, component: int, settings: FusionSettings | None = None) -> dict[int, Surface]:
    """Return the triangles of each present instance of a component, by id, and under `REST` those of none."""
    s, unit = settings or FusionSettings(), unit_of(store)
    frames = list(_frames(store, component))
    if not frames:
        return {}
    import open3d.core as o3c
    from open3d.t.geometry import VoxelBlockGrid

    grid = VoxelBlockGrid(
        ("tsdf", "weight", "color"), (o3c.float32,) * 3, ((1), (1), (3)), s.voxel_m * unit, s.block, 10_000
    )
    votes = []
    for frame in frames:
        frame.into(grid, s, unit)
        votes.append(frame.votes(s.voxel_m * unit))
    mesh = grid.extract_triangle_mesh(s.least_weight)
    whole = Surface(
        mesh.vertex.positions.numpy(),
        mesh.triangle.indices.numpy().astype(np.int32),
        np.round(255 * mesh.vertex.colors.numpy().clip(0, 1)).astype(np.uint8),
    )
    owner = _owners(whole.vertices, np.concatenate(votes), s.voxel_m * unit)
    of_face = np.sort(owner[whole.faces], axis=1)[:, 1]  # that of two of three, else any
    return {n: whole.part(of_face == n) for n in np.unique(of_face).tolist()}


@dataclass(frozen=True)
class DepthFrame:
    """One keyframe in the world."""

    T_world_cam: NDArray[np.float64]
    """Shape (4, 4)."""
    depth: NDArray[np.float32]
    """Along z, world units, 0 where unknown. Shape (h, w)."""
    rgb: NDArray[np.uint8]
    """Shape (h, w, 3)."""
    owner: NDArray[np.int64]
    """Ids of instances, `REST` for none. Shape (h, w)."""
    camera: tuple[float, float, float, float]
    """fx, fy, cx, cy, px."""

    def points(self) -> NDArray[np.float64]:
        """Return world coordinates of all pixels. Shape (h, w, 3)."""
        fx, fy, cx, cy = self.camera
        rows, columns = np.indices(self.depth.shape)
        local = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(self.depth.shape)], axis=2)
        local *= self.depth[..., None]
        return np.asarray(local @ self.T_world_cam[:3, :3].T + self.T_world_cam[:3, 3])

    def votes(self, cell: float) -> NDArray[np.int64]:
        """Return the cells in which pixels lie, whose they are, and how many. Shape (N, 5)."""
        seen = self.depth > 0
        where = np.floor(self.points()[seen] / cell).astype(np.int64)
        found, count = np.unique(np.column_stack([where, self.owner[seen]]), axis=0, return_counts=True)
        return np.column_stack([found, count])

    def into(self, grid: Any, s: FusionSettings, unit: float) -> None:
        """Add the depth to a grid."""
        import open3d.core as o3c
        from open3d.t.geometry import Image

        fx, fy, cx, cy = self.camera
        lens = o3c.Tensor(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
        T_cam_world = o3c.Tensor(np.linalg.inv(self.T_world_cam))
        depth, color = Image(self.depth), Image((self.rgb / 255.0).astype(np.float32))
        most = s.most_depth_m * unit
        blocks = grid.compute_unique_block_coordinates(depth, lens, T_cam_world, 1.0, most, s.truncation_voxels)
        grid.integrate(blocks, depth, color, lens, T_cam_world, 1.0, most, s.truncation_voxels)


def _owners(vertices: NDArray[np.float32], votes: NDArray[np.int64], cell: float) -> NDArray[np.int64]:
    """Return whose most pixels are that lie near each vertex. Shape (V,)."""
    from scipy.spatial import cKDTree

    rows, which = np.unique(votes[:, :4], axis=0, return_inverse=True)
    count = np.bincount(which.ravel(), votes[:, 4])
    order = np.lexsort((-count, *rows[:, :3].T[::-1]))
    rows = rows[order]
    first = np.concatenate([[True], (np.diff(rows[:, :3], axis=0) != 0).any(axis=1)])
    tree = cKDTree((rows[first, :3] + 0.5) * cell)
    return np.asarray(rows[first, 3][tree.query(vertices)[1]])


# ---------------------------------------------------------------------------------------------- frames


def _frames(store: Store, component: int) -> Iterator[DepthFrame]:
    """Yield the keyframes of a component that have depth; of those that two chunks share the first."""
    there = {i.id: i for i in store.instances.all() if i.state != "removed" and np.isfinite(i.aabb).all()}
    seen: dict[int, list[Observation]] = {}
    for o in store.observations.all():
        seen.setdefault(o.chunk_id, []).append(o)
    done: set[tuple[int, int]] = set()
    for chunk in store.chunks.all():
        if chunk.component != component:
            continue
        kept = {(chunk.session_id, k.frame_index): k for k in store.keyframes.of(chunk.chunk_id) if k.depth_small.size}
        fresh = [k for key, k in kept.items() if key not in done]
        done |= set(kept)
        masks = _masks(store, seen.get(chunk.chunk_id, []), [k.frame_index for k in fresh])
        for k in fresh:
            yield _frame(chunk, k, masks.get(k.frame_index, []), there)


Masks = list[tuple[int, int, NDArray[np.uint32]]]
"""Area, id of the instance and run-length code."""


def _masks(store: Store, seen: Sequence[Observation], frames: Sequence[int]) -> dict[int, Masks]:
    """Return the masks in some frames of a chunk of what was seen in it."""
    out: dict[int, Masks] = {}
    for o in seen:
        track = store.local_instances.mask_track(o.chunk_id, o.local_id)
        for n in np.flatnonzero(np.isin(track.frames, frames)).tolist():
            out.setdefault(int(track.frames[n]), []).append((int(track.areas_px[n]), o.instance_id, track.masks[n]))
    return out


def _frame(chunk: ChunkRow, k: Keyframe, masks: Masks, there: Mapping[int, Instance]) -> DepthFrame:
    """Return a keyframe without what is between two surfaces, or belongs to an instance that is now elsewhere."""
    S = chunk.S_world_chunk @ Sim3.from_matrix(k.T_chunk_cam)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3], T_world_cam[:3, 3] = S.rotation, S.translation
    h, w = k.depth_small.shape
    depth = np.where(_on_one_surface(k.depth_small), k.depth_small * float(S.scale), 0).astype(np.float32)
    height, width = chunk.image_size
    v = np.minimum(((np.arange(h) + 0.5) * height / h).astype(np.int64), height - 1)
    u = np.minimum(((np.arange(w) + 0.5) * width / w).astype(np.int64), width - 1)
    owner = np.full((h, w), REST, np.int64)
    for _, n, mask in sorted(masks, key=lambda m: -m[0]):  # what is smaller lies before what is larger
        owner[decode_mask(mask, (height, width))[np.ix_(v, u)]] = n
    frame = DepthFrame(T_world_cam, depth, _colors(k, (h, w)), owner, k.camera_small)
    points = frame.points()
    for n in np.setdiff1d(owner, REST).tolist():
        mine = owner == n
        here = inside_box(points[mine], there[n]) if n in there else False
        depth[mine] = np.where(here, depth[mine], 0)
    return frame


def _colors(k: Keyframe, shape: tuple[int, int]) -> NDArray[np.uint8]:
    if not k.jpeg:
        return np.full((*shape, 3), _GREY, np.uint8)
    from PIL import Image

    picture = Image.fromarray(decode_picture(k.jpeg))
    return np.asarray(picture.resize((shape[1], shape[0]), Image.Resampling.BOX))


def _on_one_surface(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which pixels have depth that their four neighbours share. Shape (h, w)."""
    around = np.pad(depth, 1, mode="edge")
    beside = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    return np.asarray((depth > 0) & np.all([np.abs(n - depth) < _STEP * depth for n in beside], axis=0))
