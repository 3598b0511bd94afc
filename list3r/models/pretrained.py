"""Loads a network of the `transformers` package from a folder or from the cache of the hub, onto a device."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.memory.core.errors import OptionError, check_choice, first_line, install_hint
from list3r.models.cache import CONFIG, check_weights
from list3r.models.device import out_of_memory_reported

if TYPE_CHECKING:
    import torch


RENAMED = {"Sam3TrackerModel": {r"^tracker_model\.": ""}}
"""Layer names to replace in published weights, by class, where transformers 5.23 does not know them:
facebook/sam3 is one checkpoint of a detector and a tracker."""


def pick_device(name: str) -> torch.device:
    """`auto` is the first GPU where there is one. Raises `OptionError` for a device that is not there."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
            raise OptionError(f"--device {name}: there is no such GPU here; use --device cpu")
    except RuntimeError:
        raise OptionError(f"--device {name} is not known; give cpu, cuda or cuda:1") from None
    return device


def load_named(
    kinds: Mapping[str, str], option: str, name: str, folder: Path, device: str, *, exact: bool = False
) -> tuple[Any, torch.device]:
    """Return the network of a model's name, by its class, and its device.

    `exact` keeps it in float32 everywhere, for networks that half precision breaks.
    Raises `OptionError` as `pick_device` and `load_pretrained` do, and for a name that is none of the kinds.
    """
    check_choice(f"--{option}", name, kinds)
    chosen = pick_device(device)
    return load_pretrained(kinds[name], folder, chosen, exact=exact), chosen


def network_dtype(device: torch.device) -> torch.dtype:
    """bfloat16 on a GPU that computes in it (compute capability 8 and up), float32 elsewhere."""
    import torch

    new = device.type == "cuda" and torch.cuda.get_device_capability(device)[0] >= 8
    return torch.bfloat16 if new else torch.float32


def load_pretrained(class_name: str, folder: Path, device: torch.device, *, exact: bool = False) -> Any:
    """Return the network of a folder with `config.json` and weights, in evaluation mode, of `network_dtype` or float32.

    Raises `OptionError` when the package is missing, the folder is not such a folder, or the weights are of another
    network (a missing or an unexpected layer, another shape).
    """
    cls = _transformers_class(class_name)
    check_folder(folder)
    import torch
    from transformers.utils import logging

    dtype = torch.float32 if exact else network_dtype(device)
    level = logging.get_verbosity()
    logging.set_verbosity_error()  # type: ignore[no-untyped-call]
    try:
        model, report = cls.from_pretrained(
            folder, dtype=dtype, local_files_only=True, output_loading_info=True, key_mapping=RENAMED.get(class_name)
        )
    except (OSError, ValueError, RuntimeError, KeyError, AttributeError, TypeError, ImportError) as error:
        raise OptionError(f"{folder} cannot be loaded as {class_name}: {first_line(error)}") from None
    finally:
        logging.set_verbosity(level)
    wrong = sorted(str(k) for k in (*report["missing_keys"], *report["mismatched_keys"]))
    if wrong:
        raise OptionError(
            f"{folder} holds other weights than {class_name} needs: {len(wrong)} of its layers are missing or have "
            f"another shape, first {wrong[0]}"
        )
    with out_of_memory_reported(f"the network {folder}"):
        return model.to(device).eval()


def check_folder(folder: Path) -> None:
    """Raises `OptionError` unless the folder has a configuration and whole weights."""
    if not folder.is_dir():
        raise OptionError(f"the folder of weights {folder} does not exist; see `list3r models list`")
    if not (folder / CONFIG).is_file():
        raise OptionError(f"{folder} has no {CONFIG}; give the folder that the weights' repository was saved to")
    check_weights(folder)


def space_name(model: str, folder: Path, dimensions: int) -> str:
    """Name of the embedding space of a network's features, `model@revision/dim`.

    The revision is the hub's where the folder is a snapshot of its cache, else a digest of configuration and weights.
    """
    if folder.parent.name == "snapshots":
        return f"{model}@{folder.name[:12]}/{dimensions}"
    digest = hashlib.sha256((folder / CONFIG).read_bytes())
    for path in sorted(folder.glob("*.safetensors")):
        with path.open("rb") as file:
            digest.update(file.read(1 << 20))
            file.seek(max(0, path.stat().st_size - (1 << 20)))
            digest.update(file.read())
    return f"{model}@{digest.hexdigest()[:12]}/{dimensions}"


def _transformers_class(name: str) -> Any:
    try:
        import transformers
    except ImportError:
        raise OptionError(f"{name} needs the package transformers; {install_hint('models')}") from None
    found = getattr(transformers, name, None)
    if found is None:
        raise OptionError(f"this version of transformers ({transformers.__version__}) has no {name}; upgrade it")
    return found
