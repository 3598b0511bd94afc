"""mcp, ask-config: a memory, or a catalogue of many, for agents."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli import terminal
from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, MemoryArgument
from list3r.cli.terminal import note
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.api import SceneMemory
    from list3r.catalog import Catalog

TOKEN_VARIABLE = "LIST3R_MCP_TOKEN"
_CONNECTIONS = 4
"""To the database of a catalogue, at most."""


def mcp(
    memory: Annotated[Path | None, typer.Argument(metavar="[MEMORY]", help="The memory file.")] = None,
    catalog: Annotated[
        str | None,
        typer.Option("--catalog", metavar="URL", help="Serve a catalogue instead: postgresql://host/name, or a file."),
    ] = None,
    http: Annotated[bool, typer.Option("--http", help="Streamable HTTP on this machine instead of stdio.")] = False,
    port: Annotated[int, typer.Option("--port", help="Port of --http; 0: any free one.")] = 8740,
    write: Annotated[
        bool, typer.Option("--write", help="Also offer tools that edit; no other program can write meanwhile.")
    ] = False,
) -> None:
    """Serve a memory, or a catalogue, to agents by the Model Context Protocol (MCP). With --http clients must send a
    token: the value of the environment variable LIST3R_MCP_TOKEN, or else a new one, which is printed.

    Example: list3r mcp house.l3r --http
    """
    if (memory is None) == (catalog is None):
        raise OptionError("give either a memory or --catalog URL, such as: list3r mcp house.l3r")
    if catalog is not None and write:
        raise OptionError("--write needs a memory; a catalogue cannot be edited")
    from list3r.server.mcp.app import HttpSettings, serve_http, serve_stdio

    with _opened(memory, catalog, write=write) as served:
        if not http:
            serve_stdio(served)
            return
        settings = HttpSettings(port, os.environ.get(TOKEN_VARIABLE, ""))
        try:
            serve_http(served, settings, _print_address)
        except KeyboardInterrupt:
            note("stopped")


def _opened(memory: Path | None, catalog: str | None, *, write: bool) -> SceneMemory | Catalog:
    from list3r.api import open as open_scene
    from list3r.catalog import Catalog

    if memory is not None:
        return open_scene(memory, writable=write)
    assert catalog is not None
    return Catalog.open(catalog, _CONNECTIONS, make=False)


def _print_address(address: str, token: str) -> None:
    shown = f"the token of {TOKEN_VARIABLE}" if os.environ.get(TOKEN_VARIABLE) else token
    note(address)
    note(f"Authorization: Bearer {shown}")


def ask_config(
    memory: MemoryArgument,
    client: Annotated[
        str, typer.Option("--client", metavar="NAME", help="claude, cursor, gemini, vscode or codex.")
    ] = "claude",
    write: Annotated[bool, typer.Option("--write", help="Offer tools that edit.")] = False,
    json: JsonOption = False,
) -> None:
    """Print the configuration entry by which an agent's program starts the MCP server of a memory.

    Example: list3r ask-config house.l3r --client vscode
    """
    from list3r.api import open as open_scene
    from list3r.server.mcp.clients import config_entry

    open_scene(memory).close()
    file, text = config_entry(Path(memory), client, write=write)
    if json:
        print_answer([{"client": client, "file": file, "text": text}])
        return
    note(f"for {file}:")
    terminal.write(f"{text}\n")
