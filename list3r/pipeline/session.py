"""What a build and an update do alike: make the settings definite, plan a session's chunks, add them in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

from list3r.frames.base import FrameSource, SourceInfo
from list3r.frames.chunking.chunks import ChunkSpan, plan_chunks, shot_of
from list3r.frames.chunking.cuts import find_cuts
from list3r.frames.chunking.pace import PaceSettings, depth_step
from list3r.frames.pose_agreement import disagreements
from list3r.frames.registration.edge_look import depth_doubts
from list3r.frames.source import SourceOptions, open_source
from list3r.instances.registry import check_choice
from list3r.memory.core.errors import OptionError, SourceError, TrackingError
from list3r.memory.core.records import ChunkResult
from list3r.memory.core.settings import stored_settings
from list3r.memory.store.store import Store
from list3r.models.cards import find_card
from list3r.models.choice import PARTS_OF_OPTIONS, pinned_weights
from list3r.models.licences import DEFAULT_PROFILE
from list3r.models.presets import ModelSelection
from list3r.pipeline.choice import (
    check_beside,
    look_doubts,
    settings_asked,
    settings_beside,
    settings_resumed,
    stored_sessions,
)
from list3r.pipeline.chunks.calibration import (
    camera_notes,
    estimated_camera,
    get_ready_for_camera,
    is_camera_wanted,
    with_camera,
    with_short_windows,
)
from list3r.pipeline.chunks.chunk import ChunkTask, get_ready, process_parts
from list3r.pipeline.chunks.joint_windows import ChunkPool, joint_windows
from list3r.pipeline.chunks.whole_map import map_spans, map_whole, takes_wide_steps
from list3r.pipeline.finishing import check_run
from list3r.pipeline.mapping import add_chunk
from list3r.pipeline.placing import place_chunks
from list3r.pipeline.request import BuildRequest, RunOptions, Watch
from list3r.pipeline.settings import AssociationSettings, BuildSettings
from list3r.pipeline.workers import OrderedPool, default_workers
from list3r.reconstruction.precomputed_files import check_archives
from list3r.reconstruction.registry import entry, usual_model

if TYPE_CHECKING:
    from list3r.association.whole_map.video_map import VideoMap


@dataclass(frozen=True)
class Job:
    """A video to work on, and how."""

    source: str | Path
    options: SourceOptions
    settings: BuildSettings
    info: SourceInfo
    run: RunOptions
    notes: tuple[str, ...] = ()
    """What the user should know before the work begins, one sentence each."""
    opened: FrameSource | None = None
    """The source as it was listed; None where it may have grown since."""

    def frames(self) -> FrameSource:
        """Return the source, listed anew only where it has to be."""
        return open_source(self.source, self.options) if self.opened is None else self.opened


@dataclass(frozen=True)
class Plan:
    """The chunks of a session."""

    session: int
    spans: list[ChunkSpan]
    done: set[int]
    """Numbers of the spans that an earlier run finished."""
    first: ChunkTask | None = None
    """The first chunk that is left to do; None where none is."""
    cuts: tuple[int, ...] = ()
    whole: VideoMap | None = None
    """The map of the whole video, where one was made before its chunks."""

    @property
    def left(self) -> int:
        """How many spans are left to do."""
        return sum(span.index not in self.done for span in self.spans)

    def tasks(self) -> Iterator[ChunkTask]:
        """What is left to do, in order, each made when it is asked for."""
        for span in self.spans:
            if self.first is not None and span.index not in self.done:
                yield replace(self.first, span=span, shot=shot_of(span, self.cuts, self.spans[-1].stop))

    def fresh_frames(self) -> int:
        """Frames that this run works on, each counted once."""
        fresh = sum(s.stop - s.start for s in self.spans if s.index not in self.done)
        shared = sum(max(0, a.stop - b.start) for a, b in pairwise(self.spans) if b.index not in self.done)
        return max(0, fresh - shared)


@dataclass(frozen=True)
class Before:
    """The memory of a session, as it may be there before it."""

    memory: Path
    update: bool = False
    """The session is a later one of it."""


def prepare(
    source: str | Path,
    options: SourceOptions | None,
    settings: BuildSettings | BuildRequest | None,
    run: RunOptions,
    before: Before | None = None,
    watch: Watch | None = None,
) -> Job:
    """Open a source and make everything definite that was left open. Raises `SourceError` and `OptionError`.

    A resumed session of a memory goes on with its own settings. An update of it takes the settings of its first
    session, but for what is asked for.
    """
    options = options or SourceOptions()
    check_run(run, lambda line: (watch or Watch()).tell([line]))
    opened = open_source(source, options, (watch or Watch()).looking("frames"))
    info = opened.info
    options.check_fits(info)
    later = before is not None and before.update
    first, begun = (None, None) if before is None else stored_sessions(before.memory)
    begun = begun or (None if later else first)  # a build that is done has nothing left to do
    first, begun = first if later else None, begun if run.resume else None
    notes: list[str] = []
    if settings is None or isinstance(settings, BuildRequest):
        request = settings or BuildRequest()
        if later and request.up in ("camera", "unknown"):
            raise OptionError(f"--up {request.up} is for build: a memory has one way up; give x,y,z, or leave it out")
        if later and request.association is not None:
            raise OptionError("--association is for build: a memory is joined in one way; leave it out")
        if begun is not None:
            chosen, notes = settings_resumed(request, begun, info, run.licence)
        else:
            chosen, notes = settings_asked(request, info, run.licence)
            if first is not None:
                chosen = settings_beside(chosen, first)
                notes += look_doubts(chosen, first)
    else:
        chosen = settings
        if first is not None:
            check_beside(chosen, first)
    chosen = resolve_settings(chosen, info)
    check_buildable(info, chosen)
    notes += depth_doubts(opened)
    if chosen.poses != "estimate":
        check_agreement(opened)
    return Job(source, options, with_weights(chosen, run.licence), info, run, tuple(notes), opened)


def plan_session(store: Store, session: int, job: Job, watch: Watch, pool: ChunkPool | None = None) -> Plan:
    """The chunks of a session, and of those the ones that are not in the memory yet; a `pool` helps with the camera."""
    count = job.info.frame_count
    cuts = _cuts(store, session, job, watch)
    step = settled_step(store, session, job, watch)
    spans = plan_chunks(count, job.settings.chunks.times(step), cuts)
    done = {c.index for c in store.chunks.all(session)}
    wide = step == 1 and not cuts and takes_wide_steps(job.frames(), job.settings)
    shorter = map_spans(job.frames(), job.settings, spans) if wide else spans
    left = next((s for s in shorter if s.index not in done), None)
    options, whole = _camera_and_map(store, session, job, watch, pool, wide=wide and left is not None)
    if whole is not None or left is None:
        spans = shorter
    left = next((s for s in spans if s.index not in done), None)
    plan = Plan(session, spans, done, None, cuts, whole)
    if left is None:
        return plan
    where = None if watch.debug_dir is None else str(watch.debug_dir)
    known = None if whole is None else whole.T_map_cam
    first = ChunkTask(str(job.source), options, left, job.settings, where, shot_of(left, cuts, count), step, known)
    return replace(plan, first=first)


def _camera_and_map(
    store: Store, session: int, job: Job, watch: Watch, pool: ChunkPool | None, *, wide: bool
) -> tuple[SourceOptions, VideoMap | None]:
    """The options with the camera as it was estimated, and the map of a whole video of wide steps, which tells what is
    not known of a camera whose focal length is given.
    """
    given = job.info.camera is not None
    if wide and isinstance(pool, OrderedPool):
        pool.start(get_ready, job.settings)
    whole = map_whole(job.frames(), job.settings) if wide and given else None
    how = with_short_windows(job.settings) if wide else job.settings
    estimate = partial(estimated_camera, job.frames(), job.options, how, watch.look, whole, pool)
    options = with_camera(store, session, job.options, estimate)
    if wide and not given:
        whole = map_whole(open_source(job.source, options), job.settings)
    return options, whole


def add_chunks(
    store: Store,
    job: Job,
    plan: Plan,
    pool: ChunkPool,
    watch: Watch,
    added: Callable[[ChunkResult], None] = lambda part: None,
) -> None:
    """Work on the chunks side by side and add them in order, with one thread, so that sums are those of any machine.

    Those of a later session are only placed. `added` hears of every part that came into the memory.
    """
    if plan.first is None:
        return
    first, session, count = plan.first, plan.session, job.info.frame_count
    later = session != store.sessions.all()[0].session_id
    watch.show(store.frames.count(session), count)
    known = {c.index for c in store.chunks.all(session)}
    how = _asking_networks(job.settings)
    if isinstance(pool, OrderedPool):
        pool.keep(plan.left)
    with threadpool_limits(1):
        joint = joint_windows(store, session, first, pool)
        for task, results in zip(plan.tasks(), pool.map(plan.tasks()), strict=True):
            for part in (p for p in results if p.index not in known):
                add_chunk(store, session, part, joint, how, library=not later, debug_dir=watch.debug_dir)
                note_lost(store, session, part)
                added(part)
            watch.show(task.span.stop, count)
    if plan.whole is not None:
        from list3r.association.whole_map.loops import write_revisits

        write_revisits(store, session, plan.whole, how.revisits.search.suppress_frames)


def chunk_pool(job: Job) -> ChunkPool:
    """Return what works on the chunks of a video: processes of this machine, or a Ray cluster.

    The processes start at once, so that they have imported what a chunk needs when the chunks are planned.
    """
    asked, settings = job.run.workers, job.settings
    if job.run.engine == "ray":
        from list3r.pipeline.workers.ray_pool import RayPool

        gpu = settings.device != "cpu" and uses_networks(settings)
        return RayPool(process_parts, asked, job.run.address, gpu=gpu)
    chunks = min(settings.chunks, settings.video_map.chunks, key=lambda c: c.length - c.overlap)
    most = len(plan_chunks(job.info.frame_count, chunks))
    pool = OrderedPool(process_parts, min(usual_workers(settings) if asked is None else asked, most))
    camera_first = is_camera_wanted(job.info, job.options, settings)
    pool.start(get_ready_for_camera if camera_first else get_ready, settings)
    return pool


MOST_DEPTH_EVERY = 8
"""Chunks are so many times as long, and their pictures are held in memory."""
_MOST_REASONS = 5
"""Chunks that were lost of which is said why."""


def take_back(store: Store, session: int) -> None:
    """Leave the memory as it was before a session that is not in the library yet."""
    placed = any(f.state == "posed" for f in store.frames.all(session))
    with store.transaction():
        store.sessions.drop(session)
        if placed:
            place_chunks(store, stored_settings(store, AssociationSettings, "association"), bend=True)


def check_posed(store: Store, session: int, info: SourceInfo, after: str = "") -> None:
    """Raise `SourceError` where no frame of a session can be used, `TrackingError` where the camera is placed in none.

    `after` says what is left then.
    """
    frames = store.frames.all(session)
    if any(f.state == "posed" for f in frames):
        return
    bad = [f for f in frames if f.state == "bad"]
    end = f"; {after}" if after else ""
    count = "1 frame" if len(frames) == 1 else f"{len(frames)} frames"
    if bad and len(bad) == len(frames):
        raise SourceError(f"none of {count} of {info.path} can be used ({bad[0].note}); is the copy complete?{end}")
    of_these = f", {len(bad)} of which cannot be used: {bad[0].note}" if bad else ""
    hint = "check the depth scale and intrinsics with `list3r inspect`" if info.has_depth else ""
    reasons = "; ".join(filter(None, (*lost_reasons(store, session)[:1], hint, after)))
    raise TrackingError(f"the camera could not be tracked in any frame of {info.path} ({count}{of_these}); {reasons}")


def lost_reasons(store: Store, session: int) -> list[str]:
    """Why the camera could not be followed through chunks of a session, one sentence each, the first few."""
    return list(store.sessions.get(session).lost_reasons[:_MOST_REASONS])


def shot_cuts(store: Store, session: int) -> list[int]:
    """Positions before which the video of a session jumps."""
    return list(store.sessions.get(session).cuts or ())


def settled_notes(store: Store, session: int) -> tuple[str, ...]:
    """What the user should know of what was settled before the chunks: the camera, and which frames get depth."""
    notes = camera_notes(store, session)
    row = store.sessions.get(session)
    step = row.depth_step or 1
    if step == 1:
        return notes
    nth = {2: "2nd", 3: "3rd"}.get(step, f"{step}th")
    why = "as asked" if row.settings.get("depth_every") else "the picture moves slowly"
    return (*notes, f"{why}: depth and things are from every {nth} frame (--depth-every 1 takes all)")


def settled_step(store: Store, session: int, job: Job, watch: Watch) -> int:
    """From every how many frames depth is computed, settled once; 1 for models that take it from elsewhere."""
    if not entry(job.settings.reconstruction).thins:
        return 1
    known = store.sessions.get(session).depth_step
    if known is None:
        known = job.settings.depth_every
        if known is None:
            length, looking = job.settings.chunks.length, watch.looking("pace")
            known = depth_step(job.frames(), length, _pace(job), progress=looking)
        with store.transaction():
            store.sessions.put(replace(store.sessions.get(session), depth_step=known))
    return known


def _pace(job: Job) -> PaceSettings:
    """How many frames may be passed over, none of which is held."""
    pace = job.settings.pace
    if not entry(job.settings.reconstruction).skips:
        return pace
    return replace(pace, most=min(pace.most, job.settings.models.rgbd.most_step), most_mb=float("inf"))


def note_lost(store: Store, session: int, result: ChunkResult) -> None:
    """Keep why the camera could not be followed through a chunk."""
    if result.lost_reason:
        with store.transaction():
            row = store.sessions.get(session)
            store.sessions.put(replace(row, lost_reasons=(*row.lost_reasons, result.lost_reason)))


def _cuts(store: Store, session: int, job: Job, watch: Watch) -> tuple[int, ...]:
    """Where the video jumps, found once; given poses know where the camera is on either side."""
    if job.settings.poses != "estimate":
        return ()
    known = store.sessions.get(session).cuts
    if known is None:
        known = tuple(find_cuts(job.frames(), job.settings.cuts, watch.looking("cuts")))
        with store.transaction():
            store.sessions.put(replace(store.sessions.get(session), cuts=known))
    return known


def resolve_settings(settings: BuildSettings, info: SourceInfo) -> BuildSettings:
    """Settings with `auto` replaced by what the source offers."""
    poses, reconstruction = settings.poses, settings.reconstruction
    if reconstruction == "auto":
        reconstruction = usual_model(info.has_depth)
    if poses == "auto":
        drift = info.poses_drift and info.poses_metric and entry(reconstruction).follows_prior
        poses = ("prior" if drift else "given") if info.has_poses else "estimate"
    up = "source" if info.z_up and poses != "estimate" else "planes"
    up = up if settings.up in ("planes", "source") else settings.up
    return replace(settings, poses=poses, reconstruction=reconstruction, up=up)


def check_buildable(info: SourceInfo, settings: BuildSettings) -> None:
    """Raise an error that names the fix when the source cannot be built with the settings."""
    if settings.poses not in ("given", "prior", "estimate"):
        raise OptionError(f"--poses {settings.poses} is not known; choose estimate, prior, given or auto")
    model, every = entry(settings.reconstruction), settings.depth_every
    if every is not None and not 1 <= every <= MOST_DEPTH_EVERY:
        raise OptionError(f"--depth-every {every}: choose 1 to {MOST_DEPTH_EVERY}; to take fewer frames use --every")
    if every is not None and every > 1 and not model.thins:
        raise OptionError(
            f"--depth-every works with sfm and rgbd, not with {settings.reconstruction}; leave it out, or use --every"
        )
    if model.needs_depth and not info.has_depth:
        raise OptionError(
            f"{info.path} has no depth, which {settings.reconstruction} needs; "
            "leave out --reconstruction, or give a source with depth (docs/sources.md)"
        )
    if model.needs_camera and info.camera is None:
        raise OptionError(f"the intrinsics of {info.path} are unknown; give --intrinsics fx,fy,cx,cy")
    if settings.poses != "estimate" and not info.has_poses:
        raise OptionError(f"{info.path} has no poses; use --poses estimate")
    if model.reads_files and settings.weights is not None:
        check_archives(Path(settings.weights).expanduser())
    if settings.poses == "prior":
        _check_prior(info, settings.reconstruction)
    check_choice(settings.discovery, settings.tracking, settings.features)
    if settings.device not in ("auto", "cpu"):  # looking for a GPU takes seconds
        from list3r.models.pretrained import pick_device

        pick_device(settings.device)


def _check_prior(info: SourceInfo, reconstruction: str) -> None:
    """Raise `OptionError` where poses that are given cannot be corrected, with the reason."""
    otherwise = "use --poses given, which uses them as they are, or estimate, which does not use them"
    if not info.has_depth:
        raise OptionError(
            f"--poses prior corrects poses by sensor depth, from one frame to the next, and {info.path} has none; "
            f"{otherwise}"
        )
    if not info.poses_metric:
        raise OptionError(
            f"--poses prior compares poses with depth in metres, but those of {info.path} have another unit; "
            f"{otherwise}"
        )
    if not entry(reconstruction).follows_prior:
        raise OptionError(f"--poses prior needs --reconstruction rgbd, not {reconstruction}; {otherwise}")


def check_agreement(source: FrameSource) -> None:
    """Raise `SourceError` where given poses contradict what the frames show."""
    for found in disagreements(source):
        raise SourceError(f"{source.info.path}: {found}; fix that, or use --poses estimate, which needs no poses")


def with_weights(settings: BuildSettings, licence: str = DEFAULT_PROFILE) -> BuildSettings:
    """The settings with the weights of every network named by their commit, fetched where they are not in the cache.

    Raises `OptionError` for what the licence profile forbids, when a package is missing, or when weights can be had
    neither from the disk nor from the hub.
    """
    chosen = ModelSelection(settings.reconstruction, settings.discovery, settings.tracking, settings.features)
    known = dict(settings.instance_weights)
    asked = {name: known[key] for name in PARTS_OF_OPTIONS if (key := f"{name}/{getattr(chosen, name)}") in known}
    if settings.weights is not None:
        asked["reconstruction"] = settings.weights
    found = pinned_weights(chosen, asked, licence)
    weights = found.pop("reconstruction", None)
    known |= {f"{name}/{getattr(chosen, name)}": where for name, where in found.items()}
    return replace(settings, weights=weights, instance_weights=tuple(sorted(known.items())))


def _asking_networks(settings: BuildSettings) -> AssociationSettings:
    """The settings of association; where a network makes the chunks, its joint windows are a second opinion."""
    how = settings.association
    if find_card(settings.reconstruction, "geometry") is None:
        return how
    revisits = how.revisits
    most = max(revisits.second_opinions, revisits.of_networks)
    return replace(how, revisits=replace(revisits, second_opinions=most))


def usual_workers(settings: BuildSettings) -> int:
    """Processes unless more are asked for: one where networks run, whose weights each process would hold once more."""
    return 1 if uses_networks(settings) else default_workers()


def uses_networks(settings: BuildSettings) -> bool:
    """Return whether networks work on the chunks."""
    return bool(settings.instance_weights) or find_card(settings.reconstruction, "geometry") is not None
