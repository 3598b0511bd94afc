"""Discoverers, trackers and features by name; the neural ones are imported only when they are asked for."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from list3r.instances.base import Discoverer, Tracker
from list3r.instances.settings import InstanceSettings
from list3r.instances.tracking.reprojection import ReprojectionTracker
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.instances.neural.appearance import Appearance
    from list3r.reconstruction.keyframe_record import FrameDescriptor

DISCOVERERS = ("learned", "eomt", "mask2former", "sam2", "sam3", "precomputed")
TRACKERS = ("reprojection", "sam2", "sam3", "edgetam")
FEATURES = ("geometric", "own", "dinov2", "dinov3")
"""`own` are those of a neural discoverer; geometric ones (colour and shape) belong to the learned discoverer."""


def check_choice(discovery: str, tracking: str, features: str) -> None:
    """Raises `OptionError` for names that are not known or do not go together."""
    for option, value, known in (
        ("discovery", discovery, DISCOVERERS),
        ("tracking", tracking, TRACKERS),
        ("features", features, FEATURES),
    ):
        if value not in known:
            raise OptionError(f"--{option} {value} is not known; choose one of {', '.join(known)}")
    if features == "geometric" and discovery != "learned":
        raise OptionError(f"--features geometric needs --discovery learned; with {discovery} use own or dinov2")
    if features == "own" and discovery == "learned":
        raise OptionError(f"--features own are those of a neural discoverer; with {discovery} use geometric or dinov2")


def make_discoverer(
    discovery: str, features: str, folders: tuple[tuple[str, str], ...], device: str, settings: InstanceSettings
) -> Discoverer:
    """The discoverer of that name; `folders` are (part/model, folder of its weights). Raises `OptionError`.

    Networks are loaded once in a process; the learned discoverer is made for each chunk, as it caches its chunk.
    """
    where = dict(folders)
    found: Discoverer
    if discovery == "learned":
        from list3r.instances.learned.discovery import LearnedDiscoverer

        found = LearnedDiscoverer(settings)
    elif discovery == "precomputed":
        from list3r.instances.neural.precomputed_masks import PrecomputedMasks

        if "discovery/precomputed" not in where:
            raise OptionError("--discovery precomputed needs a folder: --weights discovery=DIR (docs/precomputed.md)")
        found = PrecomputedMasks(Path(where["discovery/precomputed"]), settings)
    else:
        found = _network(discovery, where[f"discovery/{discovery}"], device, settings)
    if features in ("geometric", "own"):
        return found
    from list3r.instances.neural.appearance import WithAppearance

    return WithAppearance(found, _appearance(features, where[f"features/{features}"], device))


def make_frame_descriptor(features: str, folders: tuple[tuple[str, str], ...], device: str) -> FrameDescriptor | None:
    """What describes whole frames by the network of that name, the one that describes things; None where it is none.

    Raises `OptionError`.
    """
    if features in ("geometric", "own"):
        return None
    return _appearance(features, dict(folders)[f"features/{features}"], device).whole


@lru_cache(maxsize=1)
def _network(discovery: str, folder: str, device: str, settings: InstanceSettings) -> Discoverer:
    if discovery in ("eomt", "mask2former"):
        from list3r.instances.neural.query_segmenter import QuerySegmenter

        return QuerySegmenter(discovery, Path(folder), device, settings)
    from list3r.instances.neural.sam_masks import SamMasks

    return SamMasks(discovery, Path(folder), device, settings)


@lru_cache(maxsize=1)
def _appearance(features: str, folder: str, device: str) -> Appearance:
    from list3r.instances.neural.appearance import Appearance

    return Appearance(features, Path(folder), device)


@lru_cache(maxsize=1)
def make_tracker(
    tracking: str, folders: tuple[tuple[str, str], ...], device: str, settings: InstanceSettings
) -> Tracker:
    """The tracker of that name; see `make_discoverer`. Raises `OptionError`."""
    if tracking == "reprojection":
        return ReprojectionTracker(settings)
    from list3r.instances.tracking.video_tracker import VideoTracker

    return VideoTracker(tracking, Path(dict(folders)[f"tracking/{tracking}"]), device, settings)
