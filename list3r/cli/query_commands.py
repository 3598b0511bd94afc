"""query nearest, within, relations, similar."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.common import JsonOption, MemoryArgument, open_memory, parse_point, print_json, print_table
from list3r.cli.memory_commands import instance_dict

if TYPE_CHECKING:
    from list3r.queries.match import Match

Count = Annotated[int, typer.Option("-k", help="How many at most.")]
MinConfidence = Annotated[float, typer.Option("--min-confidence", help="Only instances at least this sure.")]
Structure = Annotated[bool, typer.Option("--structure", help="Also floor, walls, ceiling.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    query = typer.Typer(help="Ask a memory.", no_args_is_help=True, rich_markup_mode=None)
    query.command("nearest")(nearest)
    query.command("within")(within)
    query.command("relations")(relations)
    query.command("similar")(similar)
    app.add_typer(query, name="query")


def nearest(
    memory: MemoryArgument,
    words: Annotated[str | None, typer.Argument(metavar="[WORDS]", help="Words of a label or description.")] = None,
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Distance from this point.")] = None,
    id: Annotated[int | None, typer.Option("--id", metavar="ID", help="Distance from this instance.")] = None,
    k: Count = 5,
    max_distance: Annotated[float | None, typer.Option("--max-distance", help="Surfaces no further than this.")] = None,
    min_confidence: MinConfidence = 0.0,
    structure: Structure = False,
    json: JsonOption = False,
) -> None:
    """The things nearest to a point or an instance, or that words name; distances of surfaces and of centres.

    Example: list3r query nearest house.l3r mug --point 0.5,1.2,0.8 -k 3
    """
    filters: dict[str, Any] = {
        "k": k,
        "max_distance": max_distance,
        "min_confidence": min_confidence,
        "structure": structure,
    }
    with open_memory(memory) as scene:
        from list3r.memory.errors import OptionError
        from list3r.queries.nearest import nearest as find

        if words is None and point is None and id is None:
            raise OptionError("say what to be near to: --point x,y,z, --id ID, or words such as mug")
        origin = None if point is None else parse_point(point, "--point")
        matches = find(scene.store, words=words, point=origin, instance_id=id, **filters)
        _print_matches(matches, scene.units, json)


def within(
    memory: MemoryArgument,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X,Y,Z,X,Y,Z", help="Lower and upper corner of a box.")
    ] = None,
    point: Annotated[str | None, typer.Option("--point", metavar="X,Y,Z", help="Centre of a sphere.")] = None,
    radius: Annotated[float | None, typer.Option("--radius", help="Radius of the sphere.")] = None,
    min_confidence: MinConfidence = 0.0,
    structure: Structure = False,
    json: JsonOption = False,
) -> None:
    """The things inside a box or a sphere.

    Example: list3r query within house.l3r --point 0,0,1 --radius 0.5
    """
    from list3r.memory.errors import OptionError

    region: dict[str, Any] = {"min_confidence": min_confidence, "structure": structure}
    if box is not None and (point is not None or radius is not None):
        raise OptionError("give either --box or --point with --radius, not both")
    if box is not None:
        parts = box.split(",")
        region["lower"] = parse_point(",".join(parts[:3]), "--box")
        region["upper"] = parse_point(",".join(parts[3:]), "--box")
    elif point is not None and radius is not None:
        region |= {"center": parse_point(point, "--point"), "radius": radius}
    else:
        raise OptionError("give a region: --box x,y,z,x,y,z or --point x,y,z with --radius")
    with open_memory(memory) as scene:
        _print_matches(scene.within(**region), scene.units, json)


def relations(
    memory: MemoryArgument,
    subject: Annotated[int | None, typer.Option("--subject", metavar="ID", help="Who stands in the relation.")] = None,
    predicate: Annotated[
        str | None, typer.Option("--predicate", help="on, in, next_to, near, above, below, ...")
    ] = None,
    object: Annotated[int | None, typer.Option("--object", metavar="ID", help="To whom.")] = None,
    min_confidence: MinConfidence = 0.0,
    json: JsonOption = False,
) -> None:
    """Relations by any of subject, predicate and object.

    Example: list3r query relations house.l3r --predicate on --object 4
    """
    with open_memory(memory) as scene:
        from list3r.queries.relations import relations as find

        found = find(scene.store, subject=subject, predicate=predicate, object=object, min_confidence=min_confidence)
        names = {i.id: i.label or i.description for i in scene.instances(structure=None)}
        gravity, units = scene.gravity, scene.units
    if json:
        print_json({"gravity": gravity, "units": units, "relations": [vars(r) for r in found]})
        return
    rows = [
        [r.subject, names[r.subject], r.predicate, r.object, names[r.object], r.confidence, r.margin] for r in found
    ]
    print_table(rows, ["id", "subject", "predicate", "id", "object", "conf", f"margin ({units})"])


def similar(
    memory: MemoryArgument,
    id: Annotated[int, typer.Option("--id", metavar="ID", help="Things like this one.")],
    k: Count = 5,
    json: JsonOption = False,
) -> None:
    """The things that look most like one.

    Example: list3r query similar house.l3r --id 12
    """
    with open_memory(memory) as scene:
        _print_matches(scene.similar(id, k=k), scene.units, json)


def _print_matches(matches: list[Match], units: str, json: bool) -> None:
    if json:
        entries = [
            {
                "id": m.instance.id,
                "score": m.score,
                "distance": m.distance_m,
                "center_distance": m.center_distance_m,
                "units": units,
                "reason": m.reason,
                "instance": instance_dict(m.instance),
            }
            for m in matches
        ]
        print_json(entries)
        return
    rows = [
        [
            m.instance.id,
            m.instance.label or m.instance.description,
            m.score,
            _length(m.distance_m),
            _length(m.center_distance_m),
            m.reason,
        ]
        for m in matches
    ]
    print_table(rows, ["id", "what", "score", f"surface ({units})", f"centre ({units})", "why"])


def _length(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
