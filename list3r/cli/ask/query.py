"""query nearest, within, relations, similar, find, seen, path, changes."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.ask.arguments import (
    OF_APPEARANCE,
    CameraArguments,
    FilterArguments,
    NearArguments,
    RegionArguments,
    RelationArguments,
    SimilarArguments,
)
from list3r.cli.ask.changes import changes
from list3r.cli.ask.output import Count, Structure, camera_from, print_matches, print_relations
from list3r.cli.catalog.questions import with_catalog
from list3r.cli.common import AtOption, JsonOption, MemoryArgument, only, open_memory, print_table, spread
from list3r.cli.terminal import note, say


def nearest(
    memory: MemoryArgument,
    near: NearArguments,
    *,
    k: Count = 5,
    filters: FilterArguments,
    json: JsonOption = False,
    at: AtOption = None,
) -> None:
    """The instances nearest to a point or an instance, with distances of surfaces and of centres.

    Example: list3r query nearest house.l3r mug --point 0.5,1.2,0.8 -k 3
    """
    origin = near.origin()
    with open_memory(memory, filters.min_confidence, at) as scene:
        from list3r.queries.nearest import nearest as ask

        matches = ask(
            scene.store,
            words=near.words,
            point=origin,
            instance_id=near.id,
            k=k,
            max_distance=near.max_distance,
            encoder=None if near.words is None else scene.word_encoder(),
            **filters.options(),
        )
        print_matches(matches, scene.lengths, json)


def within(
    memory: MemoryArgument,
    region: RegionArguments,
    camera: Annotated[CameraArguments, only("view", "pose", "session", "max_depth")],
    *,
    occlusion: Annotated[bool, typer.Option(help="Leave out instances that others hide from the camera.")] = True,
    filters: Annotated[FilterArguments, only(*OF_APPEARANCE)],
    json: JsonOption = False,
    at: AtOption = None,
) -> None:
    """The instances inside a box or a sphere, or those that a camera sees.

    Example: list3r query within house.l3r --point 0,0,1 --radius 0.5
    """
    lengths: dict[str, Any] = region.lengths(camera)
    with open_memory(memory, filters.min_confidence, at) as scene:
        seen_by = camera_from(scene, camera)
        found = scene.within(
            **lengths, camera=seen_by, max_depth=camera.max_depth, occlusion=occlusion, **filters.options()
        )
        print_matches(found, scene.lengths, json, total=len(found))


def relations(memory: MemoryArgument, asked: RelationArguments, json: JsonOption = False, at: AtOption = None) -> None:
    """The relations between instances, by subject, predicate and object.

    Example: list3r query relations house.l3r --predicate left_of --object 4 --from camera
    """
    with open_memory(memory, at=at) as scene:
        print_relations(scene, scene.relations(**asdict(asked)), json)


def similar(
    memory: MemoryArgument,
    like: SimilarArguments,
    *,
    k: Count = 5,
    filters: Annotated[FilterArguments, only(*OF_APPEARANCE)],
    json: JsonOption = False,
    at: AtOption = None,
) -> None:
    """The instances most similar in appearance to one instance or to a picture.

    Example: list3r query similar house.l3r --image mug.jpg --box 120,80,180,150
    """
    from list3r.memory.core.errors import OptionError

    with open_memory(memory, filters.min_confidence, at) as scene:
        if (like.id is None) == (like.image is None) or (like.box is not None and like.image is None):
            raise OptionError("give a query: --id ID, or --image FILE, with --box for a part of it")
        if like.image is not None:
            found = scene.similar_to_picture(like.image, k, box_xyxy=like.corners(), **filters.options())
        else:
            assert like.id is not None
            found = scene.similar(like.id, k=k, **filters.options())
        print_matches(found, scene.lengths, json)


def find(
    memory: MemoryArgument,
    text: Annotated[
        str,
        typer.Argument(metavar="TEXT", help="Question or description, such as: where is the lamp?", show_default=False),
    ],
    k: Count = 5,
    viewpoint: Annotated[
        str | None,
        typer.Option("--from", metavar="ID|camera|X,Y,Z", help="Viewpoint of left, right, in front of and behind."),
    ] = None,
    json: JsonOption = False,
    at: AtOption = None,
) -> None:
    """The instances that a question is about, how many, or yes or no; an id can replace words.

    Example: list3r query find house.l3r "how many chairs are next to the table?"
    """
    with open_memory(memory, at=at) as scene:
        found, units = scene.find(text, k, viewpoint=viewpoint), scene.lengths
    if not json and (found.counted is not None or found.answer is not None):
        say(str(found.counted) if found.counted is not None else str(found.answer))
    print_matches(found, units, json, **found.facts())


def seen(
    memory: MemoryArgument,
    options: CameraArguments,
    instance_id: Annotated[int | None, typer.Argument(metavar="[ID]", help="When this instance was seen.")] = None,
    structure: Structure = False,
    json: JsonOption = False,
    at: AtOption = None,
) -> None:
    """When an instance was seen, or what was visible at a time, in a frame, or from a pose.

    Example: list3r query seen house.l3r --time 12.5
    """
    from list3r.memory.core.errors import OptionError

    with open_memory(memory, at=at) as scene:
        camera = camera_from(scene, options)
        if (camera is None) == (instance_id is None):
            raise OptionError("name an instance by its id, or a camera: --time S, --view FRAME or --pose")
        if camera is None and options.max_depth is not None:
            raise OptionError("--max-depth belongs to a camera; leave it out for an instance")
        if camera is not None:
            found = scene.visible(camera, max_depth=options.max_depth, structure=structure)
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
    json: JsonOption = False,
    at: AtOption = None,
) -> None:
    """The shortest chain of relations from one instance to another.

    Example: list3r query path house.l3r 12 4
    """
    with open_memory(memory, at=at) as scene:
        found = scene.path_between(start, end, structure=structure)
        print_relations(scene, found, json)


questions = typer.Typer(
    help="Find instances that are near, inside, visible, similar, related, described by words, or changed.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
for command in (nearest, within, relations, similar, find):
    questions.command(command.__name__)(with_catalog(spread(command)))
for other in (seen, path, changes):
    questions.command(other.__name__)(spread(other))
