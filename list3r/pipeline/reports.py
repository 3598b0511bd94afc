"""What a build and an update say when they are done."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from list3r.association.revisits.session_edges import DEFERRED
from list3r.memory.core.records import Edge, FrameRow, JsonFields
from list3r.memory.library.world.gravity import gravity_of
from list3r.memory.store.store import Store
from list3r.pipeline.filming import film_advice
from list3r.pipeline.session import Plan, lost_reasons, settled_notes, shot_cuts


@dataclass(frozen=True)
class LiveReport:
    """How a live source was followed."""

    received: int
    """Pictures that came."""
    thinned: int
    """Pictures left out by `--fps`."""
    dropped: int
    """Pictures that came while too many waited."""
    waiting: int
    """Pictures that were kept and not worked on any more when the session was ended."""
    reconnects: int
    gaps: int
    """Places where frames are missing: lost connections and dropped pictures."""
    latency_s: float
    """Seconds from the last picture of a chunk to its things in the memory, median over chunks."""
    most_latency_s: float


@dataclass(frozen=True)
class RunReport(JsonFields):
    """What a build and an update say alike."""

    frames: int
    posed: int
    lost: int
    bad: int
    chunks: int
    components: int
    instances: int
    seconds: float
    """Wall time of this run."""
    frames_per_second: float
    """Frames of this run (a resumed build counts only what it did itself) by wall time."""
    resumed_chunks: int
    """Chunks that an earlier run had finished."""
    notes: tuple[str, ...]
    """What the user should know, one sentence each."""


@dataclass(frozen=True)
class BuildReport(RunReport):
    """What a build did."""

    loops: int
    structure: int
    relations: int
    stage_seconds: dict[str, float]
    """CPU seconds by stage, over all runs."""
    film: str | None = None
    """What kept the video from more and what to do; None where nothing did."""
    live: LiveReport | None = None
    """Of a source that grew while it was built."""


@dataclass(frozen=True)
class UpdateReport(RunReport):
    """What an update did."""

    session: int
    """Number of the new session."""
    placed: int
    """Chunks of the session that lie in the world of an earlier one."""
    ties: int
    """Accepted relations between chunks of this session and of earlier ones."""
    events: dict[str, int]
    """How many things were seen_again, moved, removed and added."""


def _run_report(store: Store, plan: Plan, started: float) -> RunReport:
    """Return what a run did, without notes."""
    states = [f.state for f in store.frames.all(plan.session)]
    seconds = time.monotonic() - started
    return RunReport(
        frames=len(states),
        posed=states.count("posed"),
        lost=states.count("lost"),
        bad=states.count("bad"),
        chunks=len(plan.spans),
        components=len({c.component for c in store.chunks.all()}),
        instances=len(store.instances.all(structure=False)),
        seconds=round(seconds, 2),
        frames_per_second=round(plan.fresh_frames() / seconds, 2),
        resumed_chunks=len(plan.done),
        notes=(),
    )


def build_report(store: Store, plan: Plan, started: float) -> BuildReport:
    """Return what a build did that began at a time of `time.monotonic`."""
    run = _run_report(store, plan, started)
    said = vars(run) | {"notes": _build_notes(store, plan.session, run.lost, run.components)}
    return BuildReport(
        **said,
        loops=sum(e.kind == "loop" and e.accepted for e in store.edges.all()),
        structure=len(store.instances.all(structure=True)),
        relations=len(store.relations.all()),
        stage_seconds={k: round(v, 2) for k, v in store.chunks.stage_seconds().items()},
        film=film_advice(store, plan.session),
    )


def update_report(store: Store, plan: Plan, started: float) -> UpdateReport:
    """Return what an update did that began at a time of `time.monotonic`."""
    session, run = plan.session, _run_report(store, plan, started)
    rows = store.chunks.all()
    own = [c for c in rows if c.session_id == session]
    known = {c.component for c in rows if c.session_id < session}
    placed = sum(c.component in known for c in own)
    events = [e.kind for e in store.events.all(session)]
    notes = (
        *settled_notes(store, session),
        *_bad_notes(store.frames.all(session)),
        *_update_notes(len(own), placed, held(store, session), run.lost, run.frames),
        *lost_reasons(store, session),
    )
    return UpdateReport(
        **vars(run) | {"chunks": len(own), "notes": notes},
        session=session,
        placed=placed,
        ties=len(ties(store, session)),
        events={kind: events.count(kind) for kind in ("seen_again", "moved", "removed", "added")},
    )


def _update_notes(chunks: int, placed: int, held: int, lost: int, frames: int) -> tuple[str, ...]:
    notes = []
    if placed == 0:
        notes.append(
            "no place in this video was recognised: it is kept apart, in a frame of its own, and is joined "
            "when a later session connects the two"
            if not held
            else "a place in this video was recognised by a single relation only: it is kept apart until a second one "
            "confirms it, or a later session connects the two"
        )
    elif placed < chunks:
        notes.append(f"{chunks - placed} of {chunks} chunks could not be placed; they are kept apart")
    if lost:
        notes.append(f"the camera could not be tracked in {lost} of {frames} frames; they have no pose")
    return tuple(notes)


def ties(store: Store, session: int) -> list[Edge]:
    """The accepted relations between chunks of a session and chunks of the sessions before it."""
    owner = {c.chunk_id: c.session_id for c in store.chunks.all()}
    return [e for e in store.edges.all() if e.accepted and owner[e.u] < owner[e.v] == session]


def held(store: Store, session: int) -> int:
    """How many relations of a session to earlier ones are deferred, see `association.revisits.session_edges`."""
    owner = {c.chunk_id: c.session_id for c in store.chunks.all()}
    return sum(DEFERRED in e.scores and owner[e.u] < owner[e.v] == session for e in store.edges.all())


def _build_notes(store: Store, session: int, lost: int, components: int) -> tuple[str, ...]:
    notes = list(settled_notes(store, session))
    cuts = shot_cuts(store, session)
    if cuts:
        notes.append(f"the video jumps at frame {', '.join(str(c) for c in cuts)}; chunks end there")
    notes += _bad_notes(store.frames.all(session))
    if lost and store.facts.poses == "given":
        notes.append(
            f"{_count(lost, 'frame')} came without a valid pose and are left out; --poses estimate needs no poses"
        )
    elif lost:
        where = _runs([f.frame_index for f in store.frames.all(session) if f.state == "lost"])
        notes.append(f"the camera could not be tracked in {_count(lost, 'frame')} ({where}); they have no pose")
    notes += lost_reasons(store, session)
    if components > 1:
        notes.append(f"the video falls into {components} parts that could not be joined; each has its own frame")
        known = {c.component for c in store.chunks.all() if gravity_of(store, c.component) != "unknown"}
        if known and len(known) < components:
            notes.append(f"which way is up is known in {len(known)} of the parts alone")
    if store.facts.gravity == "unknown":
        notes.append("which way is up is unknown; vertical relations (on, above, below) are left out")
    return tuple(notes)


def _bad_notes(frames: Sequence[FrameRow]) -> tuple[str, ...]:
    """What is said of the frames of a session that could not be used, with why of the first of each stretch."""
    bad = {f.frame_index: f.note for f in frames if f.state == "bad"}
    if not bad:
        return ()
    doubt = "; is the copy of the source complete?" if 2 * len(bad) > len(frames) else ""
    return (f"{len(bad)} of {_count(len(frames), 'frame')} could not be used: {_runs(sorted(bad), bad)}{doubt}",)


def _runs(numbers: Sequence[int], why: Mapping[int, str] | None = None, most: int = 5) -> str:
    """Ascending numbers in words: those that follow each other by their first and last, `why` of the first behind."""
    breaks = [k for k in range(1, len(numbers)) if numbers[k] != numbers[k - 1] + 1]
    runs = [(numbers[a], numbers[b - 1]) for a, b in pairwise([0, *breaks, len(numbers)])]
    named = [(f"{a}" if a == b else f"{a} to {b}") + (f" ({why[a]})" if why else "") for a, b in runs[:most]]
    return ", ".join(named) + (f" and {len(runs) - most} more stretches" if len(runs) > most else "")


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
