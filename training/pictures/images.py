"""What the network on pictures sees of a fused view, and what is true of its pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.features import lab_of
from list3r.instances.geometric.fusion import View, normals_of
from list3r.reconstruction.base import backproject
from training.graphs import surroundings_of
from training.samples import Sample, read_sample

Float = NDArray[np.float32]

CHANNELS = 12
COLOUR = slice(8, 11)
"""Channels that are dropped now and then in training, so that they are not needed."""
RADIUS = 3


@dataclass(frozen=True)
class Pictures:
    """The V views of a chunk at half size, (h, w)."""

    x: Float
    """What the network sees. Shape (V, CHANNELS, h, w)."""
    median: Float
    """Median depth of each view, chunk units. Shape (V,)."""
    frames: Float
    """Rotations from the chunk into right, forward and up of each view. Shape (V, 3, 3)."""


def pictures_of(views: tuple[View, ...] | list[View], up: NDArray[np.float64]) -> Pictures:
    """Return what the network sees of the views of a chunk; nothing of it depends on the scale."""
    median = np.array([np.median(v.depth[v.depth > 0]) if (v.depth > 0).any() else 1.0 for v in views], np.float32)
    frames = np.stack([view_frame(v, up) for v in views]).astype(np.float32)
    x = np.stack([_picture(v, m, f) for v, m, f in zip(views, median, frames, strict=True)])
    return Pictures(x, median, frames)


def view_frame(view: View, up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation from the chunk into right, level forward and up. Shape (3, 3)."""
    R = view.T_chunk_cam[:3, :3]
    ahead = R[:, 2] - (R[:, 2] @ up) * up
    if np.linalg.norm(ahead) < 0.2:
        ahead = -R[:, 1] - (-R[:, 1] @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def _picture(view: View, median: float, frame: Float) -> Float:
    known = view.depth > 0
    near = np.where(known, view.depth, np.float32(1e3))
    kernel = np.ones((2 * RADIUS - 1, 2 * RADIUS - 1), np.uint8)
    low, high = cv2.erode(near, kernel), cv2.dilate(np.where(known, view.depth, np.float32(0)), kernel)
    safe = np.where(known, view.depth, np.float32(median))
    normals = view.normals @ frame.T
    eye = view.T_chunk_cam[:3, 3].astype(np.float32)
    height = ((view.points - eye) @ frame[2]) / median
    lab = lab_of(view.rgb.reshape(-1, 3).astype(np.float32)).reshape(view.rgb.shape)
    lab = (lab - np.array([lab[..., 0].mean(), 0, 0], np.float32)) / 15.0
    planes = [
        (known & view.confirmed) * 1.0,
        np.where(known, 2.0 * np.log(safe / median), 0.0),
        normals[..., 0],
        -normals[..., 1],
        normals[..., 2],
        np.where(known, height, 0.0),
        np.where(known, np.clip(np.log(safe / np.minimum(low, safe)) * 15.0, 0, 3), 0.0),
        np.where(known, np.clip(np.log(np.maximum(high, safe) / safe) * 15.0, 0, 3), 0.0),
        lab[..., 0],
        lab[..., 1],
        lab[..., 2],
        np.where(known, np.log(np.maximum(view.sigma, 1e-5) / safe * 200.0), 0.0),
    ]
    full = np.stack(planes).astype(np.float32)
    h, w = full.shape[1] // 2 * 2, full.shape[2] // 2 * 2
    blocks = full[:, :h, :w].reshape(CHANNELS, h // 2, 2, w // 2, 2)
    out = blocks.mean(axis=(2, 4))
    out[6:8] = blocks[6:8].max(axis=(2, 4))
    return out


def as_computed(view: View, rng: np.random.Generator) -> View:
    """Return the view as if its depth had been computed: bent, smooth, nearer surfaces bleeding over their edges."""
    depth = view.depth
    h, w = depth.shape
    known = depth > 0
    far = np.where(known, depth, np.float32(1e3))
    size = int(rng.integers(3, 11)) | 1
    near = cv2.erode(far, np.ones((size, size), np.uint8))
    patch = cv2.resize(rng.random((h // 24, w // 24)).astype(np.float32), (w, h))
    bled = np.where((patch < rng.uniform(0.3, 0.9)) & (far - near > 0.04 * far), near, far)
    known = bled < 1e2
    bend = cv2.resize(rng.standard_normal((6, 8)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    bled = np.where(known, bled * (1 + rng.uniform(0.002, 0.012) * bend), 0.0).astype(np.float32)
    blur = rng.uniform(0.6, 2.5)
    mass = cv2.GaussianBlur(known.astype(np.float32), (0, 0), blur)
    smooth = cv2.GaussianBlur(bled, (0, 0), blur) / np.maximum(mass, 1e-3)
    depth = np.where(known, smooth, 0.0).astype(np.float32)
    sigma = np.asarray(0.004 + 0.008 * depth, np.float32)
    T = view.T_chunk_cam
    camera_points = backproject(depth, view.camera)
    points = camera_points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    normals = normals_of(camera_points, depth, sigma) @ T[:3, :3].T.astype(np.float32)
    return replace(view, depth=depth, sigma=sigma, confirmed=known, points=points, normals=normals)


def truth_images(sample: Sample, shown: Pictures) -> tuple[NDArray[np.uint16], Float, NDArray[np.uint8]]:
    """Return ids (V, h, w), ways to the middle of the pixel's thing (V, 3, h, w; median depths) and structure."""
    structural = np.zeros(65536, bool)
    structural[[t.id for t in sample.things if t.structure]] = True
    ids = np.stack(sample.ids)
    sure = np.stack([v.confirmed for v in sample.views])
    points = np.stack([v.points for v in sample.views])
    frame = shown.frames[0]
    middle = np.full((int(ids.max()) + 1, 3), np.nan, np.float32)
    own, place = ids[sure], points[sure] @ frame.T
    order = np.argsort(own, kind="stable")
    values, start = np.unique(own[order], return_index=True)
    for value, rows in zip(values.tolist(), np.split(order, start[1:]), strict=True):
        if value > 0 and len(rows) >= 30:
            some = place[rows[:: max(1, len(rows) // 3000)]]
            middle[value] = np.quantile(some, [0.03, 0.97], axis=0).mean(axis=0) @ frame
    ways = []
    for k, view in enumerate(sample.views):
        way = (middle[ids[k]] - view.points) @ shown.frames[k].T / shown.median[k]
        way[(view.depth <= 0) | structural[ids[k]]] = np.nan
        ways.append(way[::2, ::2].transpose(2, 0, 1))
    small = ids[:, ::2, ::2]
    return small.astype(np.uint16), np.stack(ways).astype(np.float32), structural[small].astype(np.uint8)


def make_pictures(path: Path, folder: Path) -> Path:
    """Write what the network sees of a chunk, as it is and as computed depth, with its truth; return the folder."""
    out = folder / path.stem
    if (out / "way.npy").exists():
        return out
    out.mkdir(parents=True, exist_ok=True)
    sample = read_sample(path)
    up = surroundings_of(sample).up
    shown = pictures_of(sample.views, up)
    rng = np.random.default_rng([sample.seed, 29])
    other = pictures_of([as_computed(v, rng) for v in sample.views], up)
    ids, way, structure = truth_images(sample, shown)
    np.save(out / "x.npy", shown.x.astype(np.float16))
    np.save(out / "computed.npy", other.x.astype(np.float16))
    np.save(out / "ids.npy", ids)
    np.save(out / "structure.npy", structure)
    np.save(out / "way.npy", way.astype(np.float16))
    return out
