"""From the names of models to weights on this disk: allowed, installed, fetched, and named for ever."""

from __future__ import annotations

from collections.abc import Mapping

from list3r.memory.core.errors import OptionError
from list3r.models.cache import resolve
from list3r.models.cards import ModelCard
from list3r.models.licences import check_profile, choose_weights
from list3r.models.presets import ModelSelection, missing_package

PARTS_OF_OPTIONS = {
    "reconstruction": "geometry",
    "discovery": "discovery",
    "tracking": "tracking",
    "features": "features",
}


def parse_weights(words: list[str] | None) -> dict[str, str]:
    """`--weights` as it was given, by option: `PATH` is the reconstruction's, `discovery=PATH` the discoverer's.

    Raises `OptionError` for a part that is not known or given twice.
    """
    found: dict[str, str] = {}
    for word in words or []:
        part, equals, value = word.partition("=")
        if not equals or "/" in part:
            part, value = "reconstruction", word
        if part not in PARTS_OF_OPTIONS:
            raise OptionError(f"--weights {word}: {part} is not a part; choose one of {', '.join(PARTS_OF_OPTIONS)}")
        if part in found:
            raise OptionError(f"--weights {word}: the weights of {part} are given twice")
        found[part] = value
    return found


def check_allowed(selection: ModelSelection, asked: Mapping[str, str], profile: str) -> dict[str, str]:
    """Return the weights to use, by option, those asked for and those that the licence profile leaves of the cards'.

    Nothing is loaded or fetched. Raises `OptionError` for what the profile forbids and for packages that are missing.
    """
    check_profile(profile)
    chosen = dict(asked)
    for option, card in selection.cards():
        name = option.removeprefix("--")
        weights = choose_weights(card, asked.get(name), profile, option)
        check_package(card)
        if weights is not None and name not in asked:
            chosen[name] = f"{weights.repository}@{weights.revision}" if weights.pinned else weights.repository
    return chosen


def check_package(card: ModelCard) -> None:
    """Raise `OptionError`, with what installs it, when a package of the card is missing."""
    missing = missing_package(card)
    if missing is not None:
        raise OptionError(f"{card.name} needs the package {missing}: {card.installed_by}")


def pinned_weights(selection: ModelSelection, asked: Mapping[str, str], profile: str) -> dict[str, str]:
    """The weights of every model, by option, as a path or `owner/name@commit`; missing ones are fetched.

    Nothing is fetched before all of them are allowed. Raises `OptionError` as `check_allowed` and `cache.resolve` do.
    """
    allowed = check_allowed(selection, asked, profile)
    for option, card in selection.cards():
        name = option.removeprefix("--")
        known = choose_weights(card, allowed.get(name), profile, option)
        allowed[name] = resolve(allowed.get(name), known, f"{option} {card.name}")
    return allowed
