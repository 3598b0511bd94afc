"""query nearest, within, relations, similar, find, seen, path."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.ask.output import (
    Color,
    Component,
    Count,
    Label,
    MaxDepth,
    MaxSize,
    MinConfidence,
    MinSize,
    Pose,
    SessionOption,
    State,
    Structure,
    Time,
    View,
    camera_from,
    print_matches,
    print_relations,
)
from list3r.cli.common import JsonOption, MemoryArgument, note, open_memory, parse_point, print_table
from list3r.cli.terminal import say

query_app = typer.Typer(help="Ask a memory.", no_args_is_help=True, rich_markup_mode=None)
"""The group that the commands of questions belong to."""


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    for command in (nearest, within, relations, similar, find, seen, path):
        query_app.command(command.__name__)(command)
    app.add_typer(query_app, name="query")


def nearest(
    memory: MemoryArgument,
    words: Annotated[str | None, typer.Argument(metavar="[WORDS]", help="Words of a label or description.")] = None,
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Distance from this point.")] = None,
    id: Annotated[int | None, typer.Option("--id", metavar="ID", help="Distance from this instance.")] = None,
    k: Count = 5,
    max_distance: Annotated[float | None, typer.Option("--max-distance", help="Surfaces no further than this.")] = None,
    label: Label = None,
    color: Color = None,
    min_size: MinSize = None,
    max_size: MaxSize = None,
    min_confidence: MinConfidence = 0.0,
    state: State = None,
    component: Component = None,
    structure: Structure = False,
    json: JsonOption = False,
) -> None:
    """The things nearest to a point or an instance, or that words name; distances of surfaces and of centres.

    Example: list3r query nearest house.l3r mug --point 0.5,1.2,0.8 -k 3
    """
    filters: dict[str, Any] = {
        "k": k,
        "max_distance": max_distance,
        "label": label,
        "color": color,
        "min_size": min_size,
        "max_size": max_size,
        "min_confidence": min_confidence,
        "state": state,
        "component": component,
        "structure": structure,
    }
    with open_memory(memory) as scene:
        from list3r.memory.errors import OptionError
        from list3r.queries.nearest import nearest as ask

        if words is None and point is None and id is None:
            raise OptionError("say what to be near to: --point x,y,z, --id ID, or words such as mug")
        origin = None if point is None else parse_point(point, "--point")
        encoder = None if words is None else scene.word_encoder()
        matches = ask(scene.store, words=words, point=origin, instance_id=id, encoder=encoder, **filters)
        print_matches(matches, scene.units, json)


def within(
    memory: MemoryArgument,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X,Y,Z,X,Y,Z", help="Lower and upper corner of a box.")
    ] = None,
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Centre of a sphere.")] = None,
    radius: Annotated[float | None, typer.Option("--radius", help="Radius of the sphere.")] = None,
    view: View = None,
    pose: Pose = None,
    session: SessionOption = None,
    max_depth: MaxDepth = None,
    occlusion: Annotated[bool, typer.Option(help="Whether a camera does not see what other things hide.")] = True,
    label: Label = None,
    color: Color = None,
    min_size: MinSize = None,
    max_size: MaxSize = None,
    min_confidence: MinConfidence = 0.0,
    structure: Structure = False,
    json: JsonOption = False,
) -> None:
    """The things inside a box, a sphere, or what a camera sees.

    Example: list3r query within house.l3r --point 0,0,1 --radius 0.5
    """
    from list3r.memory.errors import OptionError

    region: dict[str, Any] = {
        "max_depth": max_depth,
        "occlusion": occlusion,
        "label": label,
        "color": color,
        "min_size": min_size,
        "max_size": max_size,
        "min_confidence": min_confidence,
        "structure": structure,
    }
    sphere = point is not None or radius is not None
    if (box is not None) + sphere + (view is not None) + (pose is not None) > 1:
        raise OptionError("give one region: --box, --point with --radius, --view or --pose")
    if box is not None:
        parts = box.split(",")
        if len(parts) != 6:
            raise OptionError(f"--box {box!r}: six numbers with commas are needed, the lower and the upper corner")
        region["lower"] = parse_point(",".join(parts[:3]), "--box")
        region["upper"] = parse_point(",".join(parts[3:]), "--box")
    elif point is not None and radius is not None:
        region |= {"center": parse_point(point, "--point"), "radius": radius}
    elif view is None and pose is None:
        raise OptionError("give a region: --box x,y,z,x,y,z, --point x,y,z with --radius, --view FRAME or --pose")
    with open_memory(memory) as scene:
        region["camera"] = camera_from(scene, view, None, pose, session)
        found = scene.within(**region)
        print_matches(found, scene.units, json, total=len(found))


def relations(
    memory: MemoryArgument,
    subject: Annotated[
        str | None, typer.Option("--subject", metavar="ID|WORDS", help="Who stands in the relation.")
    ] = None,
    predicate: Annotated[
        str | None, typer.Option("--predicate", help="on, in, next_to, near, above, left_of, behind, between, ...")
    ] = None,
    object: Annotated[str | None, typer.Option("--object", metavar="ID|WORDS", help="To whom.")] = None,
    other: Annotated[
        str | None, typer.Option("--and", metavar="ID|WORDS", help="The second object of between.")
    ] = None,
    viewpoint: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="ID|camera|X,Y,Z",
            help="Who looks, for left_of, right_of, in_front_of and behind: from the centre of an instance, from "
            "where the camera was last (camera) or in a frame (camera:FRAME), or from a point; towards the middle "
            "of the two.",
        ),
    ] = None,
    min_confidence: MinConfidence = 0.0,
    json: JsonOption = False,
) -> None:
    """Relations by any of subject, predicate and object; unknown where the memory cannot tell.

    Example: list3r query relations house.l3r --predicate left_of --object 4 --from camera
    """
    with open_memory(memory) as scene:
        found = scene.relations(subject, predicate, object, min_confidence, viewpoint=viewpoint, other=other)
        print_relations(scene, found, json)


def similar(
    memory: MemoryArgument,
    id: Annotated[int | None, typer.Option("--id", metavar="ID", help="Things like this one.")] = None,
    image: Annotated[
        Path | None, typer.Option("--image", metavar="FILE", help="Things like what this picture shows.")
    ] = None,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X0,Y0,X1,Y1", help="Only what is in this box of the picture, px.")
    ] = None,
    k: Count = 5,
    label: Label = None,
    color: Color = None,
    min_size: MinSize = None,
    max_size: MaxSize = None,
    min_confidence: MinConfidence = 0.0,
    structure: Structure = False,
    json: JsonOption = False,
) -> None:
    """The things that look most like one of them, or like a picture.

    Example: list3r query similar house.l3r --image mug.jpg --box 120,80,180,150
    """
    from list3r.memory.errors import OptionError

    filters: dict[str, Any] = {
        "label": label,
        "color": color,
        "min_size": min_size,
        "max_size": max_size,
        "min_confidence": min_confidence,
        "structure": structure,
    }
    with open_memory(memory) as scene:
        if (id is None) == (image is None) or (box is not None and image is None):
            raise OptionError("say what to compare with: --id ID, or --image FILE, with --box for a part of it")
        if image is not None:
            corners = None if box is None else _parse_box(box)
            found = scene.similar_to_picture(image, k, box_xyxy=corners, **filters)
        else:
            assert id is not None
            found = scene.similar(id, k=k, **filters)
        print_matches(found, scene.units, json)


def _parse_box(text: str) -> tuple[float, float, float, float]:
    """`120,80,180,150`. Raises `OptionError`."""
    from list3r.memory.errors import OptionError

    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise OptionError(f"--box {text!r}: four numbers x0,y0,x1,y1 are needed, such as 120,80,180,150") from None
    return x0, y0, x1, y1


def find(
    memory: MemoryArgument,
    text: Annotated[str, typer.Argument(metavar="TEXT", help="What it is and how it stands.", show_default=False)],
    k: Count = 5,
    viewpoint: Annotated[
        str | None,
        typer.Option("--from", metavar="ID|camera|X,Y,Z", help="Who looks, for left, right, in front of and behind."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """The things that a text describes: attributes, a noun, relations; ids may stand for things.

    Example: list3r query find house.l3r "white mug on table"
    """
    with open_memory(memory) as scene:
        found, units = scene.find(text, k, viewpoint=viewpoint), scene.units
    print_matches(found, units, json, ambiguous=found.ambiguous, unknown_words=found.unknown_words)


def seen(
    memory: MemoryArgument,
    instance_id: Annotated[int | None, typer.Argument(metavar="[ID]", help="When this instance was seen.")] = None,
    time: Time = None,
    view: View = None,
    pose: Pose = None,
    session: SessionOption = None,
    max_depth: MaxDepth = None,
    structure: Structure = False,
    json: JsonOption = False,
) -> None:
    """When an instance was seen, or what was to be seen at a time, in a frame, or from a pose.

    Example: list3r query seen house.l3r --time 12.5
    """
    from list3r.memory.errors import OptionError

    with open_memory(memory) as scene:
        camera = camera_from(scene, view, time, pose, session)
        if (camera is None) == (instance_id is None):
            raise OptionError("name an instance by its id, or a camera: --time S, --view FRAME or --pose")
        if camera is None and max_depth is not None:
            raise OptionError("--max-depth is how far a camera sees; leave it out where an instance is named")
        if camera is not None:
            found = scene.visible(camera, max_depth=max_depth, structure=structure)
            if camera.frame is not None and not json:
                note(f"frame {camera.frame.frame_index} of session {camera.session_id}, {camera.frame.time_s:.2f} s")
            print_matches(found, scene.units, json, total=len(found))
            return
        assert instance_id is not None
        sightings = scene.seen(instance_id)
        name = scene.instance(sightings.instance_id)
    spans = [{"session": n, "from_s": start, "to_s": end} for n, start, end in sightings.spans_s]
    if json:
        frames = [
            {
                "session": f.session_id,
                "frame": f.frame_index,
                "time_s": f.time_s,
                "box_xyxy": list(f.box_xyxy),
                "visible": f.visible_fraction,
            }
            for f in sightings.frames
        ]
        print_answer([{"id": sightings.instance_id, "spans": spans, "frames": frames}])
        return
    say(f"{name.id}  {name.label or name.description}: seen in {len(sightings.frames)} frames")
    rows = []
    for s in spans:
        inside = [
            f.frame_index
            for f in sightings.frames
            if f.session_id == s["session"] and s["from_s"] <= f.time_s <= s["to_s"]
        ]
        rows.append([s["session"], f"{s['from_s']:.2f}", f"{s['to_s']:.2f}", inside[0], inside[-1], len(inside)])
    print_table(rows, ["session", "from (s)", "to (s)", "first frame", "last frame", "frames"])


def path(
    memory: MemoryArgument,
    start: Annotated[int, typer.Argument(metavar="ID", help="From this instance.", show_default=False)],
    end: Annotated[int, typer.Argument(metavar="ID", help="To this one.", show_default=False)],
    structure: Annotated[bool, typer.Option(help="Whether the way may lead over floor and walls.")] = True,
    json: JsonOption = False,
) -> None:
    """How two things hang together: the fewest relations that lead from one to the other.

    Example: list3r query path house.l3r 12 4
    """
    with open_memory(memory) as scene:
        found = scene.path_between(start, end, structure=structure)
        print_relations(scene, found, json)
