"""All that is stored of the surfaces of a scene: triangles where depth can be fused, else points.

What was fused is kept in the user's cache, never beside the memory, under a name that tells all that it came from: what
chunks measured, where they lie, and what instances are made of. So nothing kept is ever out of date.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from dataclasses import astuple
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.records import Instance
from list3r.memory.store.derived import LruCache, cache_folder
from list3r.memory.store.store import Store
from list3r.queries.relations import unit_of
from list3r.queries.views.depth_frames import REST, depth_frames
from list3r.queries.views.fused import FusionSettings, Ints, Surface, can_fuse, fused

_MOST_FRAMES = 300
"""Where depth is not fused, points of so many keyframes are taken, evenly."""
_CELLS = 500
"""Cells along the longest side of the scene; of the points of an instance in one of them the first is kept."""
_MOST_FILES = 16
_KEPT_VERTICES = 4_000_000
"""Files in the cache, and vertices in memory, that are kept."""
_ON_M, _ASKED, _SHOWN = 0.05, 500, 0.5
"""A surface point lies on triangles that are so near. So many points of an instance are asked, and this share must lie
on its triangles."""
_VERSION = 1
"""Of what is kept; another one where the same measurements give other triangles."""


def surfaces(store: Store) -> dict[int, Surface]:
    """Return the surface of each present instance, by id, and under `REST` what is of no instance in the main
    component; world coordinates.
    """
    frames = dict.fromkeys([i.component for i in store.instances.all()], 0)
    for c in store.chunks.all():
        frames[c.component] = frames.get(c.component, 0) + c.last_frame - c.first_frame
    out: dict[int, Surface] = {}
    for component in sorted(frames, key=lambda k: (frames[k], -k)):
        out.pop(REST, None)
        out |= component_surfaces(store, component)
    return dict(sorted(out.items()))


def component_surfaces(store: Store, component: int) -> dict[int, Surface]:
    """Return the surface of each present instance of a component, by id, and under `REST` what is of none.

    Triangles where the packages of the extra `surfaces` are installed and stored depth shows it, else points.
    """
    there = [i for i in store.instances.all() if i.component == component and _present(i)]
    seen = fused_surfaces(store, component) if can_fuse() else _points(store, component)
    return {i.id: _support(store, i) for i in there if i.id not in seen} | seen


def instance_surface(store: Store, instance_id: int) -> Surface | None:
    """Return the triangles that were seen of an instance, world coordinates; open where nothing was seen.

    None where no stored depth shows it where it is now, or the extra `surfaces` is not installed. Raises
    `UnknownIdError`.
    """
    instance = store.instances.get(instance_id)
    return fused_surfaces(store, instance.component).get(instance.id)


def _present(i: Instance) -> bool:
    return bool(i.state != "removed" and np.isfinite(i.aabb).all())


def _support(store: Store, instance: Instance) -> Surface:
    support = store.surfaces.of_instance(instance)
    keep = np.isfinite(support.points).all(axis=1)
    return Surface.of_points(support.points[keep], support.rgb[keep])


# ---------------------------------------------------------------------------------------------- triangles


class _Kept(LruCache[str, dict[int, Surface]]):
    """Surfaces by the name of what they came from."""

    def __init__(self) -> None:
        super().__init__(_KEPT_VERTICES, lambda parts: sum(len(p.vertices) for p in parts.values()))


def must_fuse(store: Store) -> bool:
    """Tell whether `surfaces` has to fuse depth first, which takes from seconds to minutes."""
    return can_fuse() and not all(_file(store, k).exists() for k in {c.component for c in store.chunks.all()})


def _file(store: Store, component: int) -> Path:
    """Return where the surface of a component is kept."""
    name = store.current.get(("surface", component), lambda: _name(store, component))
    return cache_folder("surfaces") / f"{name}.npz"


def fused_surfaces(store: Store, component: int) -> dict[int, Surface]:
    """Return the triangles of each present instance of a component that stored depth shows, by id, and under `REST`
    those of none, as they are kept or made now; nothing where the extra `surfaces` is not installed.
    """
    if not can_fuse():
        return {}
    known = store.derived.of(_Kept)
    path = _file(store, component)
    found = known.get(path.name)
    if found is not None:
        return found
    read = _read(path)
    if read is None:
        read = _checked(store, component, *fused(store, component))
        _write(path, *read)
    whole, owner = read
    return known.put(path.name, {n: whole.with_faces(faces) for n, faces in _faces_of(whole, owner).items()})


def _name(store: Store, component: int) -> str:
    """Return a sum of all that the surface of a component follows from."""
    told = hashlib.sha256(repr((_VERSION, astuple(FusionSettings()))).encode())
    sums = store.chunks.checksums()
    for c in store.chunks.all():
        if c.component == component:
            told.update(repr((c.chunk_id, c.session_id, sums[c.chunk_id], store.facts.scale_kind)).encode())
            told.update(np.asarray(c.S_world_chunk.as_matrix()).tobytes())
    for o in store.observations.all():
        told.update(b"%d %d %d;" % (o.instance_id, o.chunk_id, o.local_id))
    for i in store.instances.all():
        if i.component == component:
            told.update(b"%d %d" % (i.id, _present(i)) + i.aabb.tobytes())
    return told.hexdigest()[:32]


def _checked(store: Store, component: int, whole: Surface, owner: Ints) -> tuple[Surface, Ints]:
    """Return the surface in the colours of the nearest surface points of instances where no picture is kept, and the
    owner of faces without instances of whose surface points few lie on them: stored depth hardly shows those.
    """
    from scipy.spatial import cKDTree

    reach, owner = _ON_M * unit_of(store), owner.copy()
    known = {i.id: _support(store, i) for i in store.instances.all() if i.component == component and _present(i)}
    for n, faces in _faces_of(whole, owner).items():
        if n in known and len(known[n].vertices):
            on, _, _ = whole.with_faces(faces).sampled(4 * len(faces))
            some = known[n].vertices[:: -(-len(known[n].vertices) // _ASKED)]
            if np.mean(cKDTree(on).query(some)[0] < reach) < _SHOWN:
                owner[owner == n] = REST
    chunks = [c.chunk_id for c in store.chunks.all() if c.component == component]
    if any(store.keyframes.with_picture(k) for k in chunks) or not any(len(s.vertices) for s in known.values()):
        return whole, owner
    points, rgb = (np.concatenate([getattr(s, name) for s in known.values()]) for name in ("vertices", "rgb"))
    return Surface(whole.vertices, whole.faces, rgb[cKDTree(points).query(whole.vertices)[1]]), owner


def _faces_of(whole: Surface, owner: Ints) -> dict[int, NDArray[np.int32]]:
    """Return the faces of each owner. Shape (F,)."""
    order = np.argsort(owner, kind="stable")
    ids, starts = np.unique(owner[order], return_index=True)
    return dict(zip(ids.tolist(), np.split(whole.faces[order], starts[1:]), strict=False))


def _read(path: Path) -> tuple[Surface, Ints] | None:
    """Return what is kept; None where that is nothing, or of no use."""
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        with np.load(path, allow_pickle=False) as held:
            vertices, faces, rgb, owner = (held[n] for n in ("vertices", "faces", "rgb", "owner"))
        sound = vertices.shape == rgb.shape and faces.shape == (len(owner), 3) and np.isfinite(vertices).all()
        if sound and (not len(faces) or (faces.min() >= 0 and faces.max() < len(vertices))):
            path.touch()
            return Surface(vertices.astype(np.float32), faces.astype(np.int32), rgb.astype(np.uint8)), owner
    return None


def _write(path: Path, whole: Surface, owner: Ints) -> None:
    """Keep a surface for the next that opens the memory; where that cannot be, nothing is kept."""
    new = path.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with new.open("wb") as file:
            np.savez_compressed(file, vertices=whole.vertices, faces=whole.faces, rgb=whole.rgb, owner=owner)
        new.replace(path)
        for old in sorted(path.parent.glob("*.npz"), key=lambda p: p.stat().st_mtime)[:-_MOST_FILES]:
            old.unlink()


# ---------------------------------------------------------------------------------------------- points


def _points(store: Store, component: int) -> dict[int, Surface]:
    """Return the points that pictures show of each instance, with its surface points, and under `REST` of none."""
    chunks = [c for c in store.chunks.all() if c.component == component]
    count = sum(len(store.keyframes.with_picture(c.chunk_id)) for c in chunks)
    parts: list[tuple[NDArray[np.float32], NDArray[np.uint8], Ints]] = []
    for f in depth_frames(store, component, every=-(-count // _MOST_FRAMES) or 1):
        if f.jpeg:
            seen = f.on_one_surface()
            parts.append((f.points()[seen].astype(np.float32), f.colors()[seen], f.owner[seen]))
    if not sum(len(p) for p, _, _ in parts):
        return {}
    points, rgb, owner = (np.concatenate(part) for part in zip(*parts, strict=True))
    low, high = np.quantile(points, [0.01, 0.99], axis=0)  # depth far off is rare
    cell = np.floor((points - low) / max(float((high - low).max()) / _CELLS, 1e-9)).astype(np.int64)
    near = (np.abs(cell) < 2 * _CELLS).all(axis=1)
    number = ((cell + 2 * _CELLS) @ [(4 * _CELLS) ** 2, 4 * _CELLS, 1]) * (int(owner.max()) + 1) + owner
    first = np.unique(number[near], return_index=True)[1]
    kept = np.flatnonzero(near)[np.sort(first)]
    kept = kept[np.argsort(owner[kept], kind="stable")]
    ids, starts = np.unique(owner[kept], return_index=True)
    known = {i.id: _support(store, i) for i in store.instances.all() if i.id in ids}
    out = {}
    for n, part in zip(ids.tolist(), np.split(kept, starts[1:]), strict=True):
        has = known.get(n, Surface.of_points(points[:0], rgb[:0]))
        out[n] = Surface.of_points(np.concatenate([has.vertices, points[part]]), np.concatenate([has.rgb, rgb[part]]))
    return out
