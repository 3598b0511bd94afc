"""catalog add, remove, list, check, rebuild: many memories in one catalogue."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, print_table
from list3r.cli.terminal import note, say
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.catalog import Catalog

VARIABLE = "LIST3R_CATALOG"
CatalogOption = Annotated[
    str,
    typer.Option(
        "--catalog",
        metavar="URL",
        envvar=VARIABLE,
        show_envvar=False,
        help="postgresql://host/name, or a file; default: LIST3R_CATALOG, else catalog.sqlite here.",
    ),
]
Files = Annotated[list[str], typer.Argument(metavar="FILE...", help="Memory files, or folders of them.")]
_DEFAULT = "catalog.sqlite"


def add(
    files: Files,
    catalog: CatalogOption = _DEFAULT,
    name: Annotated[
        str | None, typer.Option("--name", help="Name of the memory, if only one is added; default: that of its file.")
    ] = None,
    store: Annotated[
        str | None,
        typer.Option("--store", metavar="DIR", help="Keep a copy that never changes in this folder or URL."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Add memories to the catalogue; a memory with a known name replaces the earlier one as its next revision.

    Example: list3r catalog add memories/ --catalog postgresql://db.example/list3r
    """
    found = list(_memories(files))
    if name is not None and len(found) != 1:
        raise OptionError(f"--name {name} names one memory, but {len(found)} are given")
    with _opened(catalog, make=True) as opened:
        with opened.loading(len(found)):
            entries = [asdict(opened.add(path, name, store)) for path in found]
    if json:
        print_answer(entries)
        return
    print_table([[e["name"], e["revision"], e["instances"], e["path"]] for e in entries], _HEADER)


def remove(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Names of memories.")],
    catalog: CatalogOption = _DEFAULT,
    json: JsonOption = False,
) -> None:
    """Remove memories from the catalogue; their files stay.

    Example: list3r catalog remove kitchen
    """
    with _opened(catalog) as opened:
        for name in names:
            opened.remove(name)
    if json:
        print_answer([{"name": name} for name in names])
    else:
        say(f"forgot {', '.join(names)}")


def list_(catalog: CatalogOption = _DEFAULT, json: JsonOption = False) -> None:
    """List the memories of the catalogue.

    Example: list3r catalog list --catalog catalog.sqlite
    """
    with _opened(catalog) as opened:
        entries = opened.memories()
    if json:
        print_answer(map(asdict, entries), total=len(entries))
        return
    print_table([[e.name, e.revision, e.instances, e.path] for e in entries], _HEADER)


def check(catalog: CatalogOption = _DEFAULT, json: JsonOption = False) -> None:
    """List files that have changed or disappeared since they were added; status 1 if there are any.

    Example: list3r catalog check
    """
    from list3r.catalog.catalog import is_stale

    with _opened(catalog) as opened:
        known = opened.memories()
    stale = [e for e in known if is_stale(e)]
    if json:
        print_answer(map(asdict, stale), total=len(stale))
    elif known and not stale:
        note(f"{len(known)} {'memory is' if len(known) == 1 else 'memories are'} as catalogued")
    else:
        print_table([[e.name, e.revision, e.instances, e.path] for e in stale], _HEADER)
    if stale:
        note(f"{len(stale)} changed or gone; `list3r catalog add FILE` adds the current file")
        raise typer.Exit(1)


def rebuild(
    files: Annotated[
        list[str] | None,
        typer.Argument(metavar="[FILE...]", help="Memory files, or folders of them; default: all in the catalogue."),
    ] = None,
    catalog: CatalogOption = _DEFAULT,
    json: JsonOption = False,
) -> None:
    """Write the catalogue again from the files; memories that are not among them are removed.

    Example: list3r catalog rebuild memories/
    """
    with _opened(catalog, make=files is not None) as opened:
        known = opened.memories()
        found = {e.path: e.name for e in known} if files is None else dict.fromkeys(_memories(files))
        with opened.loading(len(found) + 1):
            entries = [opened.again(path, name) for path, name in found.items()]
        gone = sorted({e.name for e in known} - {e.name for e in entries})
        for name in gone:
            opened.remove(name)
    if json:
        print_answer(map(asdict, entries), removed=gone)
        return
    note(f"{len(entries)} memories; forgot {', '.join(gone) or 'none'}")


_HEADER = ("memory", "revision", "instances", "file")


def _opened(url: str, *, make: bool = False) -> Catalog:
    from list3r.catalog import Catalog

    return Catalog.open(url, make=make)


def _memories(files: Sequence[str]) -> Iterator[str]:
    """Yield memory files, those in folders too. Raises `OptionError` for a folder without any."""
    for file in files:
        if "://" in file or not Path(file).is_dir():
            yield file
            continue
        found = sorted(str(p) for p in Path(file).glob("*.l3r"))
        if not found:
            raise OptionError(f"{file} holds no memory (*.l3r)")
        yield from found


catalogue = typer.Typer(
    help="Keep many memories in one catalogue, and ask them together.", no_args_is_help=True, rich_markup_mode=None
)
for name, command in (("add", add), ("remove", remove), ("list", list_), ("check", check), ("rebuild", rebuild)):
    catalogue.command(name)(command)
