"""view: a memory in the browser."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from list3r.cli.common import say_fusing
from list3r.cli.terminal import note


def view(
    memories: Annotated[
        list[Path], typer.Argument(metavar="MEMORY...", help="The memory file; several are shown side by side.")
    ],
    port: Annotated[
        int, typer.Option("--port", min=1, max=65535, help="Port here; the next free one if taken.")
    ] = 8741,
    write: Annotated[bool, typer.Option("--write", help="Allow edits; no other program can write meanwhile.")] = False,
    browser: Annotated[bool, typer.Option(help="Open the browser.")] = True,
) -> None:
    """Show a memory in the browser: surfaces, things, the camera's path; click, search, measure, go back in time.

    Example: list3r view house.l3r
    """
    from list3r.api import open as open_scene
    from list3r.viewer.app import Viewer, ViewerSettings, serve

    with contextlib.ExitStack() as stack:
        scenes = [stack.enter_context(open_scene(memory, writable=write)) for memory in memories]
        for scene in scenes:
            say_fusing(scene)
        viewers = [Viewer(scene, ViewerSettings(min(port + k, 65535))) for k, scene in enumerate(scenes)]
        address = viewers[0].address
        if len(viewers) > 1:
            from list3r.viewer.side_by_side import SideBySide

            both = SideBySide([(v.memory.path.name, v.address) for v in viewers])
            stack.callback(both.stop)
            address = both.address
        note(f"{address}  (Ctrl-C stops it)")
        if browser:
            import webbrowser

            webbrowser.open(address)
        serve(*viewers)
