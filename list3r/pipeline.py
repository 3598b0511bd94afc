"""From a video to a memory: the page that reads like the paper's method, and the only writer of memories.

frames -> chunks -> reconstruction + local instance library        (any process, side by side; `chunk_stage`)
       -> edges -> graph -> up -> global instance library -> store (in order, one transaction each; `mapping`)
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Self

from threadpoolctl import threadpool_limits

from list3r import __version__
from list3r.association.joint_rgbd import RgbdJointReconstructor
from list3r.calibration_stage import camera_notes, with_camera
from list3r.chunk_stage import BuildSettings, ChunkTask, joint_model, process_parts
from list3r.frames.base import SourceInfo
from list3r.frames.chunks import ChunkSpan, plan_chunks
from list3r.frames.cuts import find_cuts
from list3r.frames.source import SourceOptions, check_bad_share, open_source
from list3r.instances.registry import check_choice
from list3r.mapping import add_chunk, finish_session
from list3r.memory.codec import to_json
from list3r.memory.connection import remove_memory
from list3r.memory.errors import MemoryFileError, OptionError, TrackingError
from list3r.memory.records import ChunkResult
from list3r.memory.store import Store
from list3r.models.cards import find_card
from list3r.models.choice import pinned_weights
from list3r.reconstruction.registry import MODELS, entry
from list3r.workers import OrderedPool, default_workers

Progress = Callable[[int, int], None]
"""Called with (frames done, frames in all) at the start and after every chunk."""


@dataclass(frozen=True)
class BuildReport:
    """What a build did."""

    frames: int
    posed: int
    lost: int
    bad: int
    chunks: int
    components: int
    loops: int
    instances: int
    structure: int
    relations: int
    seconds: float
    """Wall time of this run."""
    frames_per_second: float
    """Frames of this run (a resumed build counts only what it did itself) by wall time."""
    resumed_chunks: int
    """Chunks that an earlier run had finished."""
    stage_seconds: dict[str, float]
    """CPU seconds by stage, over all runs."""
    notes: tuple[str, ...]
    """What the user should know, one sentence each."""

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def build(
    source: str | Path,
    memory: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | None = None,
    workers: int | None = None,
    resume: bool = False,
    force: bool = False,
    debug_dir: str | Path | None = None,
    progress: Progress | None = None,
    scan: Progress | None = None,
) -> BuildReport:
    """Build the memory of one video; see `list3r.build` for the arguments. `scan` hears of the look for jumps before.

    Raises `SourceError`, `MemoryFileError`, `OptionError`, `TrackingError`; then nothing half-written is left, except a
    memory with the chunks that were finished, which `resume` goes on with.
    """
    started = time.monotonic()
    options = options or SourceOptions()
    info = open_source(source, options).info
    settings = resolve_settings(settings or BuildSettings(poses="auto"), info)
    check_buildable(info, settings)
    settings = with_weights(settings)
    if workers is not None and workers < 1:
        raise OptionError(f"--workers {workers}: at least 1 process is needed")
    if debug_dir is not None:
        _make_folder(Path(debug_dir))
    with _open_target(Path(memory), info, settings, resume=resume, force=force) as target:
        session = _session(target.store, info, settings)
        spans = plan_chunks(info.frame_count, settings.chunks, _cuts(target.store, source, options, settings, scan))
        done = {c.index for c in target.store.chunks(session)}
        found = with_camera(target.store, session, source, options, settings.reconstruction, info)
        tasks = [
            ChunkTask(str(source), found, span, settings, None if debug_dir is None else str(debug_dir))
            for span in spans
            if span.index not in done
        ]
        if tasks:
            pool = OrderedPool(process_parts, min(workers or usual_workers(settings), len(tasks)))
            try:
                with threadpool_limits(1):
                    _add_all(target, session, tasks, pool, info, progress)
            finally:
                pool.stop()
        return _finish(target.store, session, info, spans, done, started)


def _cuts(
    store: Store, source: str | Path, options: SourceOptions, settings: BuildSettings, scan: Progress | None
) -> tuple[int, ...]:
    """Where the video jumps, found once; given poses know where the camera is on either side."""
    if settings.poses == "given":
        return ()
    known = store.get_value("cuts")
    if known is None:
        known = [] if store.chunks() else list(find_cuts(open_source(source, options), progress=scan))
        with store.transaction():
            store.set_value("cuts", known)
    return tuple(known)


def _add_all(
    target: _Target,
    session: int,
    tasks: list[ChunkTask],
    pool: OrderedPool[ChunkTask, tuple[ChunkResult, ...]],
    info: SourceInfo,
    progress: Progress | None,
) -> None:
    """Add the chunks in order, with one thread, so that sums do not depend on the machine."""
    joint = RgbdJointReconstructor(target.store, {session: tasks[0].options}, joint_model(tasks[0]))
    debug_dir = None if tasks[0].debug_dir is None else Path(tasks[0].debug_dir)
    bad: set[int] = {index for s, index, _ in target.store.bad_frames() if s == session}
    if progress is not None:
        progress(len(target.store.frames(session)), info.frame_count)
    known = {c.index for c in target.store.chunks(session)}
    for span, results in zip((t.span for t in tasks), pool.map(tasks), strict=True):
        bad.update(index for part in results for index, _ in part.bad_frames)
        check_bad_share(len(bad), info.frame_count)
        for part in results:
            if part.index not in known:
                add_chunk(target.store, session, part, joint, debug_dir=debug_dir)
                _note_lost(target.store, part)
        target.keep()
        if progress is not None:
            progress(span.stop, info.frame_count)


def _note_lost(store: Store, result: ChunkResult) -> None:
    """Keep why the camera could not be followed through a chunk."""
    if result.lost_reason:
        with store.transaction():
            store.set_value("lost", [*store.get_value("lost", []), result.lost_reason])


def resolve_settings(settings: BuildSettings, info: SourceInfo) -> BuildSettings:
    """Settings with `auto` replaced by what the source offers."""
    poses, reconstruction = settings.poses, settings.reconstruction
    if poses == "auto":
        poses = "given" if info.has_poses else "estimate"
    if reconstruction == "auto":
        reconstruction = "rgbd" if info.has_depth or "sfm" not in MODELS else "sfm"
    return replace(settings, poses=poses, reconstruction=reconstruction)


def check_buildable(info: SourceInfo, settings: BuildSettings) -> None:
    """Raise an error that names the fix when the source cannot be built with the settings."""
    if settings.poses not in ("given", "estimate"):
        raise OptionError(f"--poses {settings.poses} is not known; choose estimate, given or auto")
    model = entry(settings.reconstruction)
    if model.needs_depth and not info.has_depth:
        raise OptionError(
            f"{info.path} has no depth, and {settings.reconstruction} reconstructs from RGB-D only; "
            "give a folder in the 7-Scenes, TUM or Replica layout"
        )
    if model.needs_camera and info.camera is None:
        raise OptionError(f"the intrinsics of {info.path} are unknown; give --intrinsics fx,fy,cx,cy")
    if settings.poses == "given" and not info.has_poses:
        raise OptionError(f"{info.path} has no poses; use --poses estimate")
    check_choice(settings.discovery, settings.tracking, settings.features)


def with_weights(settings: BuildSettings) -> BuildSettings:
    """The settings with the weights of every network named by their commit, fetched where they are not in the cache.

    Raises `OptionError` when a package is missing or weights can be had neither from the disk nor from the hub.
    """
    known = dict(settings.instance_weights)
    for option in ("discovery", "tracking", "features"):
        name = getattr(settings, option)
        found = pinned_weights(option, name, known.get(f"{option}/{name}"))
        if found is not None:
            known[f"{option}/{name}"] = found
    weights = pinned_weights("reconstruction", settings.reconstruction, settings.weights)
    return replace(settings, weights=weights, instance_weights=tuple(sorted(known.items())))


def usual_workers(settings: BuildSettings) -> int:
    """Processes unless more are asked for: one where networks run, whose weights each process would hold once more."""
    return 1 if settings.instance_weights or find_card(settings.reconstruction, "geometry") else default_workers()


class _Target:
    """The memory being written. When nothing of worth came into it, what was there before is put back."""

    def __init__(self, store: Store, *, fresh: bool, replaced: Path | None = None) -> None:
        self.store = store
        self._fresh = fresh
        self._replaced = replaced

    def keep(self) -> None:
        """From now on the new memory stays, whatever happens."""
        self._fresh = False
        if self._replaced is not None:
            self._replaced.unlink(missing_ok=True)
            self._replaced = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.store.close()
        if kind is not None and self._fresh:
            remove_memory(self.store.path)
            if self._replaced is not None:
                self._replaced.rename(self.store.path)


def _open_target(path: Path, info: SourceInfo, settings: BuildSettings, *, resume: bool, force: bool) -> _Target:
    path = path.resolve() if path.is_symlink() else path
    if path.is_dir():
        raise MemoryFileError(f"{path} is a folder; name a file for the memory, such as {path / 'memory.l3r'}")
    if path.exists() and path.stat().st_size == 0:
        path.unlink()
    replaced = _left_aside(path)
    if not path.exists():
        return _Target(Store.create(path), fresh=True)
    if resume and not force:
        with Store.open(path) as store:
            _check_same(store, info, settings)
        return _Target(Store.open(path, writable=True), fresh=False, replaced=replaced)
    if not force:
        raise MemoryFileError(f"{path} exists already; use --resume to go on with it or --force to replace it")
    Store.open(path, writable=True).close()
    if replaced is None:
        replaced = _aside(path)
        path.rename(replaced)
    else:
        remove_memory(path)
    return _Target(Store.create(path), fresh=True, replaced=replaced)


def _aside(path: Path) -> Path:
    """Where `--force` keeps the old memory until the new one has its first chunk."""
    return path.with_name(f"{path.name}.replaced")


def _left_aside(path: Path) -> Path | None:
    """The old memory that a killed `--force` left aside: put back where no new one is, removed where it has chunks."""
    aside = _aside(path)
    if not aside.is_file():
        return None
    try:
        Store.open(aside).close()
    except MemoryFileError:
        raise MemoryFileError(f"{aside} is no memory, but has the name that --force needs; move it away") from None
    if not path.exists():
        aside.rename(path)
        return None
    with Store.open(path) as store:
        begun = bool(store.chunks())
    if begun:
        aside.unlink()
    return None if begun else aside


def _session(store: Store, info: SourceInfo, settings: BuildSettings) -> int:
    """The session to write to: a new one, or the one that a build before left unfinished."""
    sessions = store.sessions()
    if sessions:
        return sessions[0].session_id
    with store.transaction():
        store.set_value("created_by", f"list3r {__version__}")
        store.set_value("scale_kind", _scale_kind(info, settings))
        store.set_value("scale_source", _scale_source(info, settings))
        store.set_value("gravity", "unknown")
        store.set_value("poses", settings.poses)
        return store.add_session(str(Path(info.path).resolve()), info.fingerprint, asdict(settings), info.frame_count)


def _scale_kind(info: SourceInfo, settings: BuildSettings) -> str:
    """Whether a unit is a metre; sensor depth says nothing where the model does not look at it."""
    source = _scale_source(info, settings)
    return {"none": "relative", "given poses": "metric"}.get(source, info.scale_kind)


def _scale_source(info: SourceInfo, settings: BuildSettings) -> str:
    """Who says how long a unit is, as far as the source and the settings do."""
    if info.has_depth and entry(settings.reconstruction).needs_depth:
        return "sensor depth"
    return "given poses" if settings.poses == "given" else "none"


def _check_same(store: Store, info: SourceInfo, settings: BuildSettings) -> None:
    """Raise `OptionError` when a memory was begun from another source or with other settings."""
    for session in store.sessions():
        if session.fingerprint != info.fingerprint:
            raise OptionError(
                f"{store.path} was begun from {session.source} with other frames or camera options; "
                "give the same source and options to --resume, or --force to begin anew"
            )
        wanted = json.loads(to_json(asdict(settings)))
        different = sorted(k for k in wanted if session.settings.get(k) != wanted[k])
        if different:
            raise OptionError(
                f"{store.path} was begun with other settings ({', '.join(different)}); "
                "give the same ones to --resume, or --force to begin anew"
            )


def _finish(
    store: Store, session: int, info: SourceInfo, spans: list[ChunkSpan], done: set[int], started: float
) -> BuildReport:
    frames = store.frames(session)
    posed = sum(f.state == "posed" for f in frames)
    if posed == 0:
        why = store.get_value("lost", [])
        hint = "check the depth scale and intrinsics with `list3r inspect`" if info.has_depth else ""
        raise TrackingError(
            f"the camera could not be followed in any of the {len(frames)} frames of {info.path}; "
            + "; ".join(filter(None, (*why[:1], hint)))
        )
    with threadpool_limits(1):
        finish_session(store, session)
    seconds = time.monotonic() - started
    fresh = sum(s.stop - s.start for s in spans if s.index not in done)
    overlap = sum(max(0, a.stop - b.start) for a, b in pairwise(spans) if b.index not in done)
    components = len({c.component for c in store.chunks()})
    lost, bad = (sum(f.state == state for f in frames) for state in ("lost", "bad"))
    return BuildReport(
        frames=len(frames),
        posed=posed,
        lost=lost,
        bad=bad,
        chunks=len(spans),
        components=components,
        loops=sum(e.kind == "loop" and e.accepted for e in store.edges()),
        instances=len(store.instances(structure=False)),
        structure=len(store.instances(structure=True)),
        relations=len(store.relations()),
        seconds=round(seconds, 2),
        frames_per_second=round(max(0, fresh - overlap) / seconds, 2),
        resumed_chunks=len(done),
        stage_seconds={k: round(v, 2) for k, v in store.stage_seconds().items()},
        notes=_notes(store, lost, bad, components),
    )


_MOST_REASONS = 5
"""Chunks that were lost of which the report says why."""


def _notes(store: Store, lost: int, bad: int, components: int) -> tuple[str, ...]:
    notes = [line for session in store.sessions() for line in camera_notes(store, session.session_id)]
    cuts = store.get_value("cuts", [])
    if cuts:
        notes.append(f"the video jumps at frame {', '.join(str(c) for c in cuts)}; chunks end there")
    if bad:
        notes.append(f"{_count(bad, 'frame')} could not be decoded, skipped: {_listed(store)}")
    if lost and store.get_value("poses") == "given":
        notes.append(f"{_count(lost, 'frame')} came without a valid pose and are left out; --poses estimate needs none")
    elif lost:
        notes.append(f"the camera could not be followed in {_count(lost, 'frame')}; they have no pose")
    notes += store.get_value("lost", [])[:_MOST_REASONS]
    if components > 1:
        notes.append(f"the video falls into {components} parts that could not be joined; each has its own frame")
    if store.get_value("gravity") == "unknown":
        notes.append("which way is up could not be told; vertical relations (on, above, below) are left out")
    return tuple(notes)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _listed(store: Store, most: int = 5) -> str:
    rows = store.bad_frames()
    shown = ", ".join(f"{index} ({reason})" for _, index, reason in rows[:most])
    return shown + (f" and {len(rows) - most} more" if len(rows) > most else "")


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"the folder {path} cannot be made: {error.strerror}") from error
