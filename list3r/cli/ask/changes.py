"""changes: changes between sessions."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import AtOption, JsonOption, MemoryArgument, in_column, open_memory, print_table
from list3r.cli.terminal import note


def changes(
    memory: MemoryArgument,
    since: Annotated[
        int | None, typer.Option("--since", metavar="SESSION", help="Only changes after this session.")
    ] = None,
    seen_again: Annotated[bool, typer.Option("--seen-again", help="Also instances that were found unchanged.")] = False,
    min_confidence: Annotated[
        float, typer.Option("--min-confidence", help="Only changes with at least this confidence.")
    ] = 0.0,
    json: JsonOption = False,
    at: AtOption = None,
) -> None:
    """The instances that were moved, removed or added between sessions, with frames that show it.

    Example: list3r changes house.l3r --since 1
    """
    from list3r.queries.changes import KINDS
    from list3r.queries.changes import changes as find

    with open_memory(memory, at=at) as scene:
        found = find(scene.store, since, KINDS if seen_again else KINDS[:3], min_confidence)
        alone = not found and len(scene.sessions()) < 2
        notes = ["the memory holds one session; `list3r update` adds a later one to compare with"] if alone else []
        if json:
            print_answer((_entry(c) for c in found), scene.lengths, notes)
            return
        note(*(f"note: {line}" for line in notes))
        rows = [
            [
                c.event.session_id,
                c.instance.id,
                c.event.kind.replace("_", " "),
                in_column(c.instance.label or c.instance.description),
                _place(c.event.from_box),
                _place(c.event.to_box),
                c.score,
                " ".join(str(frame) for _, frame in c.event.frames[:3]),
                c.reason,
            ]
            for c in found
        ]
        print_table(rows, ["session", "id", "change", "what", "from x y z", "to x y z", "confidence", "frames", "why"])


def _place(box: Any) -> str:
    return "" if box is None else " ".join(f"{v:.2f}" for v in box.center)


def _entry(changed: Any) -> dict[str, Any]:
    from list3r.cli.ask.memory import instance_dict

    event = changed.event
    return {
        "session": event.session_id,
        "kind": event.kind,
        "from": _box(event.from_box),
        "to": _box(event.to_box),
        "distance": changed.distance_m,
        "confidence": event.confidence,
        "reason": event.reason,
        "frames": [{"session": s, "frame": f} for s, f in event.frames],
        "instance": instance_dict(changed.instance),
    }


def _box(box: Any) -> dict[str, Any] | None:
    from list3r.memory.core.geometry import quat_wxyz_from_rotation

    if box is None:
        return None
    return {"center": box.center, "size": box.size, "quat_wxyz": quat_wxyz_from_rotation(box.rotation)}
