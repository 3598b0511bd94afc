"""Options that the questions share, and how places are read from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from list3r.cli.common import parse_point

OptionalId = Annotated[
    int | None, typer.Argument(metavar="[ID]", help="The instance, by any id it ever had.", show_default=False)
]
Catalogue = Annotated[
    str | None,
    typer.Option("--catalog", metavar="URL", help="Ask a catalogue; MEMORY is a name in it, or @all."),
]
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
Session = Annotated[int | None, typer.Option("--session", help="The session of the frame or camera.")]
MaxDepth = Annotated[float | None, typer.Option("--max-depth", help="How far the camera sees.")]


def id_or_words(text: str | None) -> tuple[int | None, str | None]:
    """Return an argument as an id, where it is a number, or as words."""
    if text is None:
        return None, None
    return (int(text), None) if text.isascii() and text.isdecimal() else (None, text)


def region(
    box: str | None, point: str | None, radius: float | None, *, camera: bool
) -> dict[str, Sequence[float] | float]:
    """Return a box or a sphere, nothing for what a camera sees. Raises `OptionError` unless there is one of them."""
    from list3r.memory.core.errors import OptionError

    sphere = point is not None or radius is not None
    if (box is not None) + sphere + camera > 1:
        raise OptionError("give one region: --box, --point with --radius, --view or --pose")
    if box is not None:
        parts = box.split(",")
        if len(parts) != 6:
            raise OptionError(f"--box {box!r}: give six numbers separated by commas, the lower and the upper corner")
        lower, upper = (parse_point(",".join(half), "--box") for half in (parts[:3], parts[3:]))
        return {"lower": lower, "upper": upper}
    if point is not None and radius is not None:
        return {"center": parse_point(point, "--point"), "radius": radius}
    if not camera:
        raise OptionError("give a region: --box x,y,z,x,y,z, --point x,y,z with --radius, --view FRAME or --pose")
    return {}


def corners(box: str | None) -> tuple[float, float, float, float] | None:
    """Return the box `120,80,180,150` of a picture, px. Raises `OptionError`."""
    from list3r.memory.core.errors import OptionError

    if box is None:
        return None
    try:
        x0, y0, x1, y1 = (float(part) for part in box.split(","))
    except ValueError:
        raise OptionError(f"--box {box!r}: give four numbers x0,y0,x1,y1, such as 120,80,180,150") from None
    return x0, y0, x1, y1
