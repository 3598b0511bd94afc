"""models list, models fetch, precompute: the networks, their weights, and their answers as files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.build import source_options as src
from list3r.cli.build.progress import watching
from list3r.cli.common import JsonOption, LicenceOption, print_table
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError
from list3r.pipeline.request import BuildRequest, RunOptions

if TYPE_CHECKING:
    from list3r.models.cards import ModelCard, Weights

models = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="List the networks with their licences and cached weights, and download weights.",
)


@models.command("list")
def list_models(
    licence: Annotated[
        str, typer.Option("--licence", metavar="permissive|research|any", help="Show models that this profile allows.")
    ] = "any",
    json: JsonOption = False,
) -> None:
    """List every model: purpose, licences, and whether its package and weights are on this machine.

    Example: list3r models list --licence permissive
    """
    from list3r.models.cards import CARDS
    from list3r.models.licences import objection

    shown = [(c, w) for c in CARDS for w in (c.weights or (None,)) if objection(c, w, licence) is None]
    rows = [model_facts(card, weights) for card, weights in shown]
    if json:
        print_answer(rows)
        return
    table = [
        (
            r["name"],
            r["part"],
            "yes" if r["installed"] else "no",
            r["repository"] or "the user's own",
            _size(r),
            r["code_licence"],
            _licence(r),
        )
        for r in rows
    ]
    print_table(table, ["model", "part", "package", "weights", "in the cache", "code", "licence of the weights"])


@models.command("fetch")
def fetch_model(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A model, or owner/name of weights.", show_default=False)],
    licence: LicenceOption = "research",
    revision: Annotated[
        str | None,
        typer.Option("--revision", help="Commit, tag or branch; default: the card's.", show_default=False),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Download the weights of a model into the cache; from then on it runs offline.

    Example: list3r models fetch mapanything --licence permissive
    """
    from list3r.models.cache import fetch, find_cached

    done = []
    for weights in _wanted(name, licence):
        before = find_cached(weights.repository, revision or weights.revision)
        cached = fetch(weights, revision)
        done.append({"weights": cached.name, "folder": str(cached.folder), "bytes": cached.size_bytes})
        if not json:
            outcome = "was there" if before is not None and before.commit == cached.commit else "fetched"
            say(f"{cached.name}  {cached.size_bytes / 1e6:.1f} MB  {outcome}: {cached.folder}")
    if json:
        print_answer(done)


def precompute(
    source: src.SourceArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write to.")],
    *,
    request: Annotated[BuildRequest, "reconstruction", "device", "weights", "poses", "chunk", "overlap"],
    given: src.SourceArguments,
    run: Annotated[RunOptions, "licence"],
    force: Annotated[bool, typer.Option("--force", help="Write finished chunks again.")] = False,
    json: JsonOption = False,
) -> None:
    """Reconstruct a video into .npz files, for `build --reconstruction precomputed --weights DIR` on another machine.

    Example: list3r precompute walk.mp4 --out walk-pi3/ --reconstruction pi3
    """
    options = given.options()
    from list3r.pipeline.precompute import precompute as write

    def interrupted(begun: bool) -> str:
        return f"interrupted; finished files in {out} are kept: run the command again"

    how = replace(run, force=force)
    with watching("reconstructing", interrupted, quiet=json) as watch:
        report = write(source, out, options=options, settings=request, run=how, watch=watch)
    if json:
        print_answer([{"folder": str(out), **report.as_dict()}])
        return
    say(f"{out}  {report.files} files, {report.bytes / 1e6:.1f} MB, {report.posed} of {report.frames} posed")
    say(*(f"note: {line}" for line in report.notes))


def model_facts(card: ModelCard, weights: Weights | None) -> dict[str, Any]:
    """Facts of a model with some weights, and its parts on this machine."""
    from list3r.models.cache import find_cached
    from list3r.models.presets import missing_package

    cached = None if weights is None else find_cached(weights.repository, weights.revision)
    return {
        "name": card.name,
        "part": card.part,
        "about": card.about,
        "installed": missing_package(card) is None,
        "install": card.installed_by,
        "code_licence": card.code.name,
        "repository": None if weights is None else weights.repository,
        "revision": None if weights is None else weights.revision,
        "pinned": weights is not None and weights.pinned,
        "weights_licence": None if weights is None else weights.licence.name,
        "gated": weights is not None and weights.gated,
        "any_use": card.code.kind == "permissive"
        and (weights is None or (weights.licence.kind == "permissive" and not weights.gated)),
        "cached_commit": None if cached is None else cached.commit,
        "cached_bytes": None if cached is None else cached.size_bytes,
        "memory_mb": None if card.memory is None else {"fixed": card.memory.fixed_mb, "source": card.memory.source},
    }


def _wanted(name: str, licence: str) -> list[Weights]:
    """The weights of a name. Raises `OptionError` for an unknown or forbidden name."""
    from list3r.models.cards import cards_named
    from list3r.models.licences import check_profile, choose_weights

    check_profile(licence)
    if "/" in name:
        return [_named(name, licence)]
    found = {w.repository: w for c in cards_named(name) if (w := choose_weights(c, None, licence, "model")) is not None}
    if not found:
        raise OptionError(f"{name} has no weights of its own; give yours with --weights")
    return list(found.values())


def _named(name: str, licence: str) -> Weights:
    """Weights that are named by their repository. Raises `OptionError` for weights that the profile does not allow."""
    from list3r.models.cache import split_name
    from list3r.models.cards import CARDS, OTHER, UNPINNED, Weights, find_weights
    from list3r.models.licences import choose_weights

    parts = split_name(name)
    if parts is None:
        raise OptionError(f"{name} is not the name of a repository; give owner/name or owner/name@revision")
    for card in CARDS:
        if (known := find_weights(card, parts[0])) is not None:
            choose_weights(card, name, licence, "model")
            return replace(known, revision=known.revision if parts[1] == UNPINNED else parts[1])
    if licence == "permissive":
        raise OptionError(f"--licence permissive does not allow {name}, whose licence is not known here")
    return Weights(parts[0], OTHER, revision=parts[1])


def _size(facts: dict[str, Any]) -> str:
    if facts["repository"] is None:
        return "-"
    return "no" if facts["cached_bytes"] is None else f"{facts['cached_bytes'] / 1e6:.0f} MB"


def _licence(facts: dict[str, Any]) -> str:
    if facts["repository"] is None:
        return "-"
    marks = [facts["weights_licence"], *(["gated"] if facts["gated"] else [])]
    return ", ".join(marks) + ("" if facts["any_use"] else "  (restricted)")
