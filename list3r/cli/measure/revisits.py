"""eval revisits: loops against covisibility."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, open_memory, print_table
from list3r.cli.measure.inputs import read_covisibility_of
from list3r.cli.measure.options import (
    EveryOption,
    PlotOption,
    Truth,
    check_plot,
    save_picture,
    share,
)
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.evaluation.revisits import RevisitScores


def revisits(
    truth: Truth,
    memory: Annotated[Path, typer.Argument(metavar="MEMORY", show_default=False)],
    least: Annotated[
        float,
        typer.Option("--least", help="A revisit is a pair of frames that share at least this part of the surface."),
    ] = 0.3,
    different: Annotated[
        float,
        typer.Option(
            "--different",
            help="Frames that share less than this see different places; pairs between the two are not counted.",
        ),
    ] = 0.1,
    precision: Annotated[float, typer.Option("--precision", help="Precision at which rankings are compared.")] = 0.99,
    session: Annotated[int, typer.Option("--session", help="The session of the memory that TRUTH belongs to.")] = 1,
    every: EveryOption = None,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="FILE", help="Write the covisibility as .npz, to use as TRUTH next time."),
    ] = None,
    plot: PlotOption = None,
    json: JsonOption = False,
) -> None:
    """Precision and recall of loops against covisibility. TRUTH: the source with depth and poses, or an .npz of frame
    (F,), time_s (F,) and share (F, F): the part of frame i's surface that frame j sees too.

    Example: list3r eval revisits walk house.l3r --every 5 --save covisibility.npz
    """
    from list3r.evaluation.covisibility import write_covisibility
    from list3r.evaluation.revisits import Candidates, RevisitTruthSettings, judge, score
    from list3r.exporters.output import check_target, replacing

    settings = RevisitTruthSettings(least, different, precision)
    check_plot(plot)
    if save is not None:
        if save.suffix.lower() != ".npz":
            raise OptionError(f"--save {save}: the file must end in .npz")
        check_target(save)
    with open_memory(memory) as scene:
        chunks = [c for c in scene.store.chunks.all() if c.session_id == session]
        frames = scene.store.frames.all(session)
        edges = scene.store.edges.all()
    if not chunks:
        raise OptionError(f"{memory} has no session {session}; `list3r info` lists them")
    found = read_covisibility_of(truth, every)
    _check_clock(truth, found.frame, found.time_s, {f.frame_index: f.time_s for f in frames if f.state != "bad"})
    spans = {c.chunk_id: (c.first_frame, c.last_frame) for c in chunks}
    inside = [e for e in edges if e.u in spans and e.v in spans]
    neighbours = [(e.u, e.v) for e in inside if e.kind == "adjacent"] + [
        (a.chunk_id, b.chunk_id) for a, b in itertools.pairwise(chunks) if b.first_frame <= a.last_frame
    ]
    judged = judge(Candidates.of_edges(inside), found, spans, neighbours, settings)
    scores = score([judged], settings)
    if save is not None:
        with replacing(save) as temporary:
            write_covisibility(temporary, found)
    if plot is not None:
        from list3r.evaluation.figures import revisits_figure

        save_picture(revisits_figure(found.frame, found.share, judged, f"loop candidates of {memory.name}"), plot)
    if json:
        counts = {"covisible_frames": len(found.frame), "pairs_of_chunks": len(judged.true_pairs)}
        print_answer([{**scores.as_dict(), **counts}])
        return
    _print_revisits(scores, len(found.frame), len(chunks))


def _check_clock(path: Path, frame: Any, time_s: Any, times: dict[int, float]) -> None:
    """Raises `OptionError` when the truth's frames are not the memory's."""
    import numpy as np

    gaps = [abs(times[int(k)] - float(t)) for k, t in zip(frame, time_s, strict=True) if int(k) in times]
    if not gaps:
        span = f"{min(times)} to {max(times)}" if times else "none"
        raise OptionError(
            f"{path}: none of its {len(frame)} frames is in the memory, which has {span}; is it its source?"
        )
    if float(np.median(gaps)) > 0.05:
        raise OptionError(
            f"{path}: frames with the same number are {float(np.median(gaps)):.2f} s apart in it and in the memory; is "
            "it the source of the memory?"
        )


def _print_revisits(scores: RevisitScores, frames: int, chunks: int) -> None:
    s = scores.settings
    say(f"{frames} frames, {chunks} chunks, {scores.candidates} candidates")
    say(
        f"revisit: each frame sees {100 * s.least:g} % of the other's surface; different: below {100 * s.different:g} %"
    )
    rows = [
        [name, a.true, a.claimed, a.correct, a.open, share(a.precision), share(a.recall)]
        for name, a in (("pairs of chunks", scores.chunks), ("proposed frame pairs", scores.frames))
    ]
    print_table(rows, ["", "true", "accepted", "right", "open", "precision", "recall"])
    say(f"pairs of chunks that were proposed: recall {share(scores.proposed_recall)}")
    cues = {k: r for k, r in scores.rankings.items() if k.startswith("s_")} or {
        k: r for k, r in scores.rankings.items() if k == "cosine"
    }
    if cues:
        say("", f"ranked by one score: recall at precision {s.precision:g}")
        print_table(
            [
                [
                    name,
                    share(r.chunk_recall),
                    share(r.frame_recall),
                    "-" if r.chunk_threshold is None else f"{r.chunk_threshold:.3f}",
                    share(r.average_precision),
                ]
                for name, r in cues.items()
            ],
            ["score", "pairs of chunks", "frame pairs", "from", "average precision"],
        )
    for u, v, a, b in scores.wrong:
        say(f"wrong: chunks {u} and {v} were joined by frames {a} and {b}")
    if scores.missed:
        most = 12
        shown = ", ".join(f"{u}-{v}" for u, v in scores.missed[:most])
        more = f" and {len(scores.missed) - most} more" if len(scores.missed) > most else ""
        say(f"not joined: chunks {shown}{more}")
