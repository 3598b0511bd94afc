"""rooms: list the rooms of a memory, name one, and find the way from one to another."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, MemoryArgument, open_memory, print_table
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.api import SceneMemory
    from list3r.memory.core.records import Doorway, Room


def rooms(
    memory: MemoryArgument,
    name: Annotated[
        str | None, typer.Option("--name", metavar="ID=NAME", help="Name a room; ID= takes it away.")
    ] = None,
    path: Annotated[
        str | None, typer.Option("--path", metavar="ROOM,ROOM", help="The way from one room to another.")
    ] = None,
    author: Annotated[
        str | None, typer.Option("--author", metavar="NAME", help="Author of the name; default: you.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the rooms with what is in them and their doorways, name one, or find the way between two.

    Example: list3r rooms house.l3r --name "2=guest room"
    """
    from list3r.api import open as open_scene
    from list3r.queries.rooms import NO_ROOMS

    if name is not None:
        room, found, text = name.partition("=")
        if not found or not room.strip().isdigit():
            raise OptionError(f"--name {name!r}: give the number of a room and its name, such as 2=bedroom")
        with open_scene(memory, writable=True) as scene:
            report = scene.name_room(int(room), text.strip() or None, author=author)
        if json:
            print_answer([report.as_dict()])
        else:
            say(report.text)
        return
    with open_memory(memory) as scene:
        if path is not None:
            start, found, end = path.partition(",")
            if not found:
                raise OptionError(f"--path {path!r}: give two rooms, such as 2,kitchen")
            _print_way(scene, start.strip(), end.strip(), json)
            return
        listed, doorways = scene.rooms(), scene.doorways()
        if json:
            print_answer([_entry(r, doorways) for r in listed])
            return
        if not listed:
            say(f"no rooms: {NO_ROOMS}")
            return
        unit = scene.units
        parts = [i.component for i in scene]
    rows = []
    for r in listed:
        doors = ", ".join(f"{d.b if d.a == r.id else d.a}" for d in doorways if r.id in (d.a, d.b))
        what = "; ".join(x for x in (r.reason, r.partial and f"partial: {r.partial}") if x)
        rows.append([r.id, r.name or "", r.floor, f"{r.area:.1f}", len(r.instances), doors, what])
    print_table(rows, ["room", "name", "floor", f"area ({unit}2)", "things", "doorways to", "why"])
    if apart := sum(n != min(parts) for n in parts):
        say(f"{apart} things are in parts that were not joined to the first one; of these up is not known, nor rooms")


def _print_way(scene: SceneMemory, start: str, end: str, json: bool) -> None:
    from list3r.memory.library.rooms.naming import title

    way = scene.room_path(start, end)
    if json:
        print_answer([_entry(r, way.doorways) for r in way.rooms])
        return
    say(" -> ".join(title(r) for r in way.rooms))
    for a, d in zip(way.rooms, way.doorways, strict=False):
        x, y, _ = d.position
        say(f"from {title(a)} through the doorway at {x:.2f}, {y:.2f}, {d.width:.2f} {scene.units} wide")


def _entry(room: Room, doorways: Any) -> dict[str, Any]:
    ways: list[Doorway] = [d for d in doorways if room.id in (d.a, d.b)]
    return {
        "id": room.id,
        "name": room.name,
        "reason": room.reason,
        "floor": room.floor,
        "floor_z": round(room.floor_z, 4),
        "area": round(room.area, 3),
        "partial": room.partial or None,
        "outline": room.outline.round(4).tolist(),
        "instances": list(room.instances),
        "doorways": [
            {"to": d.b if d.a == room.id else d.a, "position": d.position.round(4).tolist(), "width": round(d.width, 3)}
            for d in ways
        ],
    }
