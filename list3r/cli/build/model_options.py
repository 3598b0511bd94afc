"""The options that choose models, the same on every command that builds, and the settings that follow from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from list3r.frames.base import SourceInfo
    from list3r.frames.chunking.chunks import ChunkSettings
    from list3r.models.cards import ModelCard
    from list3r.models.presets import ModelSelection
    from list3r.pipeline.settings import BuildSettings

Reconstruction = Annotated[
    str | None,
    typer.Option(
        "--reconstruction",
        metavar="MODEL",
        help="rgbd, sfm, pi3, pi3x, vggt, mapanything, da3, precomputed or auto (rgbd with depth, else sfm).",
        show_default=False,
    ),
]
Preset = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help="cpu (no weights), light (small networks, free for any use), paper, or auto (what this machine has).",
        show_default=False,
    ),
]
Discovery = Annotated[
    str | None,
    typer.Option(
        "--discovery", help="geometric, learned, eomt, mask2former, sam2, sam3 or precomputed: what finds things."
    ),
]
Tracking = Annotated[
    str | None,
    typer.Option("--tracking", help="reprojection, sam2, sam3 or edgetam: what follows them."),
]
Features = Annotated[
    str | None,
    typer.Option("--features", help="geometric, own, dinov2 or dinov3: what things are known again by."),
]
Device = Annotated[str, typer.Option("--device", help="Where networks run: cpu, cuda, cuda:1, or auto.")]
WeightsWords = Annotated[
    list[str] | None,
    typer.Option(
        "--weights",
        metavar="[PART=]WHERE",
        help="Weights instead of the model's own: a folder, a file or owner/name@revision; PART is reconstruction "
        "(the usual), discovery, tracking or features.",
        show_default=False,
    ),
]
LocalFeatures = Annotated[
    str,
    typer.Option(
        "--local-features",
        metavar="KIND[=FILE]",
        help="What finds a keyframe again: sift, or aliked=FILE with its weights, which also ties "
        "frames of colour alone between which nothing can be followed.",
    ),
]
LicenceProfile = Annotated[
    str,
    typer.Option(
        "--licence", help="permissive (nothing non-commercial, gated, copyleft or of own terms), research, or any."
    ),
]
Chunk = Annotated[
    int | None,
    typer.Option(
        "--chunk",
        metavar="N",
        help="Frames in a chunk; default: 100, or what the GPU holds of a network.",
        show_default=False,
    ),
]
Overlap = Annotated[
    int | None,
    typer.Option(
        "--overlap", metavar="N", help="Frames that neighbouring chunks share; default: 30 %.", show_default=False
    ),
]
DepthEvery = Annotated[
    int | None,
    typer.Option(
        "--depth-every",
        metavar="N",
        help="With colour alone: depth and things from every n-th frame, the others get a pose; default: by how fast "
        "the picture moves.",
        show_default=False,
    ),
]


@dataclass(frozen=True)
class ModelWords:
    """The options that choose models, as they were given."""

    reconstruction: Reconstruction = None
    preset: Preset = None
    discovery: Discovery = None
    tracking: Tracking = None
    features: Features = None
    device: Device = "auto"
    weights: WeightsWords = None
    local_features: LocalFeatures = "sift"
    licence: LicenceProfile = "research"


@dataclass(frozen=True)
class GeometryWords:
    """Those of them that say who reconstructs."""

    reconstruction: Reconstruction = None
    device: Device = "auto"
    weights: WeightsWords = None
    licence: LicenceProfile = "research"

    def models(self) -> ModelWords:
        """As the choice of all models."""
        return ModelWords(**vars(self))


@dataclass(frozen=True)
class CutWords:
    """The options that cut a video into chunks, as they were given."""

    chunk: Chunk = None
    overlap: Overlap = None


@dataclass(frozen=True)
class BuildCutWords(CutWords):
    """... and say which frames get depth."""

    depth_every: DepthEvery = None


USUAL_CHUNK, LONGEST_CHUNK, SHORTEST_CHUNK = 100, 240, 16
"""Frames: the paper's; the most that a GPU is filled with, from where passes grow slow and no figure shows a gain; the
fewest that make a chunk."""
OTHER_NETWORK_MB = 1000
"""Left free on a GPU for each network that finds, follows or describes things: the weights of the largest, half of a
SAM 3, and what a picture takes."""


def build_settings(
    info: SourceInfo,
    words: ModelWords,
    cut: CutWords,
    *,
    poses: str,
    pictures: bool,
    resumed: Path | None = None,
) -> tuple[BuildSettings, list[str]]:
    """Settings of a build, and what the user should know of the models, one line each.

    `resumed` is a memory whose unfinished session says how it was cut.
    Raises `OptionError` for what is not known, not allowed or not installed, before anything is loaded or fetched.
    """
    from list3r.models.choice import check_allowed, parse_weights
    from list3r.pipeline.settings import BuildSettings
    from list3r.reconstruction.registry import entry

    selection = _selection(info, words)
    asked = parse_weights(words.weights)
    if selection.discovery == selection.reconstruction == "precomputed" and "reconstruction" in asked:
        asked.setdefault("discovery", asked["reconstruction"])
    if selection.reconstruction != "auto":
        entry(selection.reconstruction)  # a name that is not known is said before what goes with it
    _check_used(asked, selection)
    chosen = check_allowed(selection, asked, words.licence)
    notes = [f"note: {selection.why}"] if selection.why else []
    notes += _terms(selection, chosen)
    kind, file = _local_features(words.local_features)
    settings = BuildSettings(
        local_features=kind,
        feature_weights=file,
        reconstruction=selection.reconstruction,
        poses=poses,
        device=words.device,
        weights=chosen.get("reconstruction"),
        discovery=selection.discovery,
        tracking=selection.tracking,
        features=selection.features,
        instance_weights=tuple(
            sorted((f"{o}/{getattr(selection, o)}", chosen[o]) for o in chosen if o != "reconstruction")
        ),
        keep_pictures=pictures,
    )
    chunks, depth_every = (None, None) if resumed is None else _recorded(resumed)
    if cut.chunk is not None or chunks is None:
        chunks = _cut(settings, cut.chunk, cut.overlap)
    wanted = cut.depth_every if isinstance(cut, BuildCutWords) else None
    return replace(settings, chunks=chunks, depth_every=depth_every if wanted is None else wanted), notes


def _check_used(asked: Mapping[str, str], selection: ModelSelection) -> None:
    """Raises `OptionError` for weights of a part whose model has none, so that nobody waits for another result."""
    from list3r.memory.errors import OptionError

    taking = {option.removeprefix("--") for option, _ in selection.cards()}
    for part, where in asked.items():
        model = getattr(selection, part)
        if not where:
            raise OptionError(f"--weights {part}= names nothing; give a folder, a file or owner/name@revision")
        if part not in taking and model != "precomputed":
            raise OptionError(f"--weights {where}: no network does the {part} ({model}); name one with --{part}")


def _local_features(words: str) -> tuple[str, str | None]:
    """Kind and file of `--local-features`. Raises `OptionError` for what is not known or cannot be loaded."""
    from list3r.memory.errors import OptionError
    from list3r.reconstruction.features.learned import KINDS, make_detector

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


def _selection(info: SourceInfo, words: ModelWords) -> ModelSelection:
    """The preset's models, or the classical ones, with what was asked for by name put in their place."""
    from list3r.instances.registry import WITHOUT_DOWNLOAD
    from list3r.models.device import find_gpu
    from list3r.models.presets import ModelSelection, select

    chosen = ModelSelection()
    if words.preset is not None:
        gpu = find_gpu(words.device) if words.preset == "auto" else None
        chosen = select(words.preset, has_depth=info.has_depth, profile=words.licence, gpu=gpu)
    given = {k: getattr(words, k) for k in ("reconstruction", "discovery", "tracking", "features")}
    named = {k: str(v) for k, v in given.items() if v is not None}
    if "discovery" in named and "features" not in named:
        neural = named["discovery"] not in WITHOUT_DOWNLOAD
        if neural and chosen.features == "geometric":
            named["features"] = "own"
        elif not neural and chosen.features == "own":
            named["features"] = "geometric"
    if named and chosen.why:
        named["why"] = f"{chosen.why}; {', '.join(f'--{k} {v}' for k, v in named.items())} as asked"
    return replace(chosen, **named)


def _terms(selection: ModelSelection, chosen: Mapping[str, str]) -> list[str]:
    """Licences that a user of the models should know of."""
    from list3r.models.cards import find_weights
    from list3r.models.licences import terms

    told = []
    for option, card in selection.cards():
        where = chosen.get(option.removeprefix("--"))
        text = terms(card, None if where is None else find_weights(card, where.split("@")[0]))
        if text:
            told.append(f"note: {text}; see `list3r models list`")
    return told


def _recorded(memory: Path) -> tuple[ChunkSettings | None, int | None]:
    """How the unfinished session of a memory was cut, and which frames were to get depth; None where none says."""
    from list3r.frames.chunking.chunks import ChunkSettings
    from list3r.memory.store.store import Store

    if not memory.is_file():
        return None, None
    with Store.open(memory) as store:
        begun = [s for s in store.sessions() if s.state != "complete"]
    settings = begun[-1].settings if begun else {}
    said, every = settings.get("chunks"), settings.get("depth_every")
    chunks = ChunkSettings(int(said["length"]), int(said["overlap"])) if isinstance(said, dict) else None
    return chunks, every if isinstance(every, int) else None


def _cut(settings: BuildSettings, length: int | None, overlap: int | None) -> ChunkSettings:
    """How the video is cut: as asked, else as precomputed files were, else as the memory of the GPU allows."""
    from list3r.frames.chunking.chunks import ChunkSettings
    from list3r.models.cards import find_card

    card = find_card(settings.reconstruction, "geometry")
    if length is None and settings.reconstruction == "precomputed" and settings.weights is not None:
        from list3r.reconstruction.precomputed_files import read_manifest

        said = read_manifest(Path(settings.weights).expanduser())
        length, overlap = said.length, said.overlap if overlap is None else overlap
    elif length is None and card is not None:
        length = _fitting(card, settings)
    length = USUAL_CHUNK if length is None else length
    return ChunkSettings(length, max(1, min(30, round(0.3 * length))) if overlap is None else overlap)


def _fitting(card: ModelCard, settings: BuildSettings) -> int:
    """Frames that the GPU holds at once by published figures, within bounds; the usual ones without a GPU."""
    from list3r.memory.errors import OptionError
    from list3r.models.device import find_gpu, pictures_that_fit

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
