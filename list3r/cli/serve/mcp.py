"""mcp, ask-config: a memory for agents."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from list3r.cli import terminal
from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, MemoryArgument, note

TOKEN_VARIABLE = "LIST3R_MCP_TOKEN"


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command("mcp")(mcp)
    app.command("ask-config")(ask_config)


def mcp(
    memory: MemoryArgument,
    http: Annotated[bool, typer.Option("--http", help="Streamable HTTP on this machine instead of stdio.")] = False,
    port: Annotated[int, typer.Option("--port", help="Port of --http; 0: any free one.")] = 8740,
    write: Annotated[bool, typer.Option("--write", help="Also tools that edit; keeps other writers out.")] = False,
) -> None:
    """Serve a memory to agents by the Model Context Protocol. With --http clients must send a token: that of the
    environment variable LIST3R_MCP_TOKEN, else a new one, which is printed.

    Example: list3r mcp house.l3r --http
    """
    from list3r.api import open as open_scene
    from list3r.server.app import HttpSettings, serve_http, serve_stdio

    with open_scene(memory, writable=write) as scene:
        if not http:
            serve_stdio(scene)
            return
        settings = HttpSettings(port, os.environ.get(TOKEN_VARIABLE, ""))
        try:
            serve_http(scene, settings, _say)
        except KeyboardInterrupt:
            note("stopped")


def _say(address: str, token: str) -> None:
    shown = f"the token of {TOKEN_VARIABLE}" if os.environ.get(TOKEN_VARIABLE) else token
    note(address)
    note(f"Authorization: Bearer {shown}")


def ask_config(
    memory: MemoryArgument,
    client: Annotated[
        str, typer.Option("--client", metavar="NAME", help="claude, cursor, gemini, vscode or codex.")
    ] = "claude",
    write: Annotated[bool, typer.Option("--write", help="With tools that edit.")] = False,
    json: JsonOption = False,
) -> None:
    """Print the entry with which a program starts the server of a memory.

    Example: list3r ask-config house.l3r --client vscode
    """
    from list3r.api import open as open_scene
    from list3r.server.clients import config_entry

    open_scene(memory).close()
    file, text = config_entry(Path(memory), client, write=write)
    if json:
        print_answer([{"client": client, "file": file, "text": text}])
        return
    note(f"for {file}:")
    terminal.write(f"{text}\n")
