"""The stored depth of keyframes in the world, with its colours and whose each pixel is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import ChunkRow, Instance, Keyframe, Observation
from list3r.memory.store.store import Store
from list3r.queries.pictures import decode_picture
from list3r.queries.views.surfaces import inside_box

REST = 0
"""Stands for the id of what belongs to no instance."""
_STEP = 0.04
"""Neighbours whose depth differs by this share lie on two surfaces; what is between them was never seen."""
_GREY = 150


@dataclass(frozen=True)
class DepthFrame:
    """One keyframe in the world."""

    T_world_cam: NDArray[np.float64]
    """Shape (4, 4)."""
    depth: NDArray[np.float32]
    """Along z, world units, 0 where unknown or of an instance that is now elsewhere. Shape (h, w)."""
    owner: NDArray[np.int64]
    """Ids of instances, `REST` for none. Shape (h, w)."""
    camera: tuple[float, float, float, float]
    """fx, fy, cx, cy of `depth`, px."""
    jpeg: bytes

    def points(self) -> NDArray[np.float64]:
        """Return world coordinates of all pixels. Shape (h, w, 3)."""
        fx, fy, cx, cy = self.camera
        rows, columns = np.indices(self.depth.shape)
        rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(self.depth.shape)], axis=2)
        return np.asarray((rays * self.depth[..., None]) @ self.T_world_cam[:3, :3].T + self.T_world_cam[:3, 3])

    def colors(self, size: int = 1) -> NDArray[np.uint8]:
        """Return the picture at so many times the size of the depth; grey where none is kept. Shape (h, w, 3)."""
        h, w = size * self.depth.shape[0], size * self.depth.shape[1]
        if not self.jpeg:
            return np.full((h, w, 3), _GREY, np.uint8)
        from PIL import Image

        return np.asarray(Image.fromarray(decode_picture(self.jpeg)).resize((w, h), Image.Resampling.BOX))

    def on_one_surface(self) -> NDArray[np.bool_]:
        """Return which pixels have depth that their four neighbours share. Shape (h, w)."""
        d = np.pad(self.depth, 1, mode="edge")
        beside = (d[:-2, 1:-1], d[2:, 1:-1], d[1:-1, :-2], d[1:-1, 2:])
        return np.asarray((self.depth > 0) & np.all([_near(self.depth, n) for n in beside], axis=0))

    def twice_as_fine(self) -> NDArray[np.float32]:
        """Return depth at twice the size: between neighbours on one surface on the plane through them, elsewhere that
        of the pixel. Cells would see the steps between pixels otherwise. Shape (2 h, 2 w).
        """
        d, around = self.depth, np.pad(self.depth, 1, mode="edge")
        h, w = d.shape
        out = np.empty((2 * h, 2 * w), np.float32)
        for i, j in np.ndindex(2, 2):
            up, left = around[2 * i : 2 * i + h, 1:-1], around[1:-1, 2 * j : 2 * j + w]
            corner = around[2 * i : 2 * i + h, 2 * j : 2 * j + w]
            smooth = _near(d, up) & _near(d, left) & _near(d, corner)
            out[i::2, j::2] = np.where(smooth, (9 * d + 3 * (up + left) + corner) / 16, d)
        return out


def _near(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(a - b) < _STEP * a)


def depth_frames(store: Store, component: int, *, every: int = 1) -> Iterator[DepthFrame]:
    """Yield the keyframes of a component that have depth, or every n-th; of those that two chunks share the first."""
    there = {i.id: i for i in store.instances.all() if i.state != "removed" and np.isfinite(i.aabb).all()}
    seen: dict[int, list[Observation]] = {}
    for o in store.observations.all():
        seen.setdefault(o.chunk_id, []).append(o)
    done: set[tuple[int, int]] = set()
    for chunk in store.chunks.all():
        if chunk.component != component:
            continue
        kept = {(chunk.session_id, k.frame_index): k for k in store.keyframes.of(chunk.chunk_id) if k.depth_small.any()}
        fresh = [k for n, (key, k) in enumerate(kept.items(), len(done)) if key not in done and n % every == 0]
        done |= set(kept)
        masks = _masks(store, seen.get(chunk.chunk_id, []), [k.frame_index for k in fresh])
        for k in fresh:
            yield _frame(chunk, k, masks.get(k.frame_index, []), there)


Masks = list[tuple[int, int, NDArray[np.uint32]]]
"""Area in px, id of the instance and run-length code."""


def _masks(store: Store, seen: Sequence[Observation], frames: Sequence[int]) -> dict[int, Masks]:
    """Return the masks in some frames of a chunk of what was seen in it."""
    out: dict[int, Masks] = {}
    for o in seen:
        track = store.local_instances.mask_track(o.chunk_id, o.local_id)
        for n in np.flatnonzero(np.isin(track.frames, frames)).tolist():
            out.setdefault(int(track.frames[n]), []).append((int(track.areas_px[n]), o.instance_id, track.masks[n]))
    return out


def _frame(chunk: ChunkRow, k: Keyframe, masks: Masks, there: Mapping[int, Instance]) -> DepthFrame:
    S = chunk.S_world_chunk @ Sim3.from_matrix(k.T_chunk_cam)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3], T_world_cam[:3, 3] = S.rotation, S.translation
    depth = (k.depth_small * float(S.scale)).astype(np.float32)
    size = chunk.image_size
    row, column = (
        np.minimum((np.arange(n) + 0.5) * m / n, m - 1).astype(int) for n, m in zip(depth.shape, size, strict=True)
    )
    owner = np.full(depth.shape, REST, np.int64)
    for _, n, mask in sorted(masks, key=lambda m: -m[0]):  # what is smaller lies before what is larger
        owner[decode_mask(mask, size)[np.ix_(row, column)]] = n
    frame = DepthFrame(T_world_cam, depth, owner, k.camera_small, k.jpeg)
    points = frame.points()
    for n in np.setdiff1d(owner, REST).tolist():  # it may have moved since
        mine = owner == n
        depth[mine] *= inside_box(points[mine], there[n]) if n in there else False
    return frame
