"""Options and output of the query commands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.ask.memory import instance_dict
from list3r.cli.common import in_column, print_table
from list3r.cli.terminal import note, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from list3r.api import SceneMemory
    from list3r.cli.ask.arguments import CameraArguments
    from list3r.memory.core.records import BestView, Relation
    from list3r.memory.library.world.scale import Lengths
    from list3r.queries.match import Match
    from list3r.queries.relations import Relations
    from list3r.queries.views.camera import PosedCamera

Count = Annotated[int, typer.Option("-k", help="Most answers to return.")]
MinConfidence = Annotated[
    float | None,
    typer.Option(
        "--min-confidence",
        help="Everything with at least this confidence, also low-confidence segments (default: not listed).",
    ),
]
Structure = Annotated[bool, typer.Option("--structure", help="Also floor, walls, ceiling.")]
Label = Annotated[
    str | None,
    typer.Option("--label", metavar="WORDS", help="Only instances with one of these words in label or description."),
]
Color = Annotated[str | None, typer.Option("--color", metavar="COLOUR", help="Only instances of this colour.")]
MinSize = Annotated[float | None, typer.Option("--min-size", help="Only instances with at least this longest edge.")]
MaxSize = Annotated[float | None, typer.Option("--max-size", help="Only instances with at most this longest edge.")]
State = Annotated[
    str | None,
    typer.Option(
        "--state",
        metavar="present|moved|removed|added|unseen|any",
        help="Only instances in this state; default: all but removed.",
    ),
]
Component = Annotated[int | None, typer.Option("--component", help="Only this connected component.")]
Room = Annotated[
    str | None, typer.Option("--room", metavar="ROOM", help="Only what is in this room: its number or name.")
]
View = Annotated[
    int | None, typer.Option("--view", metavar="FRAME", help="Only instances that the camera of this frame sees.")
]
Time = Annotated[
    float | None,
    typer.Option("--time", metavar="S", help="The camera of the posed frame nearest to this time, seconds."),
]
Pose = Annotated[
    str | None,
    typer.Option(
        "--pose", metavar="X,Y,Z,QW,QX,QY,QZ", help="A camera at this position with this rotation (OpenCV axes)."
    ),
]
SessionOption = Annotated[int | None, typer.Option("--session", help="The session of the frame or camera.")]
MaxDepth = Annotated[float | None, typer.Option("--max-depth", help="How far the camera sees.")]


def camera_from(scene: SceneMemory, given: CameraArguments) -> PosedCamera | None:
    """The camera that the options name; None for none of them. Raises `OptionError`."""
    from list3r.memory.core.errors import OptionError

    view, time, pose, session = given.view, given.time, given.pose, given.session
    if sum(option is not None for option in (view, time, pose)) > 1:
        raise OptionError("name one camera: --view FRAME, --time S or --pose X,Y,Z,QW,QX,QY,QZ")
    if view is None and time is None and pose is None:
        if session is not None:
            raise OptionError(f"--session {session} needs a camera: --view FRAME, --time S or --pose; or leave it out")
        return None
    if pose is None:
        return scene.camera(frame=view, time_s=time, session=session)
    try:
        values = [float(part) for part in pose.split(",")]
    except ValueError:
        values = []
    if len(values) != 7 or not all(math.isfinite(v) for v in values):
        raise OptionError(f"--pose {pose!r}: give seven finite numbers separated by commas, x,y,z and w,x,y,z")
    return scene.camera(position=values[:3], quat_wxyz=values[3:], session=session)


def match_dict(match: Match) -> dict[str, Any]:
    """A match for machines: the instance, and how it answers; `view` only where the question was about a frame."""
    answer = {
        "score": match.score,
        "distance": match.distance_m,
        "center_distance": match.center_distance_m,
        "reason": match.reason,
        "view": view_dict(match.view),
    }
    return {**instance_dict(match.instance), **answer}


def view_dict(view: BestView | None) -> dict[str, Any] | None:
    """A frame with a box in it, for machines."""
    if view is None:
        return None
    return {"session": view.session_id, "frame": view.frame_index, "box_xyxy": list(view.box_xyxy)}


def print_matches(matches: Sequence[Match], units: Lengths | str, json: bool, **facts: Any) -> None:
    """Matches as a table, or as JSON with more facts; what is to be said of all of them goes to standard error."""
    notes, total = getattr(matches, "notes", ()), getattr(matches, "total", None)
    if json:
        print_answer(map(match_dict, matches), units, notes, **{"total": total, **facts})
        return
    note(*(f"note: {line}" for line in notes))
    if total is not None and total > len(matches):
        note(f"note: the best {len(matches)} of {total}; -k {total} shows all")
    placed = any(m.distance_m is not None or m.center_distance_m is not None for m in matches)
    if placed and not isinstance(units, str) and units.deviation is not None:
        note(f"note: lengths are about metres, a guess, give or take {units.deviation:.0%}")
    rows = [
        [
            m.instance.id,
            in_column(m.instance.label or m.instance.description),
            m.score,
            *((_length(m.distance_m), _length(m.center_distance_m)) if placed else ()),
            "" if m.best_view is None else m.best_view.frame_index,
            m.reason,
        ]
        for m in matches
    ]
    distances = (f"surface ({units})", f"centre ({units})") if placed else ()
    print_table(rows, ["id", "what", "score", *distances, "frame", "why"])


def print_relations(scene: SceneMemory, found: Relations, json: bool) -> None:
    """Relations with notes on the question as a whole."""
    names = {i.id: in_column(i.label or i.description) for i in scene.instances(structure=None)}
    gravity, units = scene.gravity, scene.lengths
    if json:
        notes = [found.reason] if found.reason else []
        print_answer(map(vars, found), units, notes, total=len(found), state=found.state, gravity=gravity)
        return
    if found.state == "unknown":
        say(f"unknown: {found.reason}")
        return
    rows = [
        [r.subject, names[r.subject], r.predicate, r.object, _object(r, names), r.confidence, r.margin] for r in found
    ]
    print_table(rows, ["id", "subject", "predicate", "id", "object", "conf", f"margin ({units})"])
    if found.reason:
        note(f"note: {found.reason}")


def _object(relation: Relation, names: dict[int, str]) -> str:
    """The object, or both objects of `between`."""
    other = getattr(relation, "other", None)
    return names[relation.object] + ("" if other is None else f" and {other} {names[other]}")


def _length(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
