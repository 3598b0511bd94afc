"""export, verify, doctor: the file and the machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from list3r.cli.common import JsonOption, MemoryArgument, open_memory, print_json, print_table


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command("export")(export)
    app.command("verify")(verify)
    app.command("doctor")(doctor)


def export(
    memory: MemoryArgument,
    to: Annotated[str, typer.Option("--to", metavar="FORMAT", help="json, usd, ply, glb, tum or plan.")],
    out: Annotated[Path, typer.Option("--out", metavar="PATH", help="The file to write.")],
    json: JsonOption = False,
) -> None:
    """Write a memory in another format: scene JSON, USD, coloured points, boxes, trajectory, plan picture.

    Example: list3r export house.l3r --to usd --out house.usda
    """
    with open_memory(memory) as scene:
        written = scene.export(to, out)
    sizes = {str(path): path.stat().st_size for path in written}
    if json:
        print_json({"format": to, "path": str(out), "bytes": sizes[str(out)], "files": sizes})
    else:
        print("\n".join(f"{path}  {size / 1e6:.2f} MB" for path, size in sizes.items()))


def verify(memory: MemoryArgument, json: JsonOption = False) -> None:
    """Check every page, checksum and reference of a memory; status 1 when damage is found.

    Example: list3r verify house.l3r
    """
    with open_memory(memory) as scene:
        found = scene.store.verify()
        state = [s.state for s in scene.store.sessions()]
        chunks = len(scene.store.chunks())
    if json:
        print_json({"sound": not found, "damage": found, "sessions": state, "chunks": chunks})
    elif found:
        print("\n".join(found))
    else:
        unfinished = "; the build is unfinished, go on with --resume" if "building" in state else ""
        print(f"{memory} is sound: {chunks} chunks{unfinished}")
    if found:
        raise typer.Exit(1)


def doctor(json: JsonOption = False) -> None:
    """Say what is installed, what is missing, and what that means.

    Example: list3r doctor
    """
    from list3r.cli.doctor import findings

    rows = findings()
    if json:
        print_json([{"part": part, "state": state, "means": means} for part, state, means in rows])
    else:
        print_table(rows, ["part", "state", "needed for"])
    if any(state.startswith("MISSING") for _, state, _ in rows):
        raise typer.Exit(1)
