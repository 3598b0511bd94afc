"""From a video to a memory: the page that reads like the paper's method, and the only writer of memories.

frames -> chunks -> reconstruction + local instance library        (any process, side by side; `chunk_stage`)
       -> edges -> graph -> up -> global instance library -> store (in order, one transaction each; `mapping`)
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

from threadpoolctl import threadpool_limits

from list3r import __version__
from list3r.frames.base import SourceInfo
from list3r.frames.source import SourceOptions
from list3r.memory.errors import TrackingError
from list3r.memory.store.store import Store
from list3r.models.licences import DEFAULT_PROFILE
from list3r.pipeline.mapping import finish_session
from list3r.pipeline.session import (
    Job,
    Look,
    Plan,
    Progress,
    add_chunks,
    lost_reasons,
    plan_session,
    prepare,
    settled_notes,
    shot_cuts,
)
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.target import make_folder, open_target
from list3r.reconstruction.registry import entry


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
    licence: str = DEFAULT_PROFILE,
    debug_dir: str | Path | None = None,
    progress: Progress | None = None,
    look: Look | None = None,
) -> BuildReport:
    """Build the memory of one video; see `list3r.build` for the arguments. `look` hears of what is done before chunks.

    Raises `SourceError`, `MemoryFileError`, `OptionError`, `TrackingError`; then nothing half-written is left, except a
    memory in which cameras are placed, which `resume` goes on with.
    """
    started = time.monotonic()
    job = prepare(source, options, settings, workers, licence)
    if debug_dir is not None:
        make_folder(Path(debug_dir))
    with open_target(Path(memory), job.info, job.settings, resume=resume, force=force) as target:
        session = _session(target.store, job)
        plan = plan_session(target.store, session, job, look, debug_dir)
        add_chunks(target.store, job, plan, progress, added=lambda part: target.keep() if part.posed.any() else None)
        return _finish(target.store, job, plan, started)


def _session(store: Store, job: Job) -> int:
    """The session to write to: a new one, or the one that a build before left unfinished."""
    sessions = store.sessions()
    if sessions:
        return sessions[0].session_id
    info, settings = job.info, job.settings
    with store.transaction():
        store.set_value("created_by", f"list3r {__version__}")
        store.set_value("scale_kind", _scale_kind(info, settings))
        store.set_value("scale_source", _scale_source(info, settings))
        store.set_value("gravity", "unknown")
        store.set_value("poses", settings.poses)
        return store.add_session(
            str(Path(info.path).resolve()), info.fingerprint, settings.as_plain(), info.frame_count
        )


def _scale_kind(info: SourceInfo, settings: BuildSettings) -> str:
    """Whether a unit is a metre; sensor depth says nothing where the model does not look at it."""
    source = _scale_source(info, settings)
    if source == "given poses":
        return "metric" if info.poses_metric else "relative"
    return "relative" if source == "none" else info.scale_kind


def _scale_source(info: SourceInfo, settings: BuildSettings) -> str:
    """Who says how long a unit is, as far as the source and the settings do."""
    if info.has_depth and entry(settings.reconstruction).needs_depth:
        return "sensor depth"
    return "given poses" if settings.poses == "given" else "none"


def _finish(store: Store, job: Job, plan: Plan, started: float) -> BuildReport:
    info, settings = job.info, job.settings
    frames = store.frames(plan.session)
    posed = sum(f.state == "posed" for f in frames)
    if posed == 0:
        why = lost_reasons(store, plan.session)
        hint = "check the depth scale and intrinsics with `list3r inspect`" if info.has_depth else ""
        raise TrackingError(
            f"the camera could not be followed in any frame of {info.path} ({_count(len(frames), 'frame')}); "
            + "; ".join(filter(None, (*why[:1], hint)))
        )
    with threadpool_limits(1):
        finish_session(store, plan.session, settings.association, settings.carving)
    seconds = time.monotonic() - started
    components = len({c.component for c in store.chunks()})
    lost, bad = (sum(f.state == state for f in frames) for state in ("lost", "bad"))
    return BuildReport(
        frames=len(frames),
        posed=posed,
        lost=lost,
        bad=bad,
        chunks=len(plan.spans),
        components=components,
        loops=sum(e.kind == "loop" and e.accepted for e in store.edges()),
        instances=len(store.instances(structure=False)),
        structure=len(store.instances(structure=True)),
        relations=len(store.relations()),
        seconds=round(seconds, 2),
        frames_per_second=round(plan.fresh_frames() / seconds, 2),
        resumed_chunks=len(plan.done),
        stage_seconds={k: round(v, 2) for k, v in store.stage_seconds().items()},
        notes=_notes(store, plan.session, lost, bad, components),
    )


def _notes(store: Store, session: int, lost: int, bad: int, components: int) -> tuple[str, ...]:
    notes = list(settled_notes(store, session))
    cuts = shot_cuts(store, session)
    if cuts:
        notes.append(f"the video jumps at frame {', '.join(str(c) for c in cuts)}; chunks end there")
    if bad:
        notes.append(f"{_count(bad, 'frame')} could not be used, skipped: {_listed(store)}")
    if lost and store.get_value("poses") == "given":
        notes.append(f"{_count(lost, 'frame')} came without a valid pose and are left out; --poses estimate needs none")
    elif lost:
        where = _runs([f.frame_index for f in store.frames(session) if f.state == "lost"])
        notes.append(f"the camera could not be followed in {_count(lost, 'frame')} ({where}); they have no pose")
    notes += lost_reasons(store, session)
    if components > 1:
        notes.append(f"the video falls into {components} parts that could not be joined; each has its own frame")
    if store.get_value("gravity") == "unknown":
        notes.append("which way is up could not be told; vertical relations (on, above, below) are left out")
    return tuple(notes)


def _runs(numbers: Sequence[int], most: int = 5) -> str:
    """Ascending numbers in words: those that follow each other by their first and last."""
    breaks = [k for k in range(1, len(numbers)) if numbers[k] != numbers[k - 1] + 1]
    runs = [(numbers[a], numbers[b - 1]) for a, b in pairwise([0, *breaks, len(numbers)])]
    shown = ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in runs[:most])
    return shown + (f" and {len(runs) - most} more stretches" if len(runs) > most else "")


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _listed(store: Store, most: int = 5) -> str:
    rows = store.bad_frames()
    shown = ", ".join(f"{index} ({reason})" for _, index, reason in rows[:most])
    return shown + (f" and {len(rows) - most} more" if len(rows) > most else "")
