"""Which models run together: presets by name, and `auto`, which depends on the machine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec

from list3r.memory.core.errors import OptionError
from list3r.models.cache import find_cached
from list3r.models.cards import ModelCard, find_card
from list3r.models.device import Gpu
from list3r.models.licences import objection

PRESETS = ("cpu", "light", "paper", "auto")
"""cpu: nothing to fetch. light: small networks, free for any use. paper: the paper's. auto: what this machine has."""


@dataclass(frozen=True)
class ModelSelection:
    """The models of a run, by the names that the options know."""

    reconstruction: str = "auto"
    """`auto`: rgbd where there is depth, else sfm."""
    discovery: str = "learned"
    tracking: str = "reprojection"
    features: str = "geometric"
    why: str = ""
    """One line for the user."""

    def cards(self) -> list[tuple[str, ModelCard]]:
        """(option, card) of every model that has one."""
        parts = (
            ("--reconstruction", self.reconstruction, "geometry"),
            ("--discovery", self.discovery, "discovery"),
            ("--tracking", self.tracking, "tracking"),
            ("--features", self.features, "features"),
        )
        found = [(option, find_card(name, part)) for option, name, part in parts]
        return [(option, card) for option, card in found if card is not None]


def select(preset: str, *, has_depth: bool, profile: str, gpu: Gpu | None) -> ModelSelection:
    """Return the models of a preset for a source. Raises `OptionError` for a preset that is not known."""
    if preset == "cpu":
        return ModelSelection(why="preset cpu: nothing to fetch")
    if preset == "light":
        geometry = "auto" if has_depth else "da3"
        return ModelSelection(geometry, "eomt", "edgetam", "dinov2", "preset light: small networks, free for any use")
    if preset == "paper":
        return ModelSelection("pi3", "eomt", "sam3", "own", "preset paper: the models of the paper")
    if preset == "auto":
        return _by_machine(has_depth, profile, gpu)
    raise OptionError(f"--preset {preset} is not known; choose {', '.join(PRESETS)}")


def _by_machine(has_depth: bool, profile: str, gpu: Gpu | None) -> ModelSelection:
    """Return the best models that are installed, fetched, and allowed; without a GPU none that has weights."""
    if gpu is None:
        return ModelSelection(why="preset auto: no GPU, so nothing that has weights")
    chosen = ModelSelection()
    reasons: list[str] = []
    wanted = {
        "reconstruction": ("geometry", () if has_depth else ("pi3x", "pi3", "mapanything", "vggt", "da3")),
        "discovery": ("discovery", ("eomt", "sam3", "sam2", "mask2former")),
        "tracking": ("tracking", ("sam3", "sam2", "edgetam")),
        "features": ("features", ("dinov3", "dinov2")),
    }
    for name, (part, candidates) in wanted.items():
        why_not = {c: obstacle(c, part, profile) for c in candidates}
        usable = next((c for c in candidates if why_not[c] is None), None)
        if usable is not None:
            chosen = replace(chosen, **{name: usable})
            reasons.append(usable)
        elif candidates:
            reasons.append(f"no {part} network ({candidates[0]}: {why_not[candidates[0]]})")
    if chosen.features == "geometric" and chosen.discovery != "learned":
        chosen = replace(chosen, features="own")
    where = f"{gpu.name}, {gpu.free_mb / 1024:.1f} GB free"
    return replace(chosen, why=f"preset auto on {where}: {', '.join(reasons)}")


def obstacle(name: str, part: str, profile: str) -> str | None:
    """Return what keeps a model from running here without a download: licence, package, weights.

    None where nothing does.
    """
    card = find_card(name, part)
    if card is None:
        return "unknown"
    allowed = [w for w in card.weights if objection(card, w, profile) is None]
    if not allowed:
        return f"{(card.weights[0].licence if card.weights else card.code).name} is not {profile}"
    missing = missing_package(card)
    if missing is not None:
        return f"{missing} is not installed"
    if all(find_cached(w.repository, w.revision) is None for w in allowed):
        return "weights not fetched"
    return None


def missing_package(card: ModelCard) -> str | None:
    """Return the first module of a card that cannot be imported, looked for without importing it."""
    return next((p for p in card.packages if find_spec(p) is None), None)
