"""Which models a licence profile allows, decided before anything is loaded or fetched."""

from __future__ import annotations

from pathlib import Path

from list3r.memory.core.errors import OptionError, check_choice
from list3r.models.cache import split_name
from list3r.models.cards import OTHER, Licence, ModelCard, Weights, find_weights

PROFILES = ("permissive", "research", "any")
"""permissive: code and weights that anyone may use for anything, without an account. research: also non-commercial,
gated, copyleft and owner's own terms. any: also what came without a licence."""

DEFAULT_PROFILE = "research"


def check_profile(profile: str) -> None:
    """Raise `OptionError` for a profile that is not known."""
    check_choice("--licence", profile, PROFILES)


def objection(card: ModelCard, weights: Weights | None, profile: str) -> str | None:
    """Why a profile does not allow a model with these weights (None: the user's own), or None where it does."""
    check_profile(profile)
    wrong = _wrong(card.code, profile)
    if wrong:
        return f"its code is under {card.code.name}, {wrong}"
    if weights is None:
        return None
    wrong = _wrong(weights.licence, profile)
    if wrong:
        return f"the weights {weights.repository} are under {weights.licence.name}, {wrong}"
    if weights.gated and profile == "permissive":
        return f"the weights {weights.repository} are gated: their owner must grant access first"
    return None


def _wrong(licence: Licence, profile: str) -> str | None:
    if licence.kind == "none":
        return "which gives no right to use it" if profile != "any" else None
    if profile != "permissive" or licence.kind == "permissive":
        return None
    return {
        "noncommercial": "which forbids commercial use",
        "copyleft": "which binds what is built with it",
        "custom": "whose terms are its owner's own",
    }[licence.kind]


def choose_weights(card: ModelCard, asked: str | None, profile: str, option: str) -> Weights | None:
    """Return the weights to use: those asked for by repository, else the first of the card that the profile allows.

    None where the user brings weights of his own. A repository that the card does not name has terms of its own.
    Raises `OptionError`, naming the model, its licence and what is allowed instead, when the profile forbids it.
    """
    candidates: list[Weights | None] = list(card.weights) or [None]
    if asked is not None:
        name = None if Path(asked).expanduser().exists() else split_name(asked)
        candidates = [None if name is None else find_weights(card, name[0]) or Weights(name[0], OTHER)]
    reasons = [objection(card, w, profile) for w in candidates]
    for weights, reason in zip(candidates, reasons, strict=True):
        if reason is None:
            return weights
    raise OptionError(
        f"--licence {profile} does not allow {option} {card.name}: {reasons[0]}; "
        f"choose another or allow it with --licence {'any' if profile == 'research' else 'research'}"
    )


def terms(card: ModelCard, weights: Weights | None) -> str:
    """Return what a user should know before using a model commercially; empty where there is nothing to say."""
    if weights is None:
        return ""
    conditions = [
        f"{what} {licence.name}"
        for what, licence in (("code", card.code), ("weights", weights.licence))
        if licence.kind != "permissive"
    ]
    if weights.gated:
        conditions.append("gated")
    return f"{card.name}: {', '.join(conditions)}" if conditions else ""
