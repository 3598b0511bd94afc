"""verify, repair, doctor: the file and the machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, MemoryArgument, open_memory, print_table
from list3r.cli.terminal import say
from list3r.memory.core.errors import MemoryFileError


def verify(memory: MemoryArgument, json: JsonOption = False) -> None:
    """Check every page, checksum and reference of a memory; status 1 when damage is found.

    Example: list3r verify house.l3r
    """
    found, state, chunks, leftovers = [], [], None, None
    try:
        with open_memory(memory) as scene:
            leftovers = scene.store.beside()
            found = scene.store.verify()
            if not found:
                chunks = len(scene.store.chunks.all())
                state = [{"id": s.session_id, "state": s.state} for s in scene.store.sessions.all()]
    except MemoryFileError as error:
        if not _is_broken(memory, error):
            raise
        found = [f"it cannot be opened: {error.__cause__}"]
    if json:
        facts = {"memory": str(memory), "sound": not found, "damage": found, "beside": leftovers}
        print_answer([{**facts, "sessions": state, "chunks": chunks}])
    elif found:
        say(*found)
        say(f"`list3r repair {memory}` saves the sound rows")
    else:
        unfinished = (
            "; the build is unfinished, continue with --resume" if any(s["state"] == "building" for s in state) else ""
        )
        say(f"{memory} is sound: {chunks} chunks{unfinished}")
    if leftovers and not json:
        say(leftovers)
    if found:
        raise typer.Exit(1)


def _is_broken(memory: Path, error: Exception) -> bool:
    """Whether a file that cannot be opened is an SQLite file with broken pages, and not some other file."""
    import apsw

    from list3r.exporters.output import is_database
    from list3r.memory.store.pages import PageDamaged

    cause = error.__cause__
    return isinstance(cause, apsw.CorruptError | apsw.NotADBError | PageDamaged) and is_database(memory)


def repair(
    memory: MemoryArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="Write the repaired file here; default: in place of the damaged one."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Repair a damaged memory: keep every sound row, derive the rest again, list losses. The original is kept.

    Example: list3r repair house.l3r
    """
    from list3r.memory.library.maintenance.repair import repair as salvage

    report = salvage(memory, out)
    if json:
        print_answer([report.as_dict()])
        return
    if not report.damage:
        where = "nothing was changed" if out is None else f"{out} is a copy"
        say(f"{memory} is sound; {where}")
        return
    say(f"{report.memory} is sound: {report.chunks} chunks, {report.instances} instances")
    say(f"the damaged file is {report.original}")
    for kind, names in report.lost.items():
        say(f"lost {kind.replace('_', ' ')}: {', '.join(names)}")
    if not report.lost:
        say("nothing is lost")
    elif report.rebuilt:
        say("instances and relations were derived again from the rest")


def doctor(json: JsonOption = False) -> None:
    """Check which packages are installed or missing, and the functions that need them.

    Example: list3r doctor
    """
    from list3r.cli.measure.doctor import findings

    rows = findings()
    if json:
        print_answer({"part": part, "state": state, "means": means} for part, state, means in rows)
    else:
        print_table(rows, ["part", "state", "needed for"])
    if any(state.startswith("MISSING") for _, state, _ in rows):
        raise typer.Exit(1)
