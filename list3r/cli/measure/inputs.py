"""Inputs of the eval commands: trajectories, frames, clouds, scenes and masks behind a path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.cli.common import open_memory
from list3r.cli.terminal import note
from list3r.exporters.output import is_database
from list3r.memory.core.errors import FrameError, OptionError, SourceError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from list3r.evaluation.covisibility import Covisibility
    from list3r.evaluation.point_clouds import PointCloud
    from list3r.evaluation.trajectory import Trajectory
    from list3r.frames.base import Camera
    from list3r.memory.core.geometry import Sim3
    from list3r.memory.store.store import Store

_SOURCES = (".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v", ".r3d", ".sens", ".bag", ".mcap", ".db3", ".vrs")


def is_source(path: Path) -> bool:
    """Whether a path is read as frames."""
    return path.is_dir() or path.suffix.lower() in _SOURCES


def scale_of(path: Path) -> str:
    """metric, anchored or relative for a memory; metric for anything else."""
    if not is_database(path):
        return "metric"
    with open_memory(path) as scene:
        return str(scene.store.facts.scale_kind or "relative")


# ---------------------------------------------------------------------------------------------- trajectories


def read_trajectory(path: Path) -> Trajectory:
    """The poses of a file, a memory, or a source. Says on standard error what is left out."""
    from list3r.evaluation.trajectory import read_tum

    if is_source(path):
        return _given(path)
    if is_database(path):
        return _stored(path)
    found = read_tum(path)
    for text in found.notes:
        note(f"note: {text}")
    return found


def _stored(path: Path) -> Trajectory:
    """The longest part of a memory: sessions have clocks of their own and components frames of their own."""
    import numpy as np

    from list3r.evaluation.trajectory import Trajectory

    with open_memory(path) as scene:
        parts: dict[tuple[int, int], list[Any]] = {}
        component_of = {c.chunk_id: c.component for c in scene.store.chunks.all()}
        for frame, S_world_cam in scene.store.trajectory.poses():
            parts.setdefault((frame.session_id, component_of[frame.chunk_id]), []).append((frame, S_world_cam))
        frames = scene.store.frames.all()
    if not parts:
        raise OptionError(f"{path} has no frame with a pose; finish its build with --resume")
    session, component = min(parts, key=lambda k: (-len(parts[k]), k))
    poses = sorted(parts[session, component], key=lambda p: p[0].time_s)
    total = sum(f.session_id == session for f in frames)
    if len(poses) < total or len(parts) > 1:
        others = "" if len(parts) == 1 else f"; {len(parts) - 1} other parts that were not joined to it are left out"
        note(f"note: {path.name}: {len(poses)} of {total} frames have a pose in its longest part{others}")
    matrices = np.stack([S.as_matrix() for _, S in poses])
    matrices[:, :3, :3] = np.stack([S.rotation for _, S in poses])
    return Trajectory(np.array([f.time_s for f, _ in poses]), matrices)


def _given(path: Path) -> Trajectory:
    """The poses that come with a source."""
    import numpy as np

    from list3r.evaluation.trajectory import Trajectory
    from list3r.frames.source import open_source

    poses = open_source(path).read_poses()
    if not poses:
        raise OptionError(
            f"{path} has no poses; give a trajectory file (TUM, EuRoC, KITTI), a memory, or a source with poses"
        )
    return Trajectory(np.array([time_s for _, time_s, _ in poses]), np.stack([T for _, _, T in poses]))


# ---------------------------------------------------------------------------------------------- frames with depth


@dataclass(frozen=True)
class DepthFrames:
    """Frames of a source that have depth and a pose, with fewer pixels."""

    index: NDArray[np.int64]
    """Frame.index. Shape (F,)."""
    time_s: NDArray[np.float64]
    """Shape (F,)."""
    depth: NDArray[np.float32]
    """Metres, 0 where unknown. Shape (F, h, w)."""
    T_source_cam: NDArray[np.float64]
    """Shape (F, 4, 4)."""
    camera: Camera
    """Of the thinned pictures."""


def read_depth_frames(path: Path, every: int | None, width: int) -> DepthFrames:
    """Every n-th frame (None: about 250 in all) of a source with depth and poses, at most about `width` px wide."""
    import numpy as np

    from list3r.frames.base import Frame
    from list3r.frames.options import SourceOptions
    from list3r.frames.source import open_source, require_camera

    info = open_source(path, SourceOptions(every=every or 1)).info
    if not info.has_poses or not info.has_depth:
        lacking = "poses" if not info.has_poses else "depth"
        raise OptionError(f"{path} has no {lacking}; the truth needs frames with depth and poses")
    step = every or max(1, -(-info.frame_count // 250))
    source = open_source(path, SourceOptions(every=step))
    camera = require_camera(source.info)
    stride = max(1, round(camera.width / width))
    first = stride // 2
    frames = [
        (f.index, f.time_s, f.depth[first::stride, first::stride], f.T_source_cam)
        for f in source.read(0, source.info.frame_count)
        if isinstance(f, Frame) and f.depth is not None and f.T_source_cam is not None
    ]
    if len(frames) < 2:
        raise OptionError(f"{path}: {len(frames)} frames with depth and a pose; at least 2 are needed")
    depth = np.stack([f[2] for f in frames])
    moved = replace(camera, width=camera.width - first, height=camera.height - first)
    thinned = replace(moved, cx=camera.cx - first, cy=camera.cy - first).every(stride)
    index, time_s = (np.array([f[k] for f in frames]) for k in (0, 1))
    return DepthFrames(index.astype(np.int64), time_s, depth, np.stack([f[3] for f in frames]), thinned)


def read_covisibility_of(path: Path, every: int | None) -> Covisibility:
    """Covisibility from an `.npz`, or measured on the frames of a source."""
    from list3r.evaluation.covisibility import Covisibility, covisibility, read_covisibility

    if path.suffix.lower() == ".npz":
        return read_covisibility(path)
    frames = read_depth_frames(path, every, width=160)
    share = covisibility(frames.depth, frames.T_source_cam, frames.camera)
    return Covisibility(frames.index, frames.time_s, share)


# ---------------------------------------------------------------------------------------------- clouds


def read_points(path: Path, every: int | None = None) -> tuple[PointCloud, Trajectory | None]:
    """The cloud of a file, a memory or a source with depth and poses; with the camera's path for the last two."""
    from list3r.evaluation.point_clouds import read_cloud

    if is_source(path):
        return _fused(path, every)
    if is_database(path):
        return _remembered(path)
    return read_cloud(path), None


def _fused(path: Path, every: int | None) -> tuple[PointCloud, Trajectory]:
    import numpy as np

    from list3r.evaluation.point_clouds import PointCloud, thinned
    from list3r.evaluation.trajectory import Trajectory

    frames = read_depth_frames(path, every, width=320)
    camera = frames.camera
    row, column = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(row.shape)], axis=-1)
    parts = []
    for depth, T in zip(frames.depth, frames.T_source_cam, strict=True):
        local = (depth[..., None] * rays)[depth > 0]
        cloud = PointCloud(local @ T[:3, :3].T + T[:3, 3], None)
        parts.append(thinned(cloud, 0.01).points if len(local) else cloud.points)
    points = np.concatenate(parts)
    text = f"{len(points):,} points of the depth of {len(parts)} frames"
    return PointCloud(points, None, text), Trajectory(frames.time_s, frames.T_source_cam)


def _remembered(path: Path) -> tuple[PointCloud, Trajectory]:
    """All supports of instances and surfaces in a memory's main part."""
    import numpy as np

    from list3r.evaluation.point_clouds import PointCloud
    from list3r.exporters.components import read_components

    with open_memory(path) as scene:
        main = read_components(scene.store)[0]
        supports = [scene.store.surfaces.of(i.id).points.astype(np.float64) for i in main.instances]
    points = np.concatenate([*supports, np.zeros((0, 3))])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise OptionError(f"{path} holds no surface point; finish its build with --resume")
    surfaces = sum(i.structure is not None for i in main.instances)
    text = f"{len(points):,} points of {len(supports) - surfaces} instances and {surfaces} surfaces"
    return PointCloud(points, None, text), _stored(path)


# ---------------------------------------------------------------------------------------------- scenes


def read_scene_of(path: Path) -> dict[str, Any]:
    """The scene JSON of a file or of a memory."""
    from list3r.evaluation.scene import read_scene
    from list3r.exporters.scene_json import scene_dict

    if not is_database(path):
        return read_scene(path)
    with open_memory(path) as scene:
        return scene_dict(scene.store)


def align_by_path(truth: Path, estimate: Path, *, free: bool) -> Sim3:
    """S_truth_estimate from the camera's path in both."""
    from list3r.evaluation.scene import alignment_of

    return alignment_of(read_trajectory(truth), read_trajectory(estimate), with_scale=free)


def mask_frames(store: Store, ids_folder: Path, every: int) -> Iterator[tuple[Any, list[tuple[int, Any]]]]:
    """True ids and the memory's masks of every n-th picture of `ids/`, which are in the order of Frame.index."""
    import numpy as np

    from list3r.frames.decoding.decode import read_raw_depth
    from list3r.memory.core.masks import decode_mask

    tracks = [
        (o.instance_id, store.local_instances.mask_track(o.chunk_id, o.local_id)) for o in store.observations.all()
    ]
    found: dict[int, dict[int, list[Any]]] = {}
    for instance_id, track in tracks:
        for frame, mask in zip(track.frames.tolist(), track.masks, strict=True):
            found.setdefault(frame, {}).setdefault(instance_id, []).append((mask, track.image_size))
    pictures = sorted(ids_folder.glob("*.png"))
    if not pictures:
        raise SourceError(f"{ids_folder} holds no pictures of true ids (.png)")
    for index in range(0, len(pictures), every):
        try:
            labels = read_raw_depth(pictures[index]).astype(np.int64)
        except FrameError as error:
            raise SourceError(f"{pictures[index]} cannot be read as a picture of ids") from error
        masks = [
            (k, np.logical_or.reduce([decode_mask(m, size) for m, size in codes]))
            for k, codes in sorted(found.get(index, {}).items())
        ]
        yield labels, masks
