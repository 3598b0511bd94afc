"""Chunks to learn from: the fused views of a filmed world, with the true thing of every pixel, kept on disk."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.instances.geometric.cloud import Cloud, build_cloud
from list3r.instances.geometric.fusion import View
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.settings import InstanceSettings
from list3r.reconstruction.base import Reconstruction
from training.worlds.film import Film, FilmSettings, Truth, frames_of, make_film, reconstruction_of, varied


@dataclass(frozen=True)
class Sample:
    """One chunk of a filmed world."""

    seed: int
    sensor: str
    views: tuple[View, ...]
    """The fused anchor views."""
    ids: tuple[NDArray[np.int32], ...]
    """True thing of each pixel of each view, 0 for none. Shape (h, w) each."""
    T_chunk_cam: NDArray[np.float64]
    """Poses of all frames. Shape (F, 4, 4)."""
    things: tuple[Truth, ...]
    up: NDArray[np.float64]
    """True upward direction in the chunk. Shape (3,)."""
    computed: bool
    """True where depth was computed, not read by a sensor."""

    def cloud(self, voxel_m: float = 0.01) -> Cloud:
        """Return the chunk's cloud."""
        return build_cloud(self.views, voxel_m)

    def truth_of(self, cloud: Cloud) -> NDArray[np.int32]:
        """Return the true thing of each voxel, that of most of its pixels. Shape (N,)."""
        return voxel_truth(cloud, self.ids)


def voxel_truth(cloud: Cloud, ids: tuple[NDArray[np.int32], ...]) -> NDArray[np.int32]:
    """Return the id that most pixels of each voxel have. Shape (N,)."""
    voxel = np.concatenate([index[index >= 0] for index in cloud.index])
    thing = np.concatenate([image[index >= 0] for image, index in zip(ids, cloud.index, strict=True)])
    codes, count = np.unique(voxel.astype(np.int64) << 16 | thing, return_counts=True)
    order = np.lexsort((count, codes >> 16))
    out = np.zeros(len(cloud.keys), np.int32)
    out[codes[order] >> 16] = codes[order] & 0xFFFF
    return out


def chunk_settings(every: int = 1) -> InstanceSettings:
    """Return the usual settings of a chunk of which only every n-th frame is there: they look at the same frames."""
    usual = InstanceSettings()
    near = replace(usual.view, reach=usual.view.reach // every, step=max(1, usual.view.step // every))
    return replace(usual, anchor_step=max(1, usual.anchor_step // every), view=near)


def sample_of(film: Film, seed: int, every: int = 1, reconstruction: Reconstruction | None = None) -> Sample:
    """Return the chunk of a film, of which every n-th frame was filmed, as discovery would see it; by what its sensor
    read without a `reconstruction`.
    """
    reconstruction = reconstruction or reconstruction_of(film, seed=seed)
    views = ChunkViews(frames_of(film), reconstruction, chunk_settings(every))
    shown = tuple(views.view(p) for p in views.anchors)
    ids = tuple(film.ids[p][:: views.stride, :: views.stride].astype(np.int32) for p in views.anchors)
    poses = reconstruction.T_chunk_cam
    up = poses[0, :3, :3] @ film.T_world_cam[0, :3, :3].T @ np.array([0.0, 0.0, 1.0])
    return Sample(seed, film.sensor, shown, ids, poses, film.things, up, reconstruction.depth_noise is not None)


class Kind(TypedDict, total=False):
    """What rooms differ in besides their seed, see `FilmSettings`."""

    held_out: bool
    fitted: bool
    odd: float
    recessed: bool


def make_sample(seed: int, folder: Path, **kind: Unpack[Kind]) -> Path:
    """Make the chunk of a seed and write it, unless it is there already; return its file."""
    path = chunk_file(seed, folder, **kind)
    if not path.exists():
        settings = FilmSettings(seed, **kind)
        settings = settings if settings.held_out else varied(settings)
        sample = sample_of(make_film(settings), seed, settings.every)
        write_sample(path, sample)
    return path


def chunk_file(seed: int, folder: Path, **kind: Unpack[Kind]) -> Path:
    """Return the file of the chunk of a seed."""
    name = "".join(f"{word}-" for word in ("fitted", "odd", "recessed") if kind.get(word))
    return folder / f"{'test' if kind.get('held_out') else 'train'}-{name}{seed:06d}.npz"


def write_sample(path: Path, sample: Sample) -> None:
    """Write a chunk; a file is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = {
        "seed": sample.seed,
        "sensor": sample.sensor,
        "computed": sample.computed,
        "up": sample.up.tolist(),
        "camera": asdict(sample.views[0].camera),
        "positions": [v.position for v in sample.views],
        "things": [asdict(t) for t in sample.things],
    }
    new = path.with_suffix(".new.npz")
    np.savez(
        new,
        head=np.frombuffer(json.dumps(head).encode(), np.uint8),
        poses=sample.T_chunk_cam,
        view_poses=np.stack([v.T_chunk_cam for v in sample.views]),
        depth=np.stack([v.depth for v in sample.views]),
        sigma=np.stack([v.sigma for v in sample.views]).astype(np.float16),
        reading=np.stack([v.reading for v in sample.views]).astype(np.float16),
        confirmed=np.stack([v.confirmed for v in sample.views]),
        normals=np.stack([v.normals for v in sample.views]).astype(np.float16),
        rgb=np.stack([v.rgb for v in sample.views]),
        ids=np.stack(sample.ids).astype(np.uint16),
    )
    new.replace(path)


def read_sample(path: Path) -> Sample:
    """Return a chunk that was written."""
    from list3r.reconstruction.base import backproject

    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    head = json.loads(bytes(arrays["head"]).decode())
    camera = Camera(**{**head["camera"], "distortion": tuple(head["camera"]["distortion"])})
    views = []
    for k, position in enumerate(head["positions"]):
        T, depth = arrays["view_poses"][k], arrays["depth"][k]
        points = backproject(depth, camera) @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        sigma, reading, normals = (arrays[n][k].astype(np.float32) for n in ("sigma", "reading", "normals"))
        views.append(
            View(position, T, camera, depth, sigma, reading, arrays["confirmed"][k], points, normals, arrays["rgb"][k])
        )
    ids = tuple(image.astype(np.int32) for image in arrays["ids"])
    things = tuple(Truth(**t) for t in head["things"])
    up = np.array(head["up"])
    return Sample(head["seed"], head["sensor"], tuple(views), ids, arrays["poses"], things, up, head["computed"])
