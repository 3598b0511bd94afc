"""info, list, show: the content of a memory."""

from __future__ import annotations

import itertools
import math
from bisect import bisect
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import (
    AtOption,
    IdArgument,
    JsonOption,
    MemoryArgument,
    MinConfidence,
    in_column,
    open_memory,
    print_table,
)
from list3r.cli.terminal import note, say
from list3r.memory.core.errors import check_share

if TYPE_CHECKING:
    from list3r.memory.core.records import DetectedLabel, Instance, Relation
    from list3r.memory.library.world.scale import Lengths

_LEFT_OUT = ("beside", "units_per_metre", "metre_deviation", "gravity_deviation_deg")
"""What is not listed where there is nothing to say."""


def info(
    memory: MemoryArgument,
    loops: Annotated[
        bool,
        typer.Option(
            "--loops",
            help="List every loop candidate with scores, verdict and reason, and the uncertainty of every chunk.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Summarise a memory: sessions, frames, scale, gravity, instances, loops.

    Example: list3r info house.l3r --loops
    """
    from list3r.cli.ask.loops import loop_report, print_loop_report
    from list3r.queries.trust import path_in_words

    with open_memory(memory) as scene:
        report = scene.info()
        chunks = loop_report(scene.store) if loops else {}
        units = scene.lengths
    if json:
        print_answer([{**report, **chunks}], report.pop("units"))
        return
    for key, value in (report | {"trust": path_in_words(report["trust"], str(units))}).items():
        if key == "units_per_metre" and value is not None:
            say(f"{'a metre is about':20} {value:g} units, by depths and the height of the cameras (a guess)")
        elif key != "sessions" and (key, value) not in [(name, None) for name in _LEFT_OUT]:
            say(f"{key.replace('_', ' '):20} {', '.join(value) if isinstance(value, list) else value}")
    for session in report["sessions"]:
        say(f"{'session ' + str(session['id']):20} {session['frames']} frames, {session['state']}: {session['source']}")
    if loops:
        print_loop_report(chunks, str(units))


def list_instances(
    memory: MemoryArgument,
    structure: Annotated[bool, typer.Option("--structure", help="Also floor, walls, ceiling.")] = False,
    min_confidence: MinConfidence = None,
    at: AtOption = None,
    json: JsonOption = False,
) -> None:
    """List the instances with their place and size.

    Example: list3r list house.l3r --min-confidence 0.2
    """
    from list3r.memory.core.records import FIRST_SCRAP, FIRST_UNLISTED

    least = min_confidence or 0.0
    check_share("--min-confidence", least)
    with open_memory(memory, None if at is not None else min_confidence, at) as scene:
        found: list[Instance] = scene.instances(structure=None if structure else False)
        units = scene.lengths
    kept = [i for i in found if i.confidence >= least]
    kinds, starts = ("", "low-confidence", "unsure"), (FIRST_SCRAP, FIRST_UNLISTED)
    if json:
        print_answer(map(instance_dict, kept), units, total=len(found))
        return
    rows = [
        [
            i.id,
            in_column(i.label or i.description),
            _triple(i.center),
            _triple(i.box.size),
            i.confidence,
            i.observations,
            i.structure or ("dynamic" if i.dynamic else kinds[bisect(starts, i.id)]),
            "" if i.state == "present" else i.state,
        ]
        for i in kept
    ]
    print_table(
        rows, ["id", "what", f"centre x y z ({units})", f"size ({units})", "confidence", "frames", "kind", "state"]
    )
    if not rows and min_confidence is None and at is None:
        with open_memory(memory, 0.0) as scene:
            doubtful = len(scene.instances(structure=False))
        if doubtful:
            kind = "1 doubtful instance is" if doubtful == 1 else f"{doubtful} doubtful instances are"
            note(f"{kind} not listed: --min-confidence 0 shows all")


def _give_or_take(sigma: float | None, units: Lengths | str) -> str:
    """How sure a position is, where the memory can tell."""
    return "" if sigma is None else f", give or take {sigma:.2f} {units} against the start"


def _triple(values: Any) -> str:
    return " ".join(f"{v:6.2f}" for v in values)


def _place(values: Any) -> str:
    return "  ".join(f"{axis} {v:.2f}" for axis, v in zip("xyz", values, strict=True))


def show(
    memory: MemoryArgument,
    instance_id: IdArgument,
    json: JsonOption = False,
) -> None:
    """Show one instance: where it is, how big, when it was seen, and its main relation to each other instance.

    Example: list3r show house.l3r 12
    """
    from list3r.importers.base import imported_as
    from list3r.memory.library.labels import label_source
    from list3r.queries.path import telling

    with open_memory(memory) as scene:
        instance = scene.instance(instance_id)
        relations = scene.relations_of(instance.id)
        names = {i.id: i.label or i.description for i in scene.instances(structure=None)}
        aliases = scene.store.ids.aliases_of(instance.id)
        track = scene.track(instance.id) if instance.dynamic else None
        parts = [{"chunk": o.chunk_id, "local": o.local_id} for o in scene.store.observations.of(instance.id)]
        units = scene.lengths
        named = scene.store.detected_labels.all().get(instance.id)
        origin = imported_as(scene.store, instance.id)
    if json:
        related = [vars(r) for r in relations]
        extra = {"relations": related, "aliases": aliases, "observed_as": parts, "imported_as": origin}
        print_answer([{**instance_dict(instance, track), **label_source(instance, named), **extra}], units)
        return
    say(f"{instance.id}  {instance.label or instance.description}")
    count = len({part["chunk"] for part in parts})
    chunks = "1 chunk" if count == 1 else f"{count} chunks"
    for key, value in (
        ("centre", f"{_place(instance.center)} {units}{_give_or_take(instance.position_sigma_m, units)}"),
        ("size", f"{_triple(instance.box.size)} {units}"),
        ("confidence", f"{instance.confidence:.2f}, seen in {instance.observations} frames of {chunks}"),
        *(() if instance.label is None else (("named by", _named_by(instance, named)),)),
        ("seen", f"{instance.first_seen_s:.2f} s to {instance.last_seen_s:.2f} s, {instance.state}"),
        ("aliases", ", ".join(map(str, aliases)) or "none"),
        *(() if origin is None else (("imported", f"from {origin['format']} as {', '.join(origin['names'])}"),)),
        *(() if track is None else _track_lines(*track, units)),
    ):
        say(f"  {key:11} {value}")
    most: dict[frozenset[int], Relation] = {}
    for r in sorted(relations, key=telling):
        most.setdefault(frozenset((r.subject, r.object)), r)
    for r in most.values():
        subject, object_ = (f"{names.get(k, '?')} ({k})" for k in (r.subject, r.object))
        say(
            f"  {subject} {r.predicate.replace('_', ' ')} {object_}"
            f"  confidence {r.confidence:.2f}, margin {r.margin:.3f} {units}"
        )


def _named_by(instance: Instance, named: DetectedLabel | None) -> str:
    who = "an operator" if named is None else f"{named.detector}, confidence {named.confidence:.2f}"
    who += ", as no more than a kind of thing" if named is not None and named.level == "branch" else ""
    return f"{who}; it looks like {instance.description}"


def _track_lines(times_s: Any, places: Any, units: Lengths | str) -> list[tuple[str, str]]:
    """Fields of a moving thing: when, how far, from where to where."""
    if not len(times_s):
        return [("moved", "seen moving; where it was is not known")]
    way = sum(math.dist(a, b) for a, b in itertools.pairwise(places.tolist()))
    return [
        ("moved", f"{times_s[0]:.2f} s to {times_s[-1]:.2f} s, {way:.2f} {units} in {len(times_s)} frames"),
        ("from", f"{_place(places[0])} {units}"),
        ("to", f"{_place(places[-1])} {units}"),
    ]


def instance_dict(instance: Instance, track: tuple[Any, Any] | None = None) -> dict[str, Any]:
    """An instance in the words of the scene JSON, with its track where it is given."""
    from list3r.exporters.scene_json import instance_entry

    return instance_entry(instance, track=track)
