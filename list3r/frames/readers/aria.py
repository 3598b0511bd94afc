"""A recording of Aria glasses (`.vrs`) by their colour camera, with the poses of MPS or the depth of the Digital Twin.

Read by `projectaria-tools`. The fisheye pictures become those of an upright pinhole camera (the sensor lies on its
side). Beside the recording are looked for: `closed_loop_trajectory.csv`, also in `mps/slam/` and the like, or
`aria_trajectory.csv` of the Digital Twin, with the world's gravity, and its `depth_images.vrs` (millimetres along the
camera's axis, on the pixels of the fisheye picture).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource, SourceInfo
from list3r.frames.decoding.decode import clean_depth
from list3r.frames.folder import fingerprint
from list3r.frames.options import SourceOptions
from list3r.frames.readers.tum import MAX_PAIR_GAP_S, associate
from list3r.frames.recordings.aria_lens import AriaLens, UprightView
from list3r.frames.recordings.aria_trajectory import DeviceTrajectory, read_trajectory
from list3r.frames.recordings.axes import quarter_turns
from list3r.frames.registration.rig import WORKING_SIDES
from list3r.frames.selection import select
from list3r.memory.core.errors import FrameError, OptionError, SourceError, first_line, install_hint

COLOR, DEPTH = "214-1", "345-1"
"""Streams of the colour camera and, in a file of its own, of the Digital Twin's depth on its pixels."""
_NAMES = ("video.vrs", "recording.vrs", "main_recording.vrs", "main.vrs", "sample.vrs")
_OTHERS = ("depth_images", "segmentations", "synthetic_video")
_TRAJECTORIES = ("closed_loop_trajectory.csv", "aria_trajectory.csv", "open_loop_trajectory.csv")
_FOLDERS = (".", "mps/slam", "slam", "mps", "trajectory", "mps/trajectory", "location")
_MILLIMETRES = 1000.0
_MOST_OFF_CENTRE = 0.2


def is_recording(root: Path) -> bool:
    """Return whether a path is such a recording, or a folder that holds one."""
    return root.suffix.lower() == ".vrs" if root.is_file() else _video(root) is not None


def _video(root: Path) -> Path | None:
    """The recording in a folder: one of the usual name, or the only one."""
    found = [p for p in sorted(root.glob("*.vrs")) if not p.stem.startswith(_OTHERS)]
    usual = [p for p in found if p.name in _NAMES]
    return (usual or found)[0] if usual or len(found) == 1 else None


class AriaSource(FrameSource):
    """A `FrameSource` over one recording; nothing but its clock and its poses is kept."""

    def __init__(self, root: Path, options: SourceOptions) -> None:
        """Raises `SourceError` for what cannot be read, `OptionError` for cameras that the file itself states."""
        _check(root, options)
        path = root if root.is_file() else _video(root)
        assert path is not None
        self._path, self._options = path, options
        depth = path.with_name("depth_images.vrs")
        self._depth_path = depth if depth.is_file() and path.name == "video.vrs" else None
        provider = _opened(path, COLOR)
        times_s, size, lens = _times_s(provider, COLOR), _picture(provider, COLOR, 0).shape[:2], _lens(provider, path)
        pairs = np.stack([np.arange(len(times_s))] * 2, axis=1)
        notes = [f"colour camera and its calibration of {path.name}"]
        if self._depth_path is not None:
            pairs = associate(times_s, _times_s(_opened(self._depth_path, DEPTH), DEPTH), MAX_PAIR_GAP_S)
            notes.append(f"depth of {self._depth_path.name} for {len(pairs)} of {len(times_s)} pictures")
            if not len(pairs):
                raise SourceError(f"{self._depth_path}: no depth within 20 ms of any picture; is it of this recording?")
        self._pairs, self._times_s = pairs, times_s[pairs[:, 0]]
        self._chosen = select(self._times_s, options, root, clock=True, video=False)
        table = next(
            (path.parent / f / n for n in _TRAJECTORIES for f in _FOLDERS if (path.parent / f / n).is_file()), None
        )
        moved = None if table is None else read_trajectory(table, self._times_s)
        placed = [None if T is None else T @ lens.T_device_cam for T in (moved.T_world_device if moved else ())]
        turns = quarter_turns([T for T in placed if T is not None]) if moved and moved.upright else 1
        limit = WORKING_SIDES[self._depth_path is not None] if options.max_side is None else options.max_side
        self._view = UprightView(lens, (int(size[0]), int(size[1])), turns, limit)
        self._poses = [None if T is None else T @ self._view.T_cam_upright for T in placed] or [None] * len(pairs)
        notes += [] if table is None or moved is None else _pose_notes(table, moved, self._poses)
        self._info = self._describe(root, tuple(notes), moved)

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        color = _opened(self._path, COLOR)
        depth = None if self._depth_path is None else _opened(self._depth_path, DEPTH)
        for k in range(len(self._chosen))[start:stop:step]:
            number = int(self._chosen.starts[k])
            try:
                yield self._frame(color, depth, number)
            except FrameError as error:
                yield BadFrame(number, str(error))

    def read_poses(self) -> list[tuple[int, float, NDArray[np.float64]]]:
        numbers = [int(n) for n in self._chosen.starts]
        return [(n, float(self._times_s[n]), T) for n in numbers if (T := self._poses[n]) is not None]

    def _frame(self, color: Any, depth: Any, number: int) -> Frame:
        a, b = (int(k) for k in self._pairs[number])
        picture, z = self._view.color(_picture(color, COLOR, a)), None
        if depth is not None:
            scale = self._options.depth_scale or _MILLIMETRES
            z = self._view.depth(clean_depth(_picture(depth, DEPTH, b), scale, self._options.max_depth_m))
        return Frame(number, float(self._times_s[number]), picture, z, self._poses[number])

    def _describe(self, root: Path, notes: tuple[str, ...], moved: DeviceTrajectory | None) -> SourceInfo:
        files = [self._path] if self._depth_path is None else [self._path, self._depth_path]
        has_depth, gaps = self._depth_path is not None, np.diff(self._times_s)
        listing = [*((p.name, p.stat().st_size) for p in files), ("poses", sum(T is not None for T in self._poses))]
        return SourceInfo(
            kind="aria",
            path=str(root),
            frame_count=len(self._chosen),
            fps=float(1.0 / np.median(gaps)) if len(gaps) and np.median(gaps) > 0 else 30.0,
            camera=self._view.camera,
            has_depth=has_depth,
            has_poses=any(T is not None for T in self._poses),
            fingerprint=fingerprint("aria", listing, self._options),
            depth_scale=(self._options.depth_scale or _MILLIMETRES) if has_depth else None,
            notes=notes,
            image_size=(self._view.camera.height, self._view.camera.width),
            z_up=moved is not None and moved.upright,
            poses_drift=moved is not None and moved.drifts,
        )


def _check(root: Path, options: SourceOptions) -> None:
    reasons = {
        "--intrinsics": options.intrinsics,
        "--distortion": options.distortion,
        "--depth-intrinsics": options.depth_intrinsics,
        "--depth-to-color": options.T_color_depth,
    }
    given = [name for name, value in reasons.items() if value is not None]
    if given:
        raise OptionError(f"{root} states its own cameras; leave out {' and '.join(given)}")


def _pose_notes(table: Path, moved: DeviceTrajectory, poses: Sequence[NDArray[np.float64] | None]) -> list[str]:
    out = [f"poses of {table.name} for {sum(T is not None for T in poses)} of {len(poses)} pictures"]
    if moved.elsewhere:
        out.append(f"{moved.elsewhere} pictures have poses in another world (graph_uid), which are left out")
    if not moved.upright:
        out.append(f"{table.name} does not say where gravity points")
    return out


def _opened(path: Path, stream: str) -> Any:
    """The recording, open, with a stream of pictures. Raises `SourceError`; `OptionError` without the extra."""
    try:
        with _quiet():
            from projectaria_tools.core.data_provider import create_vrs_data_provider
            from projectaria_tools.core.stream_id import StreamId
    except ImportError:
        raise OptionError(
            f"{path} is a recording of Aria, which needs a package: {install_hint('aria')} (or, without its "
            "drawing tools: pip install --no-deps projectaria-tools)"
        ) from None
    try:
        with _quiet():
            provider = create_vrs_data_provider(str(path))
    except RuntimeError as error:
        raise SourceError(f"{path} cannot be read ({first_line(error)}); copy it again") from None
    if provider is None:
        raise SourceError(f"{path} is not a recording in VRS that can be read; is the copy complete?")
    streams = [str(s) for s in provider.get_all_streams()]
    if stream not in streams or not provider.get_num_data(StreamId(stream)):
        raise SourceError(f"{path} has no pictures in the stream {stream}; it has {', '.join(streams) or 'none'}")
    return provider


def _times_s(provider: Any, stream: str) -> NDArray[np.float64]:
    from projectaria_tools.core.sensor_data import TimeDomain
    from projectaria_tools.core.stream_id import StreamId

    return np.asarray(provider.get_timestamps_ns(StreamId(stream), TimeDomain.DEVICE_TIME), np.float64) * 1e-9


def _picture(provider: Any, stream: str, number: int) -> NDArray[Any]:
    """A picture as stored. Raises `FrameError`."""
    from projectaria_tools.core.stream_id import StreamId

    try:
        with _quiet():
            image = provider.get_image_data_by_index(StreamId(stream), number)[0]
    except RuntimeError as error:
        raise FrameError(f"picture {number} of {stream} cannot be decoded ({first_line(error)})") from None
    if not image.is_valid():
        raise FrameError(f"picture {number} of {stream} cannot be decoded")
    return np.asarray(image.to_numpy_array())


def _lens(provider: Any, path: Path) -> AriaLens:
    """The colour camera's calibration. Raises `SourceError` for none, and for one of pictures of another size."""
    device = provider.get_device_calibration()
    lens = None if device is None else device.get_camera_calib("camera-rgb")
    if lens is None:
        raise SourceError(f"{path} states no calibration of its colour camera; give the recording as it was made")
    height, width = _picture(provider, COLOR, 0).shape[:2]
    stated, centre = lens.get_image_size(), np.asarray(lens.get_principal_point())
    off = np.abs(centre / np.array([width, height]) - 0.5).max()
    if (int(stated[0]), int(stated[1])) != (width, height) or off > _MOST_OFF_CENTRE:
        raise SourceError(
            f"{path} has pictures of {width}x{height}, and a calibration for {stated[0]}x{stated[1]} with its centre "
            f"at ({centre[0]:.0f}, {centre[1]:.0f}); give the recording as it was made"
        )
    return AriaLens(lens, np.asarray(lens.get_transform_device_camera().to_matrix(), np.float64))


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what the library prints from the terminal and from answers on standard output."""
    with suppress(ValueError, OSError):
        sys.stdout.flush()
    kept = [os.dup(1), os.dup(2)]
    nothing = os.open(os.devnull, os.O_WRONLY)
    try:
        for descriptor in (1, 2):
            os.dup2(nothing, descriptor)
        yield
    finally:
        for descriptor, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(nothing)
