"""All that is stored of the surfaces of a scene: the support points of instances, and the depth of pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.masks import decode_mask
from list3r.memory.core.records import Instance, Support
from list3r.memory.store.store import Store
from list3r.queries.pictures import KeyframePicture, decode_picture, keyframe_pictures
from list3r.queries.views.surfaces import inside_box

REST = 0
"""Stands for the id of what belongs to no instance."""
_MOST_PICTURES = 300
"""Of longer videos so many are taken, evenly: each takes about ten milliseconds."""
_CELLS = 500
"""Cells along the longest side of the scene; of the points of an instance in one of them the first is kept."""
_STEP = 0.04
"""Neighbours whose depth differs by this share lie on two surfaces; what is between them was never seen."""


def dense_surfaces(store: Store) -> dict[int, Support]:
    """Return the points that are known of each present instance, by id, and under `REST` those of no instance; world
    coordinates. Where pictures are not kept these are the support points alone.
    """
    there = {i.id: i for i in store.instances.all() if i.state != "removed" and np.isfinite(i.aabb).all()}
    out = {n: _finite(store.surfaces.of_instance(i)) for n, i in there.items()}
    pictures = keyframe_pictures(store)
    chosen = pictures[:: -(-len(pictures) // _MOST_PICTURES) or 1]
    seen = [_of_picture(store, p, there) for p in chosen]
    points, rgb, owner = (np.concatenate(part) for part in zip(_nothing(), *seen, strict=True))
    if not len(points):
        return out
    low, high = np.quantile(points, [0.01, 0.99], axis=0)  # depth far off is rare
    cell = np.floor((points - low) / max(float((high - low).max()) / _CELLS, 1e-9)).astype(np.int64)
    near = (np.abs(cell) < 2 * _CELLS).all(axis=1)
    number = ((cell + 2 * _CELLS) @ [(4 * _CELLS) ** 2, 4 * _CELLS, 1]) * (int(owner.max()) + 1) + owner
    first = np.unique(number[near], return_index=True)[1]
    kept = np.flatnonzero(near)[np.sort(first)]
    kept = kept[np.argsort(owner[kept], kind="stable")]
    ids, starts = np.unique(owner[kept], return_index=True)
    for n, part in zip(ids.tolist(), np.split(kept, starts[1:]), strict=True):
        known = out.get(n, Support(*_nothing()[:1], np.zeros(0, np.float32), np.zeros((0, 3), np.uint8)))
        out[n] = Support(
            np.concatenate([known.points, points[part]]),
            np.concatenate([known.confidence, np.ones(len(part), np.float32)]),
            np.concatenate([known.rgb, rgb[part]]),
        )
    return out


Points = tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int64]]
"""World (N, 3), colours (N, 3), ids of instances (N,)."""


def _nothing() -> Points:
    return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64)


def _finite(support: Support) -> Support:
    keep = np.isfinite(support.points).all(axis=1)
    return Support(support.points[keep], support.confidence[keep], support.rgb[keep])


def _of_picture(store: Store, picture: KeyframePicture, there: dict[int, Instance]) -> Points:
    """Return what one picture shows. Of an instance only what lies where it is now: it may have moved since."""
    keyframe = store.keyframes.get(picture.chunk_id, picture.frame_index)
    depth, (fx, fy, cx, cy) = keyframe.depth_small.astype(np.float64), keyframe.camera_small
    if not depth.any():
        return _nothing()
    rows, columns = np.nonzero(_on_one_surface(depth))
    z = depth[rows, columns]
    local = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1)
    S_world_cam = store.chunks.get(picture.chunk_id).S_world_chunk @ Sim3.from_matrix(keyframe.T_chunk_cam)
    points, image = S_world_cam.apply(local), decode_picture(keyframe.jpeg)
    rgb = image[_at(rows, depth.shape[0], image.shape[0]), _at(columns, depth.shape[1], image.shape[1])]
    height, width = picture.image_size
    v, u = _at(rows, depth.shape[0], height), _at(columns, depth.shape[1], width)
    owner, keep = np.full(len(z), REST), np.ones(len(z), bool)
    for sight in sorted(picture.sights, key=lambda s: -s.area_px):  # what is smaller lies before what is larger
        owner[decode_mask(sight.mask, (height, width))[v, u]] = sight.instance_id
    for n in np.setdiff1d(owner, REST).tolist():
        mine = np.flatnonzero(owner == n)
        keep[mine] = inside_box(points[mine], there[n]) if n in there else False
    return points[keep].astype(np.float32), rgb[keep], owner[keep]


def _at(index: NDArray[np.int64], of: int, to: int) -> NDArray[np.int64]:
    """The pixels of a picture of `to` rows at rows of one of `of`."""
    return np.minimum(((index + 0.5) * to / of).astype(np.int64), to - 1)


def _on_one_surface(depth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which pixels have depth that their four neighbours share. Shape (h, w)."""
    around = np.pad(depth, 1, mode="edge")
    beside = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    return np.asarray((depth > 0) & np.all([np.abs(n - depth) < _STEP * depth for n in beside], axis=0))
