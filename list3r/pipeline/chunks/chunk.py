"""What is done to one chunk by itself: reconstruct it, find and follow its objects (paper, sections 3.1 and A.1).

A function of the chunk alone, so that chunks can be worked on side by side in any process.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.motion import flag_dynamic
from list3r.frames.base import BadFrame, Camera, Frame, FrameSource, guessed_camera
from list3r.frames.chunking.borrowing import Borrowed, Repeat, borrow, frames_around
from list3r.frames.chunking.chunks import ChunkSpan
from list3r.frames.source import SourceOptions, open_source
from list3r.instances.base import Discoverer, Tracker
from list3r.instances.library import build_library
from list3r.instances.overlays import draw_debug
from list3r.instances.registry import make_discoverer, make_frame_descriptor, make_tracker
from list3r.memory.core.errors import BaselineError, SourceError, TrackingError
from list3r.memory.core.records import ChunkResult, FrameSamples, Keyframe, LocalLibrary
from list3r.models.cache import locate
from list3r.models.device import out_of_memory_reported
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.base import Around, PosedOnly, Reconstruction, Reconstructor, WindowSide, reconstruct_jointly
from list3r.reconstruction.features.detectors import make_detector
from list3r.reconstruction.features.learned import LearnedDetector
from list3r.reconstruction.keyframe_record import FrameDescriptor, KeyframeNetworks, frame_samples, make_keyframes
from list3r.reconstruction.registry import ModelOptions, entry, import_model, make_reconstructor


@dataclass(frozen=True)
class ChunkTask:
    """One chunk to work on."""

    path: str
    options: SourceOptions
    span: ChunkSpan
    settings: BuildSettings
    debug_dir: str | None = None
    """Folder for overlays, or None."""
    shot: tuple[int, int] | None = None
    """Positions [start, stop) of the shot that the chunk lies in, from which it may borrow frames; None for none."""
    depth_every: int = 1
    """Frames at multiples of this position in the source get depth."""
    T_map_cam: Mapping[int, NDArray[np.float64]] | None = None
    """By Frame.index, where the whole video was mapped before its chunks."""


def process_parts(task: ChunkTask, discoverer: Discoverer | None = None) -> tuple[ChunkResult, ...]:
    """Turn the frames of one chunk into poses, keyframes and local instances.

    A chunk through which the camera could not be followed falls into several parts, in order of time. The last part
    has the number of the span, so that the span is done when that part is stored. A `discoverer` stands in for the one
    that the settings name.
    """
    clock = _Clock()
    source = open_once(task.path, task.options)
    camera = source.info.camera or guessed_camera(source.info)
    read = _read(task, source)
    frames = [f for f in read if isinstance(f, Frame)]
    bad = tuple((f.index, f.reason) for f in read if isinstance(f, BadFrame))
    clock.mark("read")
    if not read:
        raise SourceError(f"{task.path} has no frame {task.span.start} any more; is it still there, and complete?")
    if not frames:
        return (_without_geometry(task, source, frames, camera, bad, clock.seconds, discoverer),)
    try:
        used, parts, repeats = reconstruct(task, source, frames, camera, _deep(task, read))
    except TrackingError as error:
        lost = _without_geometry(task, source, frames, camera, bad, clock.seconds, discoverer)
        return (replace(lost, lost_reason=str(error)),)
    clock.mark("reconstruction")
    results = []
    for number, part in enumerate(parts, start=1):
        here = set(part.frame_indices.tolist())
        last = number == len(parts)
        made = _described(task, [f for f in used if f.index in here], part, bad if last else (), clock, discoverer)
        made = _with_repeats(_with_between(made, part.between, used), repeats)
        results.append(made if last else replace(made, index=task.span.index + number * PART_STEP))
    return tuple(results)


def _read(task: ChunkTask, source: FrameSource) -> list[Frame | BadFrame]:
    """The frames of the chunk, of models that need not look at all of them some that are read when they are.

    Where one cannot be decoded all are read, so that it is known how many.
    """
    start, stop = task.span.start, task.span.stop
    if task.depth_every > 1 and entry(task.settings.reconstruction).skips:
        some = list(source.read_some(start, stop, task.depth_every))
        if not any(isinstance(frame, BadFrame) for frame in some):
            return some
    return list(source.read(start, stop))


def get_ready(settings: BuildSettings) -> None:
    """Import what chunks will need. Weights are loaded with the first chunk."""
    import_model(settings.reconstruction)
    if settings.discovery == "learned":
        import_module("list3r.instances.learned.discovery")


PART_STEP = 1_000_000
"""The n-th part of a chunk, but for the last, is numbered so much times n beyond its span."""


def reconstruct(
    task: ChunkTask, source: FrameSource, frames: Sequence[Frame], camera: Camera, deep: Collection[int] | None = None
) -> tuple[Sequence[Frame], Sequence[Reconstruction], Sequence[Repeat]]:
    """The frames that were looked at, the parts that hang together, and frames that show what one of these shows.

    Frames of the numbers `deep` get depth, with None all. Where the camera moves too little through the chunk frames
    from around it are borrowed. Raises `TrackingError`.
    """
    model = _model(task.settings, source.info.camera is not None)
    if task.T_map_cam is not None:
        return frames, [model.placed(frames, camera, task.T_map_cam)], ()  # type: ignore[attr-defined]
    parts: Sequence[Reconstruction] = ()
    failed: BaselineError | None = None
    try:
        parts = _parts(model, frames, camera, _around(task, source), deep)
    except BaselineError as error:
        failed = error
    alone = len(_posed(parts))
    borrows = hasattr(model, "parts") and not entry(task.settings.reconstruction).needs_depth
    if task.shot is not None and (failed or (borrows and 2 * alone < len(frames))):
        more = borrow(source, (task.span.start, task.span.stop), task.shot, frames, task.settings.borrowing)
        if failed or 2 * more.followed > len(frames):
            found = _borrowed_parts(task, model, more, camera, deep)
            shown = _posed(found)
            if len(shown & {f.index for f in frames}) + sum(r.shown in shown for r in more.repeats) > alone:
                return more.frames, found, more.repeats
    if failed:
        raise failed
    return frames, parts, ()


def _borrowed_parts(
    task: ChunkTask, model: Reconstructor, more: Borrowed, camera: Camera, deep: Collection[int] | None
) -> list[Reconstruction]:
    """Parts of a chunk with borrowed frames that hold a frame of its own, or what shows one."""
    if len(more.frames) <= 2 * task.settings.chunks.length:
        deep = None
    elif deep is not None:
        deep = {f.index for f in more.frames if f.index in deep or f.index not in more.own}
    try:
        return [p for p in _parts(model, more.frames, camera, None, deep) if more.own & _posed([p])]
    except TrackingError:
        return []


def _parts(
    model: Reconstructor, frames: Sequence[Frame], camera: Camera, around: Around | None, deep: Collection[int] | None
) -> Sequence[Reconstruction]:
    """All parts that hang together, from models that tell them apart; otherwise one. Raises `TrackingError`."""
    parts = getattr(model, "parts", None)
    return [model(frames, camera)] if parts is None else parts(frames, camera, around, deep)


def _posed(parts: Sequence[Reconstruction]) -> set[int]:
    """Numbers of the frames that have a pose."""
    rows: list[Reconstruction | PosedOnly] = [*parts, *(p.between for p in parts if p.between is not None)]
    return {index for row in rows for index in row.frame_indices[row.posed].tolist()}


def _deep(task: ChunkTask, read: Sequence[Frame | BadFrame]) -> set[int] | None:
    """Numbers of the frames that get depth; None for all, as where they would be few of those that can be used."""
    every = task.depth_every
    found = {f.index for k, f in enumerate(read, task.span.start) if k % every == 0 and isinstance(f, Frame)}
    return None if every == 1 or 4 * len(found) < task.settings.chunks.length else found


def _around(task: ChunkTask, source: FrameSource) -> Around | None:
    """What hands out frames from around the chunk; None where its shot is not known."""
    if task.shot is None:
        return None
    return partial(frames_around, source, (task.span.start, task.span.stop), task.shot)


def _with_repeats(result: ChunkResult, repeats: Sequence[Repeat]) -> ChunkResult:
    """The result with further frames that show what one of its frames shows, where that one is."""
    place = {index: k for k, index in enumerate(result.frame_indices.tolist())}
    rows = [(r, place[r.shown]) for r in repeats if r.shown in place]
    shown = np.array([k for _, k in rows], np.int64)
    more = PosedOnly(np.array([r.index for r, _ in rows], np.int64), result.posed[shown], result.T_chunk_cam[shown])
    return _with_frames(result, more, [r.time_s for r, _ in rows], np.full((len(rows), 4, 4), np.nan))


def _with_between(result: ChunkResult, between: PosedOnly | None, frames: Sequence[Frame]) -> ChunkResult:
    """The result with the frames of a chunk that have no depth."""
    if between is None:
        return result
    known = {f.index: f for f in frames}
    own = [known[index] for index in between.frame_indices.tolist()]
    given = _given_poses(own)
    T_source_cam = np.full((len(own), 4, 4), np.nan) if given is None else given
    return _with_frames(result, between, [f.time_s for f in own], T_source_cam)


def _with_frames(
    result: ChunkResult, more: PosedOnly, times_s: Sequence[float], T_source_cam: NDArray[np.float64]
) -> ChunkResult:
    """The result with frames of which only the pose is known; `T_source_cam` is NaN where the source says none."""
    if not len(more.frame_indices):
        return result
    indices = np.concatenate([result.frame_indices, more.frame_indices])
    order, given = np.argsort(indices), result.T_source_cam
    return replace(
        result,
        frame_indices=indices[order],
        times_s=np.concatenate([result.times_s, times_s])[order],
        posed=np.concatenate([result.posed, more.posed])[order],
        T_chunk_cam=np.concatenate([result.T_chunk_cam, more.T_chunk_cam])[order],
        T_source_cam=None if given is None else np.concatenate([given, T_source_cam])[order],
    )


def _described(
    task: ChunkTask,
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    bad: tuple[tuple[int, str], ...],
    clock: _Clock,
    discoverer: Discoverer | None,
) -> ChunkResult:
    """What is found in a reconstruction, and what is kept of it."""
    s = task.settings
    named, tracker = _instance_models(s)
    with out_of_memory_reported("what finds and follows things"):
        library = build_library(frames, reconstruction, s.instances, discoverer or named, tracker)
    clock.mark("instances")
    by = KeyframeNetworks(_detector(s), _frame_look(s))
    keyframes = make_keyframes(frames, reconstruction, s.keep_pictures, s.models.keyframes, by, library)
    samples = frame_samples(reconstruction, library, s.models.samples)
    if reconstruction.depth_noise is None:  # stereo has no depth where things move; what it sees through is error
        library = flag_dynamic(samples, library, reconstruction.camera, s.motion)
    clock.mark("keyframes")
    if task.debug_dir is not None:
        draw_debug(frames, reconstruction, library, Path(task.debug_dir) / f"chunk-{task.span.index:04d}")
    seconds = dict(clock.seconds)
    clock.seconds.clear()
    made = _result(task, frames, reconstruction, library, samples, keyframes)
    return replace(made, bad_frames=bad, seconds=seconds)


def _result(
    task: ChunkTask,
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    library: LocalLibrary,
    samples: FrameSamples,
    keyframes: tuple[Keyframe, ...],
) -> ChunkResult:
    camera = reconstruction.camera
    return ChunkResult(
        index=task.span.index,
        frame_indices=reconstruction.frame_indices,
        times_s=np.array([f.time_s for f in frames]),
        posed=reconstruction.posed,
        T_chunk_cam=reconstruction.T_chunk_cam,
        T_source_cam=_given_poses(frames),
        intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy),
        image_size=(camera.height, camera.width),
        scale_kind=reconstruction.scale_kind,
        keyframes=keyframes,
        samples=samples,
        library=library,
        bad_frames=(),
        seconds={},
        unsure=reconstruction.unsure,
    )


def _without_geometry(
    task: ChunkTask,
    source: FrameSource,
    frames: Sequence[Frame],
    camera: Camera,
    bad: tuple[tuple[int, str], ...],
    seconds: dict[str, float],
    discoverer: Discoverer | None,
) -> ChunkResult:
    """A chunk through which the camera could not be followed, or without frames: those it has are kept as lost.

    It is of the scale and the feature space of the chunks around it, so that it changes nothing for them.
    """
    count, s = len(frames), task.settings
    sensed = entry(s.reconstruction).needs_depth and source.info.has_depth
    empty = Reconstruction(
        frame_indices=np.array([f.index for f in frames], np.int64),
        posed=np.zeros(count, bool),
        T_chunk_cam=np.tile(np.eye(4), (count, 1, 1)),
        camera=camera,
        depth=np.zeros((count, camera.height, camera.width), np.float32),
        confidence=np.zeros((count, camera.height, camera.width), np.float16),
        scale_kind="metric" if sensed or s.poses == "given" else "relative",
        keyframes=np.zeros(0, np.int64),
    )
    space = (discoverer or _instance_models(s)[0]).feature_space
    library = LocalLibrary((), np.zeros((0, 2), np.int32), space)
    return replace(_result(task, frames, empty, library, FrameSamples.empty(), ()), bad_frames=bad, seconds=seconds)


def _given_poses(frames: Sequence[Frame]) -> np.ndarray | None:
    if all(f.T_source_cam is None for f in frames):
        return None
    missing = np.full((4, 4), np.nan)
    return np.stack([missing if f.T_source_cam is None else f.T_source_cam for f in frames])


def joint_model(task: ChunkTask) -> Reconstructor:
    """Return what reconstructs joint windows of frames of two places in the way of the chunks."""
    return _JointModel(task)


class _JointModel:
    """A `JointModel` that is made when the first window is asked for."""

    def __init__(self, task: ChunkTask) -> None:
        self._task = task

    def __call__(self, frames: Sequence[Frame], camera: Camera) -> Reconstruction:
        return self._made()(frames, camera)

    def joint(self, sides: Sequence[WindowSide]) -> tuple[Reconstruction, ...]:
        return reconstruct_jointly(self._made(), sides)

    def _made(self) -> Reconstructor:
        known = open_once(self._task.path, self._task.options).info.camera is not None
        return _model(replace(self._task.settings, poses="estimate"), known)


@lru_cache(maxsize=2)
def _model(settings: BuildSettings, camera_known: bool) -> Reconstructor:
    """The model, loaded once in a process."""
    s = settings
    options = ModelOptions(
        poses=s.poses,
        camera_known=camera_known,
        device=s.device,
        weights=s.weights,
        local_features=s.local_features,
        feature_weights=s.feature_weights,
        settings=s.models,
    )
    return make_reconstructor(s.reconstruction, options)


def _instance_models(settings: BuildSettings) -> tuple[Discoverer, Tracker]:
    """What finds and follows things, loaded once in a process."""
    folders = tuple((name, str(locate(weights))) for name, weights in settings.instance_weights)
    return (
        make_discoverer(settings.discovery, settings.features, folders, settings.device, settings.instances),
        make_tracker(settings.tracking, folders, settings.device, settings.instances),
    )


def _frame_look(settings: BuildSettings) -> FrameDescriptor | None:
    """What describes whole frames; None for the VLAD of their SIFT features."""
    if settings.frame_look == "local":
        return None
    folders = tuple((name, str(locate(weights))) for name, weights in settings.instance_weights)
    return make_frame_descriptor(settings.features, folders, settings.device)


@lru_cache(maxsize=2)
def _detector(settings: BuildSettings) -> LearnedDetector | None:
    """The network of the local features, loaded once in a process; None for SIFT."""
    if settings.local_features == "sift":
        return None
    return make_detector(settings.local_features, Path(settings.feature_weights or ""), settings.device)


@lru_cache(maxsize=2)
def open_once(path: str, options: SourceOptions) -> FrameSource:
    """Return a source, listed once in a process."""
    return open_source(path, options)


class _Clock:
    """CPU seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.process_time()

    def mark(self, stage: str) -> None:
        now = time.process_time()
        self.seconds[stage] = round(now - self._last, 3)
        self._last = now
