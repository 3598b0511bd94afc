"""The questions for a catalogue: `--catalog URL`, in one memory or over all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.cli.answer import print_answer
from list3r.cli.common import in_column, print_table
from list3r.cli.terminal import note, say
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.catalog import Catalog
    from list3r.catalog.records import CatalogAnswers, CatalogFilters

ALL = "@all"
"""In the place of the memory: all memories of the catalogue."""
_MOST_RELATIONS = 1000


def only_these(context: Any, *names: str) -> None:
    """Raise `OptionError` for options that are given and that only a file can answer; `names` may be given."""
    for p in context.command.params:
        source = context.get_parameter_source(p.name)
        if p.name not in (*names, "memory", "catalog", "json") and source is not None and source.name == "COMMANDLINE":
            raise OptionError(f"{p.opts[-1]} is not available for a catalogue; leave it out, or ask the memory file")


def filters(least: float | None = None, *, structure: bool = False, state: str | None = None) -> CatalogFilters:
    """Return which instances may answer."""
    from list3r.catalog.records import CatalogFilters

    return CatalogFilters(structure, least or 0.0, state)


def one(memory: str | None) -> str:
    """Return the name of a memory. Raises `OptionError` for all of them."""
    if memory is None:
        raise OptionError(f"a place belongs to one memory; name that memory instead of {ALL}")
    return memory


def answer(url: str, memory: Path, ask: Callable[[Catalog, str | None], CatalogAnswers], json: bool) -> None:
    """Ask a catalogue, with the name of the memory or None for all, and print the matches."""
    from list3r.catalog import Catalog

    with Catalog.open(url, make=False) as catalog:
        found = ask(catalog, _name(memory))
    _print(list(found), found, json, _match_row, _MATCHES)


def answer_relations(url: str, memory: Path, members: dict[str, str | None], least: float, json: bool) -> None:
    """Ask a catalogue for relations by `subject`, `predicate` and `object`, and print them."""
    from list3r.catalog import Catalog

    with Catalog.open(url, make=False) as catalog:
        found = catalog.relations(_name(memory), **members, k=_MOST_RELATIONS)
    _print([r for r in found if r.confidence >= least], found, json, _relation_row, _RELATIONS)


def _name(memory: Path) -> str | None:
    return None if str(memory) == ALL else str(memory)


def nearest(
    catalog: Catalog,
    memory: str | None,
    instance_id: int | None,
    point: tuple[float, float, float] | None,
    words: str | None,
    k: int,
    chosen: CatalogFilters,
) -> CatalogAnswers:
    """What words name, or the nearest to a place of one memory. Raises `OptionError` for both."""
    if words is None:
        return catalog.nearest(one(memory), point=point, instance_id=instance_id, k=k, filters=chosen)
    if point is not None or instance_id is not None:
        raise OptionError("a catalogue takes words or a place, not both; leave one out")
    return catalog.find(words, memory, k=k, filters=chosen)


def similar(
    catalog: Catalog,
    memory: str | None,
    like: tuple[int | None, Path | None, tuple[float, float, float, float] | None],
    k: int,
    chosen: CatalogFilters,
    everywhere: bool,
) -> CatalogAnswers:
    """The most similar to an instance, or to a picture or a box of it."""
    instance_id, image, box_xyxy = like
    asked: dict[str, Any] = {"anywhere": memory is None or everywhere, "k": k, "filters": chosen}
    if image is None:
        return catalog.similar(memory, instance_id=instance_id, **asked)
    vector, space = _picture(catalog, memory, image, box_xyxy)
    return catalog.similar(memory, vector=vector, space=space, **asked)


def _picture(
    catalog: Catalog, memory: str | None, image: Path, box_xyxy: tuple[float, float, float, float] | None
) -> tuple[Any, str]:
    """Return the vector of a picture, by the model of the first memory that can be opened here, and its space."""
    from list3r.api import open as open_scene
    from list3r.semantics.picture_query import picture_query

    entries = catalog.memories() if memory is None else [catalog.memory(memory)]
    path = next((e.path for e in entries if Path(e.path).is_file()), None)
    if path is None:
        raise OptionError(
            "--image needs the model of a memory, and no file of the catalogue is on this machine; ask where one is"
        )
    with open_scene(path) as scene:
        asked = picture_query(scene.store, image, box_xyxy)
    if asked.part is not None:
        raise OptionError("the memories have no vectors to compare pictures with; `list3r embed` makes them")
    return asked.vector, asked.space


_MATCHES = ("memory", "id", "what", "score", "distance", "file", "why")
_RELATIONS = ("memory", "id", "subject", "predicate", "id", "object", "confidence", "file")


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
