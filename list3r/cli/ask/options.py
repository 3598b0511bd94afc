"""Options that the questions share, and how places are read from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Unpack

import typer

from list3r.cli.common import MIN_CONFIDENCE, parse_point
from list3r.memory.core.errors import OptionError
from list3r.pipeline.request import option

if TYPE_CHECKING:
    from list3r.api import SceneMemory
    from list3r.queries.match import FilterOptions
    from list3r.queries.views.camera import PosedCamera

OptionalId = Annotated[
    int | None, typer.Argument(metavar="[ID]", help="The instance, by any id it ever had.", show_default=False)
]
Catalogue = Annotated[
    str | None,
    typer.Option("--catalog", metavar="URL", help="Ask a catalogue; MEMORY is a name in it, or @all."),
]
Count = Annotated[int, typer.Option("-k", help="Most answers to return.")]
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


@dataclass(frozen=True)
class Filtering:
    """Which instances may answer."""

    label: str | None = option(None, "Only instances with one of these words in label or description.", "WORDS")
    color: str | None = option(None, "Only instances of this colour.", "COLOUR")
    min_size: float | None = option(None, "Only instances with at least this longest edge.")
    max_size: float | None = option(None, "Only instances with at most this longest edge.")
    min_confidence: float | None = option(None, MIN_CONFIDENCE)
    structure: bool = option(False, "Also floor, walls, ceiling.")

    def filters(self, **more: Unpack[FilterOptions]) -> FilterOptions:
        """Return these filters and more as the questions of Python take them."""
        return {**vars(self), "min_confidence": self.min_confidence or 0.0, **more}  # type: ignore[typeddict-item]


@dataclass(frozen=True)
class CameraOptions:
    """The camera that a question looks from."""

    view: int | None = option(None, "Only instances that the camera of this frame sees.", "FRAME")
    time: float | None = option(None, "The camera of the posed frame nearest to this time, seconds.", "S")
    pose: str | None = option(None, "A camera at this position with this rotation (OpenCV axes).", "X,Y,Z,QW,QX,QY,QZ")
    session: int | None = option(None, "The session of the frame or camera.")
    max_depth: float | None = option(None, "How far the camera sees.")

    def camera(self, scene: SceneMemory) -> PosedCamera | None:
        """Return the camera that is named; None for none. Raises `OptionError`."""
        if sum(x is not None for x in (self.view, self.time, self.pose)) > 1:
            raise OptionError("name one camera: --view FRAME, --time S or --pose X,Y,Z,QW,QX,QY,QZ")
        if self.view is None and self.time is None and self.pose is None:
            if self.session is not None:
                said = f"--session {self.session} needs a camera: --view FRAME, --time S or --pose"
                raise OptionError(f"{said}; or leave it out")
            return None
        if self.pose is None:
            return scene.camera(frame=self.view, time_s=self.time, session=self.session)
        try:
            values = [float(part) for part in self.pose.split(",")]
        except ValueError:
            values = []
        if len(values) != 7 or not all(math.isfinite(v) for v in values):
            said = "give seven finite numbers separated by commas, x,y,z and w,x,y,z"
            raise OptionError(f"--pose {self.pose!r}: {said}")
        return scene.camera(position=values[:3], quat_wxyz=values[3:], session=self.session)


def id_or_words(text: str | None) -> tuple[int | None, str | None]:
    """Return an argument as an id, where it is a number, or as words."""
    if text is None:
        return None, None
    return (int(text), None) if text.isascii() and text.isdecimal() else (None, text)


def region(
    box: str | None, point: str | None, radius: float | None, *, camera: bool
) -> dict[str, Sequence[float] | float]:
    """Return a box or a sphere, nothing for what a camera sees. Raises `OptionError` unless there is one of them."""
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
    if box is None:
        return None
    try:
        x0, y0, x1, y1 = (float(part) for part in box.split(","))
    except ValueError:
        raise OptionError(f"--box {box!r}: give four numbers x0,y0,x1,y1, such as 120,80,180,150") from None
    return x0, y0, x1, y1
