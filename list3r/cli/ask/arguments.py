"""Groups of options that the query commands share or that one of them has many of; see `list3r.cli.common.spread`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli.ask.output import (
    Color,
    Component,
    Label,
    MaxDepth,
    MaxSize,
    MinConfidence,
    MinSize,
    Pose,
    Room,
    SessionOption,
    State,
    Structure,
    Time,
    View,
)
from list3r.cli.common import parse_point

if TYPE_CHECKING:
    from list3r.queries.match import FilterOptions

OF_APPEARANCE = ("label", "color", "min_size", "max_size", "min_confidence", "structure")
"""The filters of questions that do not ask for a state or a component."""


@dataclass(frozen=True)
class FilterArguments:
    """Which instances may answer."""

    label: Label = None
    color: Color = None
    min_size: MinSize = None
    max_size: MaxSize = None
    min_confidence: MinConfidence = None
    state: State = None
    component: Component = None
    room: Room = None
    structure: Structure = False

    def options(self) -> FilterOptions:
        """Return them as the questions of Python take them."""
        return {
            "label": self.label,
            "color": self.color,
            "min_size": self.min_size,
            "max_size": self.max_size,
            "min_confidence": self.min_confidence or 0.0,
            "state": self.state,
            "component": self.component,
            "room": self.room,
            "structure": self.structure,
        }


@dataclass(frozen=True)
class NearArguments:
    """Reference of the distances."""

    words: Annotated[str | None, typer.Argument(metavar="[WORDS]", help="Only instances that these words name.")] = None
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Distance from this point.")] = None
    id: Annotated[int | None, typer.Option("--id", metavar="ID", help="Distance from this instance.")] = None
    max_distance: Annotated[
        float | None, typer.Option("--max-distance", help="Only instances whose surface is at most this far away.")
    ] = None

    def origin(self) -> tuple[float, float, float] | None:
        """Return the point. Raises `OptionError` where no point, id or words are given, or an invalid point."""
        from list3r.memory.core.errors import OptionError

        if self.words is None and self.point is None and self.id is None:
            raise OptionError("give a place: --point x,y,z, --id ID, or words such as mug")
        return None if self.point is None else parse_point(self.point, "--point")


@dataclass(frozen=True)
class CameraArguments:
    """A camera: that of a frame, or one put somewhere."""

    time: Time = None
    view: View = None
    pose: Pose = None
    session: SessionOption = None
    max_depth: MaxDepth = None


@dataclass(frozen=True)
class RegionArguments:
    """A box, or a sphere."""

    box: Annotated[
        str | None, typer.Option("--box", metavar="X,Y,Z,X,Y,Z", help="Lower and upper corner of a box.")
    ] = None
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Centre of a sphere.")] = None
    radius: Annotated[float | None, typer.Option("--radius", help="Radius of the sphere.")] = None

    def lengths(self, camera: CameraArguments) -> dict[str, Sequence[float] | float]:
        """Return the region, nothing for that of a camera. Raises `OptionError` unless there is one of them."""
        from list3r.memory.core.errors import OptionError

        sphere = self.point is not None or self.radius is not None
        if (self.box is not None) + sphere + (camera.view is not None) + (camera.pose is not None) > 1:
            raise OptionError("give one region: --box, --point with --radius, --view or --pose")
        if self.box is not None:
            parts = self.box.split(",")
            if len(parts) != 6:
                raise OptionError(
                    f"--box {self.box!r}: give six numbers separated by commas, the lower and the upper corner"
                )
            lower, upper = (parse_point(",".join(half), "--box") for half in (parts[:3], parts[3:]))
            return {"lower": lower, "upper": upper}
        if self.point is not None and self.radius is not None:
            return {"center": parse_point(self.point, "--point"), "radius": self.radius}
        if camera.view is None and camera.pose is None:
            raise OptionError("give a region: --box x,y,z,x,y,z, --point x,y,z with --radius, --view FRAME or --pose")
        return {}


@dataclass(frozen=True)
class RelationArguments:
    """Wanted relations, and the viewpoint."""

    subject: Annotated[
        str | None, typer.Option("--subject", metavar="ID|WORDS", help="First member of the relation: an id or words.")
    ] = None
    predicate: Annotated[
        str | None,
        typer.Option(
            "--predicate",
            metavar="PREDICATE",
            help="on, supports, in, contains, above, below, under, next_to, near, attached_to, between; seen "
            "from --from: left_of, right_of, in_front_of, behind.",
        ),
    ] = None
    object: Annotated[
        str | None, typer.Option("--object", metavar="ID|WORDS", help="Second member of the relation.")
    ] = None
    other: Annotated[
        str | None, typer.Option("--and", metavar="ID|WORDS", help="For between: the other of the two instances.")
    ] = None
    viewpoint: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="ID|camera|X,Y,Z",
            help="Viewpoint of left_of, right_of, in_front_of and behind: the centre of an instance, the last place of "
            "the camera (camera), its place in a frame (camera:FRAME), or a point. The view is towards the middle of "
            "the two instances.",
        ),
    ] = None
    min_confidence: Annotated[
        float, typer.Option("--min-confidence", help="Only relations with at least this confidence.")
    ] = 0.0


@dataclass(frozen=True)
class SimilarArguments:
    """Query of a comparison."""

    id: Annotated[int | None, typer.Option("--id", metavar="ID", help="Compare with this instance.")] = None
    image: Annotated[Path | None, typer.Option("--image", metavar="FILE", help="Compare with this picture.")] = None
    box: Annotated[
        str | None, typer.Option("--box", metavar="X0,Y0,X1,Y1", help="Only the part of the picture in this box, px.")
    ] = None

    def corners(self) -> tuple[float, float, float, float] | None:
        """Return the box `120,80,180,150`. Raises `OptionError`."""
        from list3r.memory.core.errors import OptionError

        if self.box is None:
            return None
        try:
            x0, y0, x1, y1 = (float(part) for part in self.box.split(","))
        except ValueError:
            raise OptionError(f"--box {self.box!r}: give four numbers x0,y0,x1,y1, such as 120,80,180,150") from None
        return x0, y0, x1, y1
