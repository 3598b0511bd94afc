"""edit label, merge, split, delete, scale, undo, log: corrections by an operator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import IdArgument, JsonOption, MemoryArgument, open_memory, print_table
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.api import SceneMemory
    from list3r.memory.library.maintenance.edits import EditReport

AuthorOption = Annotated[str | None, typer.Option("--author", metavar="NAME", help="Author of the edit; default: you.")]


def log(
    memory: MemoryArgument,
    instance_id: Annotated[
        int | None, typer.Argument(metavar="[ID]", help="Only entries about this instance.", show_default=False)
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show the merge log: every decision with its numbers, every edit with its author.

    Example: list3r edit log house.l3r 12
    """
    from list3r.memory.library.maintenance.merge_log import states

    with open_memory(memory) as scene, scene.store.snapshot():
        entries = scene.merges(instance_id)
        edits = {e.entry: e for e in scene.store.edits.all()}
        state = states(scene.store)
    if json:
        print_answer(
            [
                {
                    "entry": e.entry,
                    "chunk": e.chunk_id,
                    **vars(e.decision),
                    "author": edits[e.entry].author if e.entry in edits else None,
                    "created_at": edits[e.entry].created_at if e.entry in edits else None,
                    "state": state.get(e.entry),
                }
                for e in entries
            ]
        )
        return
    rows = []
    for e in entries:
        d = e.decision
        numbers = ", ".join(f"{k} {v:g}" for k, v in d.scores.items())
        undone = " (undone)" if state.get(e.entry) == "undone" else ""
        rows.append([e.entry, d.kind + undone, d.a, d.b, d.reason + (f" [{numbers}]" if numbers else "")])
    print_table(rows, ["entry", "decision", "a", "b", "why"])


def undo(
    memory: MemoryArgument,
    entry: Annotated[
        int | None,
        typer.Argument(
            metavar="[ENTRY]", help="An entry of `list3r edit log`; without it, the last edit.", show_default=False
        ),
    ] = None,
    author: AuthorOption = None,
    json: JsonOption = False,
) -> None:
    """Undo an edit or a merge decision; ids that were retired come back.

    Example: list3r edit undo house.l3r 41
    """
    _run_edit(memory, lambda scene: scene.undo(entry, author=author), json)


def merge(
    memory: MemoryArgument,
    a: Annotated[int, typer.Argument(metavar="A", help="An instance.", show_default=False)],
    b: Annotated[int, typer.Argument(metavar="B", help="The same instance under another id.", show_default=False)],
    author: AuthorOption = None,
    json: JsonOption = False,
) -> None:
    """Merge two instances that are one instance: the older id stays, and the other resolves to it from then on.

    Example: list3r edit merge house.l3r 12 31
    """
    _run_edit(memory, lambda scene: scene.merge(a, b, author=author), json)


def split(
    memory: MemoryArgument,
    instance_id: IdArgument,
    out: Annotated[
        str | None,
        typer.Option(
            "--out",
            metavar="CHUNK:LOCAL,...",
            help="Local instances that leave it (see `observed_as` of `list3r show --json`); "
            "default: the split that the evidence supports best.",
        ),
    ] = None,
    author: AuthorOption = None,
    json: JsonOption = False,
) -> None:
    """Split an instance that is two instances: the larger part keeps the id.

    Example: list3r edit split house.l3r 12 --out 3:4,5:2
    """
    parts = None if out is None else _parse_parts(out)
    _run_edit(memory, lambda scene: scene.split(instance_id, parts, author=author), json)


def label(
    memory: MemoryArgument,
    instance_id: IdArgument,
    text: Annotated[str, typer.Argument(metavar="TEXT", help="The name; '' removes it.", show_default=False)],
    author: AuthorOption = None,
    json: JsonOption = False,
) -> None:
    """Name an instance; the name survives merges and later sessions.

    Example: list3r edit label house.l3r 12 "my mug"
    """
    _run_edit(memory, lambda scene: scene.label(instance_id, text, author=author), json)


def delete(
    memory: MemoryArgument, instance_id: IdArgument, author: AuthorOption = None, json: JsonOption = False
) -> None:
    """Remove an instance, also from later sessions; undo brings it back.

    Example: list3r edit delete house.l3r 12
    """
    _run_edit(memory, lambda scene: scene.delete(instance_id, author=author), json)


def scale(
    memory: MemoryArgument,
    anchor: Annotated[
        str | None,
        typer.Option(
            "--anchor",
            metavar="ANCHOR",
            help="A length that you know: ID=0.095m (longest edge), ID.height=0.095m, camera_height=1.5m (median over "
            "the floor), or x,y,z:x,y,z=1.2m between two points.",
            show_default=False,
        ),
    ] = None,
    author: AuthorOption = None,
    json: JsonOption = False,
) -> None:
    """Give one known length, so that all lengths become metres. Without --anchor, show the scale and its source.

    Example: list3r edit scale house.l3r --anchor "12=0.095m"
    """
    if anchor is not None:
        from list3r.pipeline.finishing import anchor_scale

        report = anchor_scale(memory, anchor, author)
        if not json:
            say(f"{report.text} (entry {report.entry})")
    with open_memory(memory) as scene:
        kind, source = (scene.store.facts.scale_kind or "relative"), scene.store.facts.scale_source
        units = scene.lengths
    if json:
        result = None if anchor is None else report.as_dict()
        print_answer([{"scale": kind, "scale_source": source, "edit": result}], units)
    elif kind == "guessed":
        say(f'scale guessed: lengths are about metres ({source}); --anchor "ID=0.095m" makes them metres')
    elif kind == "relative":
        say('scale relative: the length of a unit is unknown; --anchor "ID=0.095m" turns units into metres')
    else:
        say(f"scale {kind}: lengths are metres ({source})")


def _run_edit(path: Path, verb: Callable[[SceneMemory], EditReport], json: bool) -> None:
    from list3r.api import open as open_scene

    with open_scene(path, writable=True) as scene:
        report, units = verb(scene), scene.lengths
    if json:
        print_answer([report.as_dict()], units)
        return
    say(f"{report.text} (entry {report.entry})")
    lines = [f"#{n} is new" for n in report.new] + [f"#{n} is back" for n in report.restored]
    lines += [f"#{old} resolves to #{new}" for old, new in report.aliases]
    if lines:
        say("; ".join(lines))


def _parse_parts(text: str) -> list[tuple[int, int]]:
    """`3:4,5:2` as pairs. Raises `OptionError`."""
    try:
        pairs = [part.split(":") for part in text.split(",")]
        return [(int(chunk), int(local)) for chunk, local in pairs]
    except ValueError:
        raise OptionError(f"--out {text!r}: give CHUNK:LOCAL pairs separated by commas, such as 3:4,5:2") from None


edit = typer.Typer(
    help="Correct a memory: name, merge, split or delete instances, give a length, undo.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
for command in (label, merge, split, delete, scale, undo, log):
    edit.command(command.__name__)(command)
