"""Before the chunks: the camera of a source that does not say all of it, estimated once and kept in the memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from list3r.frames.base import Camera, FrameSource, SourceInfo
from list3r.frames.options import SourceOptions
from list3r.memory.core.records import SessionCamera
from list3r.memory.store.store import Store
from list3r.pipeline.chunks.chunk import get_ready, open_once
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.workers import OrderedPool
from list3r.reconstruction.registry import entry

if TYPE_CHECKING:
    from list3r.association.whole_map.video_map import VideoMap
    from list3r.pipeline.chunks.joint_windows import ChunkPool

_SILENT_ON_DISTORTION = ("images", "video", "live")
"""Kinds of source that say nothing of their lens but what the user does."""


def with_camera(
    store: Store, session: int, options: SourceOptions, estimate: Callable[[], SessionCamera | None]
) -> SourceOptions:
    """The options with the camera that was estimated for a session, for models that leave that to a stage of its own.

    It is estimated once, by `estimate`: an interrupted session goes on with the same.
    """
    before = store.sessions.get(session)
    known = before.camera or estimate()
    if known is None:
        return options
    if before.camera is None:
        with store.transaction():
            store.sessions.put(replace(before, camera=known))
    return stated_camera(options, known)


def estimated_camera(
    source: FrameSource,
    options: SourceOptions,
    settings: BuildSettings,
    look: Callable[[str, int, int], None] | None = None,
    whole: VideoMap | None = None,
    pool: ChunkPool | None = None,
) -> SessionCamera | None:
    """Return the camera of pictures as stored; None where the source or the model says it.

    `look` hears ("camera", windows of the video done, in all). Where the focal length is given and the `whole` video
    is mapped, that map tells the rest. Windows are mapped by the processes of a `pool` where there is one.
    """
    if not is_camera_wanted(source.info, options, settings):
        return None
    info = source.info
    with threadpool_limits(1):
        progress = None if look is None else (lambda done, total: look("camera", done, total))
        module = _module(settings)
        size = info.stored_size or info.image_size
        assert size is not None
        stored_px = max(size) / max(info.image_size or size)
        if whole is None:
            first = CameraWindow(source.info.path, options, settings)
            mapped = None if pool is None else (lambda spans, start: _mapped(pool, first, spans, start))
            found = module.calibrate(source, settings.models.sfm, progress, stored_px, mapped)
        else:
            found = module.calibrate_by_map(info.camera, whole.keyframes, settings.models.sfm, stored_px)
    full = found.camera.resized(*size)
    y, x = info.corner
    return SessionCamera(
        (full.fx, full.fy, full.cx + x, full.cy + y), tuple(found.camera.distortion), tuple(found.notes)
    )


def is_camera_wanted(info: SourceInfo, options: SourceOptions, settings: BuildSettings) -> bool:
    """Tell whether the model asks for more of the camera than the source says."""
    distortion_known = options.distortion is not None or info.kind not in _SILENT_ON_DISTORTION
    return bool(entry(settings.reconstruction).calibration) and not (info.camera is not None and distortion_known)


@dataclass(frozen=True)
class CameraWindow:
    """A stretch of a video by which its camera is estimated."""

    path: str
    options: SourceOptions
    settings: BuildSettings
    span: tuple[int, int] = (0, 0)
    """Positions [start, stop)."""
    start: Camera | None = None
    """The camera that its map begins with."""


def get_ready_for_camera(settings: BuildSettings) -> None:
    """Import what windows need, which takes less time than what chunks do."""
    _module(settings)


def _module(settings: BuildSettings) -> ModuleType:
    """Return the module that estimates the camera for a model."""
    return import_module(f"list3r.reconstruction.{entry(settings.reconstruction).calibration}")


def map_camera_window(window: CameraWindow) -> Any:
    """Return what the model's module makes of one window."""
    source = open_once(window.path, window.options)
    return _module(window.settings).map_window(source, *window.span, window.start, window.settings.models.sfm)


def _mapped(pool: ChunkPool, first: CameraWindow, spans: Sequence[tuple[int, int]], start: Camera) -> Iterable[Any]:
    """Map some windows in the processes of a pool, in order. The processes then import what chunks will need."""
    yield from pool.each(map_camera_window, (replace(first, span=span, start=start) for span in spans))
    if isinstance(pool, OrderedPool):
        pool.start(get_ready, first.settings)


def with_short_windows(settings: BuildSettings) -> BuildSettings:
    """Return settings by which the camera of a video of wide steps is estimated: from shorter windows, by maps that are
    adjusted less often."""
    s = settings.video_map
    before = settings.models.sfm.calibration
    mapping = replace(before.mapping, growth=s.mapping.growth, whole_rounds=s.mapping.whole_rounds)
    windows = replace(before, windows=3, frames=s.window_frames, least_frames=s.window_frames, mapping=mapping)
    sfm = replace(settings.models.sfm, calibration=windows)
    return replace(settings, models=replace(settings.models, sfm=sfm))


def stated_camera(options: SourceOptions, known: SessionCamera) -> SourceOptions:
    """The options with a camera that was estimated."""
    return replace(options, intrinsics=known.intrinsics, distortion=known.distortion)


def camera_notes(store: Store, session: int) -> tuple[str, ...]:
    """What the user should know of the camera that was estimated."""
    known = store.sessions.get(session).camera
    return () if known is None else known.notes
