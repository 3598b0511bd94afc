"""The questions of `query` for a catalogue: `--catalog URL`, in one memory or over all."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import in_column, parse_point, print_table
from list3r.cli.terminal import note, say

if TYPE_CHECKING:
    from list3r.catalog import Catalog
    from list3r.catalog.records import CatalogAnswers, CatalogFilters

ALL = "@all"
"""In the place of the memory: all memories of the catalogue."""
_LISTED = {
    "nearest": ("words", "point", "id", "k", "min_confidence", "state", "structure"),
    "within": ("box", "point", "radius", "min_confidence", "structure"),
    "find": ("text", "k"),
    "similar": ("id", "image", "box", "k", "min_confidence", "structure", "everywhere"),
    "relations": ("subject", "predicate", "object", "min_confidence"),
}
"""By question, the arguments that a catalogue can answer."""
_MOST_RELATIONS = 1000
Arguments = dict[str, Any]


def with_catalog(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return the same command with `--catalog URL`, which asks a catalogue about the memory of that name instead."""
    name = command.__name__
    signature = inspect.signature(command, eval_str=True)
    option = Annotated[
        str | None,
        typer.Option("--catalog", metavar="URL", help=f"Ask a catalogue; MEMORY is a name in it, or {ALL}."),
    ]
    everywhere = Annotated[
        bool, typer.Option("--everywhere", help="With --catalog: compare with the instances of all memories.")
    ]
    kinds: dict[str, Any] = {"catalog": option, **({"everywhere": everywhere} if name == "similar" else {})}
    defaults = {"catalog": None, "everywhere": False}
    keyword = inspect.Parameter.KEYWORD_ONLY
    added = [inspect.Parameter(n, keyword, default=defaults[n], annotation=kind) for n, kind in kinds.items()]

    @functools.wraps(command)
    def asked(**arguments: Any) -> Any:
        url, everywhere = arguments.pop("catalog", None), arguments.pop("everywhere", False)
        if url is None:
            if everywhere:
                raise _option_error("--everywhere needs --catalog URL")
            return command(**arguments)
        json, memory = arguments.pop("json"), str(arguments.pop("memory"))
        _check(name, arguments, signature)
        _ask(url, name, None if memory == ALL else memory, {**arguments, "everywhere": everywhere}, json)

    asked.__signature__ = signature.replace(parameters=[*signature.parameters.values(), *added])  # type: ignore[attr-defined]
    asked.__annotations__ = {**get_type_hints(command, include_extras=True), **kinds}
    return asked


def _option_error(text: str) -> Exception:
    from list3r.memory.core.errors import OptionError

    return OptionError(text)


def _check(name: str, arguments: Arguments, signature: inspect.Signature) -> None:
    """Raise `OptionError` for options that only a file can answer."""
    for word, value in arguments.items():
        if word not in _LISTED[name] and value != signature.parameters[word].default:
            flag = word.replace("_", "-")
            raise _option_error(f"--{flag} is not available for a catalogue; leave it out, or ask the memory file")


def _ask(url: str, name: str, memory: str | None, arguments: Arguments, json: bool) -> None:
    from list3r.catalog import Catalog
    from list3r.catalog.records import CatalogFilters

    filters = CatalogFilters(
        bool(arguments.get("structure")), float(arguments.get("min_confidence") or 0.0), arguments.get("state")
    )
    with Catalog.open(url, make=False) as catalog:
        if name == "relations":
            found = catalog.relations(memory, **{w: arguments[w] for w in _LISTED[name][:3]}, k=_MOST_RELATIONS)
            rows = [r for r in found if r.confidence >= filters.min_confidence]
            _print(rows, found, json, _relation_row, _RELATIONS)
            return
        ask = {"nearest": _nearest, "within": _within, "find": _find, "similar": _similar}[name]
        found = ask(catalog, memory, arguments, filters)
    _print(list(found), found, json, _match_row, _MATCHES)


def _one(memory: str | None) -> str:
    if memory is None:
        raise _option_error(f"a place belongs to one memory; name that memory instead of {ALL}")
    return memory


def _nearest(catalog: Catalog, memory: str | None, arguments: Arguments, filters: CatalogFilters) -> CatalogAnswers:
    point, near, words = arguments["point"], arguments["id"], arguments["words"]
    if words is not None and (point is not None or near is not None):
        raise _option_error("a catalogue takes words or a place, not both; leave one out")
    if words is not None:
        return catalog.find(words, memory, k=arguments["k"], filters=filters)
    at = None if point is None else parse_point(point, "--point")
    return catalog.nearest(_one(memory), point=at, instance_id=near, k=arguments["k"], filters=filters)


def _within(catalog: Catalog, memory: str | None, arguments: Arguments, filters: CatalogFilters) -> CatalogAnswers:
    from list3r.cli.ask.arguments import CameraArguments, RegionArguments

    region = RegionArguments(arguments["box"], arguments["point"], arguments["radius"]).lengths(CameraArguments())
    return catalog.within(_one(memory), **region, filters=filters)  # type: ignore[arg-type]


def _find(catalog: Catalog, memory: str | None, arguments: Arguments, filters: CatalogFilters) -> CatalogAnswers:
    return catalog.find(arguments["text"], memory, k=arguments["k"], filters=filters)


def _similar(catalog: Catalog, memory: str | None, arguments: Arguments, filters: CatalogFilters) -> CatalogAnswers:
    anywhere = memory is None or arguments["everywhere"]
    asked: Arguments = {"anywhere": anywhere, "k": arguments["k"], "filters": filters}
    if arguments["image"] is None:
        return catalog.similar(memory, instance_id=arguments["id"], **asked)
    vector, space = _picture(catalog, memory, arguments)
    return catalog.similar(memory, vector=vector, space=space, **asked)


def _picture(catalog: Catalog, memory: str | None, arguments: Arguments) -> tuple[Any, str]:
    """Return the vector of a picture, by the model of the first memory that can be opened here, and its space."""
    from list3r.api import open as open_scene
    from list3r.cli.ask.arguments import SimilarArguments
    from list3r.semantics.picture_query import picture_query

    entries = catalog.memories() if memory is None else [catalog.memory(memory)]
    path = next((e.path for e in entries if Path(e.path).is_file()), None)
    if path is None:
        raise _option_error(
            "--image needs the model of a memory, and no file of the catalogue is on this machine; ask where one is"
        )
    like = SimilarArguments(arguments["id"], arguments["image"], arguments["box"])
    with open_scene(path) as scene:
        asked = picture_query(scene.store, arguments["image"], like.corners())
    if asked.part is not None:
        raise _option_error("the memories have no vectors to compare pictures with; `list3r embed` makes them")
    return asked.vector, asked.space


_MATCHES = ("memory", "id", "what", "score", "distance", "file", "why")
_RELATIONS = ("memory", "id", "subject", "predicate", "id", "object", "conf", "file")


def _match_row(m: Any) -> list[object]:
    what = in_column(m.label or m.description)
    return [m.memory, m.id, what, m.score, "" if m.distance is None else f"{m.distance:.3f}", m.path, m.reason]


def _relation_row(r: Any) -> list[object]:
    subject, object = in_column(r.subject_name), in_column(r.object_name)
    return [r.memory, r.subject, subject, r.predicate, r.object, object, r.confidence, r.path]


def _print(
    rows: list[Any], found: CatalogAnswers, json: bool, row: Callable[[Any], list[object]], header: tuple[str, ...]
) -> None:
    if json:
        print_answer(map(asdict, rows), None, found.notes, **found.facts())
        return
    for said in found.facts().values():
        say(str(said))
    note(*(f"note: {line}" for line in found.notes))
    print_table(map(row, rows), header)
