"""find, nearest, relations, similar, within, seen, path: questions to a memory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.ask import options as opt
from list3r.cli.ask.output import print_matches, print_relations
from list3r.cli.catalog import questions as many
from list3r.cli.common import AtOption, JsonOption, MemoryArgument, open_memory, parse_point, print_table
from list3r.cli.terminal import note, say
from list3r.memory.core.errors import OptionError


def find(
    context: typer.Context,
    memory: MemoryArgument,
    text: Annotated[
        str,
        typer.Argument(metavar="TEXT", help="Question or description, such as: where is the lamp?", show_default=False),
    ],
    k: opt.Count = 5,
    viewpoint: Annotated[
        str | None,
        typer.Option("--from", metavar="ID|camera|X,Y,Z", help="Viewpoint of left, right, in front of and behind."),
    ] = None,
    catalog: opt.Catalogue = None,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """The instances that a question is about, how many, or yes or no; an id can replace words.

    Example: list3r find house.l3r "how many chairs are next to the table?"
    """
    if catalog is not None:
        many.only_these(context, "text", "k")
        many.answer(catalog, memory, lambda c, name: c.find(text, name, k=k, filters=many.filters()), json)
        return
    with open_memory(memory, at=at) as scene:
        found, units = scene.find(text, k, viewpoint=viewpoint), scene.lengths
    if not json and (found.counted is not None or found.answer is not None):
        say(str(found.counted) if found.counted is not None else str(found.answer))
    print_matches(found, units, json, **found.facts())


def nearest(
    context: typer.Context,
    memory: MemoryArgument,
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="[ID|WORDS]",
            help="The instance to be near to, by any id it ever had; or words: only instances that they name.",
            show_default=False,
        ),
    ] = None,
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Distance from this point.")] = None,
    k: opt.Count = 5,
    max_distance: Annotated[
        float | None, typer.Option("--max-distance", help="Only instances whose surface is at most this far away.")
    ] = None,
    *,
    look: opt.Filtering,
    state: opt.State = None,
    component: opt.Component = None,
    room: opt.Room = None,
    catalog: opt.Catalogue = None,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """The instances nearest to an instance or a point, with distances of surfaces and of centres.

    Example: list3r nearest house.l3r 12 -k 3
    """
    if what is None and point is None:
        raise OptionError("give a place: an ID, --point x,y,z, or words such as mug")
    instance_id, words = opt.id_or_words(what)
    place = None if point is None else parse_point(point, "--point")
    if catalog is not None:
        many.only_these(context, "what", "point", "k", "min_confidence", "structure", "state")
        chosen = many.filters(look.min_confidence, structure=look.structure, state=state)
        many.answer(catalog, memory, lambda c, name: many.nearest(c, name, instance_id, place, words, k, chosen), json)
        return
    with open_memory(memory, look.min_confidence, at) as scene:
        from list3r.queries.nearest import nearest as ask

        matches = ask(
            scene.store,
            words=words,
            point=place,
            instance_id=instance_id,
            k=k,
            max_distance=max_distance,
            encoder=None if words is None else scene.word_encoder(),
            **look.filters(state=state, component=component, room=room),
        )
        print_matches(matches, scene.lengths, json)


def within(
    context: typer.Context,
    memory: MemoryArgument,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X,Y,Z,X,Y,Z", help="Lower and upper corner of a box.")
    ] = None,
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Centre of a sphere.")] = None,
    radius: Annotated[float | None, typer.Option("--radius", help="Radius of the sphere.")] = None,
    *,
    seen_by: Annotated[opt.CameraOptions, "view", "pose", "session", "max_depth"],
    occlusion: Annotated[bool, typer.Option(help="Leave out instances that others hide from the camera.")] = True,
    look: opt.Filtering,
    catalog: opt.Catalogue = None,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """The instances inside a box or a sphere, or those that a camera sees.

    Example: list3r within house.l3r --point 0,0,1 --radius 0.5
    """
    region: dict[str, Any] = opt.region(box, point, radius, camera=seen_by.view is not None or seen_by.pose is not None)
    if catalog is not None:
        many.only_these(context, "box", "point", "radius", "min_confidence", "structure")
        chosen = many.filters(look.min_confidence, structure=look.structure)
        many.answer(catalog, memory, lambda c, name: c.within(many.one(name), **region, filters=chosen), json)
        return
    with open_memory(memory, look.min_confidence, at) as scene:
        camera, far = seen_by.camera(scene), seen_by.max_depth
        found = scene.within(**region, camera=camera, max_depth=far, occlusion=occlusion, **look.filters())
        print_matches(found, scene.lengths, json, total=len(found))


def relations(
    context: typer.Context,
    memory: MemoryArgument,
    subject: Annotated[
        str | None,
        typer.Argument(metavar="[ID|WORDS]", help="First member of the relation: an id or words.", show_default=False),
    ] = None,
    predicate: Annotated[
        str | None,
        typer.Option(
            "--predicate",
            metavar="PREDICATE",
            help="on, supports, in, contains, above, below, under, next_to, near, attached_to, between; seen "
            "from --from: left_of, right_of, in_front_of, behind.",
        ),
    ] = None,
    object: Annotated[
        str | None, typer.Option("--object", metavar="ID|WORDS", help="Second member of the relation.")
    ] = None,
    other: Annotated[
        str | None, typer.Option("--and", metavar="ID|WORDS", help="For between: the other of the two instances.")
    ] = None,
    viewpoint: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="ID|camera|X,Y,Z",
            help="Viewpoint of left_of, right_of, in_front_of and behind: the centre of an instance, the last place of "
            "the camera (camera), its place in a frame (camera:FRAME), or a point. The view is towards the middle of "
            "the two instances.",
        ),
    ] = None,
    min_confidence: Annotated[
        float, typer.Option("--min-confidence", help="Only relations with at least this confidence.")
    ] = 0.0,
    catalog: opt.Catalogue = None,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """The relations between instances, by subject, predicate and object.

    Example: list3r relations house.l3r mug --predicate on --object table
    """
    if catalog is not None:
        many.only_these(context, "subject", "predicate", "object", "min_confidence")
        members = {"subject": subject, "predicate": predicate, "object": object}
        many.answer_relations(catalog, memory, members, min_confidence, json)
        return
    with open_memory(memory, at=at) as scene:
        found = scene.relations(
            subject=subject,
            predicate=predicate,
            object=object,
            other=other,
            viewpoint=viewpoint,
            min_confidence=min_confidence,
        )
        print_relations(scene, found, json)


def similar(
    context: typer.Context,
    memory: MemoryArgument,
    instance_id: opt.OptionalId = None,
    image: Annotated[Path | None, typer.Option("--image", metavar="FILE", help="Compare with this picture.")] = None,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X0,Y0,X1,Y1", help="Only the part of the picture in this box, px.")
    ] = None,
    k: opt.Count = 5,
    *,
    look: opt.Filtering,
    catalog: opt.Catalogue = None,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="With --catalog: compare with the instances of all memories.")
    ] = False,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """The instances most similar in appearance to one instance or to a picture.

    Example: list3r similar house.l3r --image mug.jpg --box 120,80,180,150
    """
    corners = opt.corners(box)
    if catalog is not None:
        many.only_these(context, "instance_id", "image", "box", "k", "min_confidence", "structure", "everywhere")
        chosen, like = many.filters(look.min_confidence, structure=look.structure), (instance_id, image, corners)
        many.answer(catalog, memory, lambda c, name: many.similar(c, name, like, k, chosen, everywhere), json)
        return
    if everywhere:
        raise OptionError("--everywhere needs --catalog URL")
    if (instance_id is None) == (image is None) or (box is not None and image is None):
        raise OptionError("give a query: an ID, or --image FILE, with --box for a part of it")
    with open_memory(memory, look.min_confidence, at) as scene:
        if image is not None:
            found = scene.similar_to_picture(image, k, box_xyxy=corners, **look.filters())
        else:
            assert instance_id is not None
            found = scene.similar(instance_id, k=k, **look.filters())
        print_matches(found, scene.lengths, json)


def seen(
    memory: MemoryArgument,
    instance_id: Annotated[int | None, typer.Argument(metavar="[ID]", help="When this instance was seen.")] = None,
    *,
    seen_by: opt.CameraOptions,
    structure: Annotated[bool, typer.Option("--structure", help="Also floor, walls, ceiling.")] = False,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """When an instance was seen, or what was visible at a time, in a frame, or from a pose.

    Example: list3r seen house.l3r --time 12.5
    """
    with open_memory(memory, at=at) as scene:
        camera, max_depth = seen_by.camera(scene), seen_by.max_depth
        if (camera is None) == (instance_id is None):
            raise OptionError("name an instance by its id, or a camera: --time S, --view FRAME or --pose")
        if camera is None and max_depth is not None:
            raise OptionError("--max-depth belongs to a camera; leave it out for an instance")
        if camera is not None:
            found = scene.visible(camera, max_depth=max_depth, structure=structure)
            if camera.frame is not None and not json:
                note(f"frame {camera.frame.frame_index} of session {camera.session_id}, {camera.frame.time_s:.2f} s")
            print_matches(found, scene.lengths, json, total=len(found))
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
    start: Annotated[int, typer.Argument(metavar="ID", help="First instance.", show_default=False)],
    end: Annotated[int, typer.Argument(metavar="ID", help="Second instance.", show_default=False)],
    structure: Annotated[bool, typer.Option(help="Allow paths over floor and walls.")] = True,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """The shortest chain of relations from one instance to another.

    Example: list3r path house.l3r 12 4
    """
    with open_memory(memory, at=at) as scene:
        found = scene.path_between(start, end, structure=structure)
        print_relations(scene, found, json)
