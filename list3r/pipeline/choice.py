"""From what was asked to the settings of a build: presets, weights, chunk length, and what is taken from a memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from list3r.frames.base import SourceInfo
from list3r.frames.chunking.chunks import ChunkSettings
from list3r.memory.core.errors import OptionError
from list3r.memory.library.world.held import parse_up
from list3r.memory.store.store import Store
from list3r.models.cards import ModelCard, find_card, find_weights
from list3r.models.choice import check_allowed, parse_weights
from list3r.models.device import find_gpu, pictures_that_fit
from list3r.models.licences import terms
from list3r.models.presets import ModelSelection, select
from list3r.pipeline.request import BuildRequest
from list3r.pipeline.settings import AssociationSettings, BuildSettings, session_settings
from list3r.reconstruction.precomputed_files import read_manifest
from list3r.reconstruction.registry import MODELS, entry

USUAL_CHUNK, LONGEST_CHUNK, SHORTEST_CHUNK = 100, 240, 16
"""Frames: the paper's; the most that a GPU is filled with, from where passes grow slow and no figure shows a gain; the
fewest that make a chunk."""
OTHER_NETWORK_MB = 1000
"""Left free on a GPU for each network that finds, follows or describes things: the weights of the largest, half of a
SAM 3, and what a picture takes."""
MODEL_CHOICES = (
    "reconstruction",
    "device",
    "weights",
    "discovery",
    "tracking",
    "features",
    "instance_weights",
    "local_features",
    "feature_weights",
)
"""Fields of `BuildSettings` that say which models run."""
_NAMING = ("reconstruction", "preset", "discovery", "tracking", "features", "device", "weights", "local_features")
"""Fields of `BuildRequest` that choose them."""


def settings_asked(request: BuildRequest, info: SourceInfo, licence: str) -> tuple[BuildSettings, list[str]]:
    """Return the settings of a new build, and what the user should know of the models, one sentence each.

    Raises `OptionError` for what is not known, not allowed or not installed, before anything is loaded or fetched.
    """
    settings, notes = _models_asked(request, info, licence)
    chunks = _cut(settings, request.chunk, request.overlap)
    settings = replace(settings, chunks=chunks, depth_every=request.depth_every, up=_up_asked(request, settings.up))
    return replace(settings, association=AssociationSettings.by_method(request.association or "list3r")), notes


def settings_resumed(
    request: BuildRequest, begun: BuildSettings, info: SourceInfo, licence: str
) -> tuple[BuildSettings, list[str]]:
    """Return the settings of a session that is gone on with, with what is asked for by name in their place."""
    default, notes = BuildRequest(), list[str]()
    settings = replace(
        begun,
        poses=begun.poses if request.poses == default.poses else request.poses,
        depth_every=begun.depth_every if request.depth_every is None else request.depth_every,
        keep_pictures=begun.keep_pictures and request.pictures,
        up=_up_asked(request, begun.up),
    )
    if any(getattr(request, name) != getattr(default, name) for name in _NAMING):
        named, notes = _models_asked(request, info, licence)
        settings = replace(settings, **{name: getattr(named, name) for name in MODEL_CHOICES})
        settings = replace(settings, frame_look=_look_beside(settings.features, begun))
    asked = begun.association if request.association is None else AssociationSettings.by_method(request.association)
    if asked != begun.association:
        raise OptionError(f"this build was not begun with --association {request.association}; leave it out")
    if request.chunk is not None or request.overlap is not None:
        settings = replace(settings, chunks=_cut(settings, request.chunk, request.overlap))
    return settings, notes


def _up_asked(request: BuildRequest, otherwise: str) -> str:
    """Return who says which way is up. Raises `OptionError` for what is none."""
    if request.up is None:
        return otherwise
    parse_up(request.up)
    return request.up


def settings_beside(settings: BuildSettings, first: BuildSettings) -> BuildSettings:
    """Return the settings of a later session: what was asked for, with the stages of the memory's first session."""
    own = (*MODEL_CHOICES, "poses", "up", "chunks", "depth_every", "keep_pictures")
    found = replace(first, **{name: getattr(settings, name) for name in own})
    return replace(found, frame_look=_look_beside(found.features, first))


def _look_beside(features: str, first: BuildSettings) -> str:
    """Return what describes frames of a session beside another: what described that one's, where that is at hand."""
    return first.frame_look if features == first.features else "local"


def look_doubts(settings: BuildSettings, first: BuildSettings) -> list[str]:
    """Return a line where frames of a later session are described otherwise than those of the memory."""
    if settings.frame_look == first.frame_look:
        return []
    return [
        f"this memory recognises places by {first.features}; without --features {first.features} a session is "
        "placed by its things alone"
    ]


def check_beside(settings: BuildSettings, first: BuildSettings) -> None:
    """Raise `OptionError` where a later session would derive the library by other rules than the memory."""
    if settings.library != first.library:
        one, other = vars(first.library), vars(settings.library)
        names = [name for name in one if one[name] != other[name]]
        raise OptionError(
            f"the memory was made with other library settings ({', '.join(names)}); give the same "
            "library settings, or leave the settings out"
        )


def stored_sessions(memory: Path) -> tuple[BuildSettings | None, BuildSettings | None]:
    """Return the settings of a memory's first session, and of the one that is not finished; None for neither."""
    if not memory.is_file():
        return None, None
    with Store.open(memory) as store:
        sessions = store.sessions.all()
    begun = [s for s in sessions if s.state != "complete"]
    first = session_settings(sessions[0]) if sessions else None
    return first, session_settings(begun[-1]) if begun else None


def _models_asked(request: BuildRequest, info: SourceInfo, licence: str) -> tuple[BuildSettings, list[str]]:
    selection = _selection(request, info, licence)
    asked = parse_weights(list(request.weights))
    if selection.discovery == selection.reconstruction == "precomputed" and "reconstruction" in asked:
        asked.setdefault("discovery", asked["reconstruction"])
    if selection.reconstruction != "auto":
        entry(selection.reconstruction)  # a name that is not known is said before what goes with it
    _check_used(asked, selection)
    chosen = check_allowed(selection, asked, licence)
    kind, file = _local_features(request.local_features)
    settings = BuildSettings(
        reconstruction=selection.reconstruction,
        poses=request.poses,
        device=request.device,
        weights=chosen.get("reconstruction"),
        discovery=selection.discovery,
        tracking=selection.tracking,
        features=selection.features,
        instance_weights=tuple(
            sorted((f"{part}/{getattr(selection, part)}", chosen[part]) for part in chosen if part != "reconstruction")
        ),
        frame_look="local" if selection.features in ("geometric", "own") else "network",
        local_features=kind,
        feature_weights=file,
        keep_pictures=request.pictures,
    )
    return settings, [*filter(None, [selection.why]), *_terms(selection, chosen)]


def _check_used(asked: Mapping[str, str], selection: ModelSelection) -> None:
    """Raises `OptionError` for weights of a part whose model has none, so that nobody waits for another result."""
    taking = {option.removeprefix("--") for option, _ in selection.cards()}
    for part, where in asked.items():
        model = getattr(selection, part)
        if not where:
            raise OptionError(f"--weights {part}= is empty; give a folder, a file or owner/name@revision")
        if part not in taking and not _reads_files(model):
            raise OptionError(f"--weights {where}: no network does the {part} ({model}); name one with --{part}")


def _local_features(words: str) -> tuple[str, str | None]:
    """Return kind and file of `--local-features`. Raises `OptionError` for what is not known or cannot be loaded."""
    from list3r.reconstruction.features.detectors import KINDS, make_detector

    kind, _, file = words.partition("=")
    if kind == "sift" and not file:
        return kind, None
    if kind not in KINDS:
        raise OptionError(f"--local-features {words}: choose sift, {', '.join(f'{k}=FILE' for k in KINDS)}")
    if not file:
        raise OptionError(f"--local-features {kind} needs its weights: --local-features {kind}=FILE")
    path = Path(file).expanduser().resolve()
    make_detector(kind, path)
    return kind, str(path)


def _selection(request: BuildRequest, info: SourceInfo, licence: str) -> ModelSelection:
    """Return the preset's models, or the classical ones, with what was asked for by name put in their place.

    Raises `OptionError` where the weights of what learned are missing, damaged or of another version.
    """
    chosen = ModelSelection()
    if request.preset is not None:
        gpu = find_gpu(request.device) if request.preset == "auto" else None
        chosen = select(request.preset, has_depth=info.has_depth, profile=licence, gpu=gpu)
    given = {k: getattr(request, k) for k in ("reconstruction", "discovery", "tracking", "features")}
    named = {k: str(v) for k, v in given.items() if v is not None}
    if "discovery" in named and "features" not in named:
        learned = named["discovery"] == "learned"
        if not learned and chosen.features == "geometric":
            named["features"] = "own"
        elif learned and chosen.features == "own":
            named["features"] = "geometric"
    if named and chosen.why:
        named["why"] = f"{chosen.why}; {', '.join(f'--{k} {v}' for k, v in named.items())} as asked"
    found = replace(chosen, **named)
    if found.discovery == "learned":
        from list3r.instances.learned.weights import load_weights

        for sensed in (True, False):
            load_weights(sensed=sensed)
    if found.reconstruction == "sfm" or (found.reconstruction == "auto" and not info.has_depth):
        from list3r.reconstruction.mvs.weights import read_weights

        read_weights()
    return found


def _reads_files(name: str) -> bool:
    """Return whether a reconstruction, or what goes by its name, reads a folder instead of running a network."""
    return name in MODELS and MODELS[name].reads_files


def _terms(selection: ModelSelection, chosen: Mapping[str, str]) -> list[str]:
    """Return the licences that a user of the models should know of."""
    found = []
    for option, card in selection.cards():
        where = chosen.get(option.removeprefix("--"))
        text = terms(card, None if where is None else find_weights(card, where.split("@")[0]))
        if text:
            found.append(f"{text}; see `list3r models list`")
    return found


def _cut(settings: BuildSettings, length: int | None, overlap: int | None) -> ChunkSettings:
    """Return how the video is cut: as asked, else as precomputed files were, else as the memory of the GPU allows."""
    card = find_card(settings.reconstruction, "geometry")
    if length is None and _reads_files(settings.reconstruction) and settings.weights is not None:
        said = read_manifest(Path(settings.weights).expanduser())
        length, overlap = said.length, said.overlap if overlap is None else overlap
    elif length is None and card is not None:
        length = _fitting(card, settings)
    length = USUAL_CHUNK if length is None else length
    return ChunkSettings(length, max(1, min(30, round(0.3 * length))) if overlap is None else overlap)


def _fitting(card: ModelCard, settings: BuildSettings) -> int:
    """Return the frames that the GPU holds by published figures, within bounds; the usual number without a GPU."""
    gpu = find_gpu(settings.device)
    figures = card.memory_with(settings.weights)
    if gpu is None or figures is None:
        return USUAL_CHUNK
    others_mb = OTHER_NETWORK_MB * len(settings.instance_weights)
    fit = pictures_that_fit(gpu.free_mb - others_mb, figures, card.pixels)
    if fit < SHORTEST_CHUNK:
        needed = (figures.needed_mb(SHORTEST_CHUNK, card.pixels) + others_mb) / 1024
        raise OptionError(
            f"{card.name} needs about {needed:.1f} GB for {SHORTEST_CHUNK} frames and {gpu.name} has "
            f"{gpu.free_mb / 1024:.1f} GB free; free it, use another model, --device cpu, or give --chunk to try"
        )
    return min(fit, LONGEST_CHUNK)
