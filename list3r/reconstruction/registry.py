"""The reconstruction models by name. Each is one file of this room, imported only when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from types import ModuleType

from list3r.memory.core.errors import OptionError
from list3r.reconstruction.base import Reconstructor
from list3r.reconstruction.settings import ReconstructionSettings

__all__ = ["MODELS", "ModelOptions", "make_reconstructor"]


@dataclass(frozen=True)
class ModelOptions:
    """The inputs of every reconstruction model."""

    poses: str = "estimate"
    """given, prior or estimate."""
    camera_known: bool = True
    """False where the given camera is only a guess, which the model may improve."""
    device: str = "auto"
    """cpu, cuda, cuda:1, ... or auto: the first GPU where there is one."""
    weights: str | None = None
    """A folder, a file or `repository@revision` of weights instead of the model's own; None for its own."""
    local_features: str = "sift"
    """Local features by which `sfm` matches pictures that tracks do not connect: sift or aliked."""
    feature_weights: str | None = None
    """File of the weights of learned local features."""
    settings: ReconstructionSettings = field(default_factory=ReconstructionSettings)
    """Settings of all models; each takes its own."""


@dataclass(frozen=True)
class ModelEntry:
    """Module and needs of a model."""

    module: str
    """Module under `list3r.reconstruction`, which has `make(options: ModelOptions) -> Reconstructor`."""
    needs_depth: bool = False
    """Works on RGB-D only."""
    needs_camera: bool = False
    """Needs the intrinsics; the others find the focal length themselves."""
    calibration: str = ""
    """Module that estimates an unknown camera before the chunks, by `calibrate(source, settings)`."""
    thins: bool = False
    """Needs depth of only some of the frames where all show the same from nearly the same place."""
    skips: bool = False
    """Can skip frames between those that get depth."""
    maps_videos: bool = False
    """Has `placed(frames, camera, T_map_cam)` for chunks of a video that was mapped as a whole before."""
    by_cameras: bool = False
    """Knows its cameras better than its surfaces: chunks are joined by both, loops refined by features."""
    follows_prior: bool = False
    """Starts from given but imperfect poses, and improves them."""
    reads_files: bool = False
    """Reads geometry from a folder that is given as weights, with its chunk length and overlap."""


MODELS: dict[str, ModelEntry] = {
    "rgbd": ModelEntry(
        "rgbd.reconstructor", needs_depth=True, needs_camera=True, follows_prior=True, thins=True, skips=True
    ),
    "sfm": ModelEntry(
        "sfm.reconstructor", calibration="sfm.calibration", thins=True, maps_videos=True, by_cameras=True
    ),
    "pi3": ModelEntry("networks.pi3"),
    "pi3x": ModelEntry("networks.pi3x"),
    "vggt": ModelEntry("networks.vggt"),
    "mapanything": ModelEntry("networks.mapanything"),
    "da3": ModelEntry("networks.da3"),
    "dust3r": ModelEntry("networks.dust3r"),
    "mast3r": ModelEntry("networks.mast3r"),
    "cut3r": ModelEntry("networks.cut3r"),
    "ttt3r": ModelEntry("networks.ttt3r"),
    "fast3r": ModelEntry("networks.fast3r"),
    "precomputed": ModelEntry("precomputed", reads_files=True),
}
"""All that `--reconstruction` knows."""


def make_reconstructor(name: str, options: ModelOptions) -> Reconstructor:
    """Return the model of that name. Raises `OptionError` for a name that is not known or a package that is missing."""
    return import_model(name).make(options)  # type: ignore[no-any-return]


def import_model(name: str) -> ModuleType:
    """Return the module of the model of that name, imported."""
    return import_module(f"list3r.reconstruction.{entry(name).module}")


def usual_model(has_depth: bool) -> str:
    """Return the model that needs no weights for a source with or without depth."""
    return next(name for name, model in MODELS.items() if model.needs_depth == has_depth)


def entry(name: str) -> ModelEntry:
    """Return the entry of a name. Raises `OptionError` for one that is not known."""
    if name not in MODELS:
        raise OptionError(f"--reconstruction {name} is not known; choose one of {', '.join(MODELS)}, auto")
    return MODELS[name]
