"""Loads a network whose class is in its authors' own package and whose weights are in a folder or one file."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.memory.core.errors import OptionError, first_line
from list3r.models.cache import SINGLE_FILES, check_weights
from list3r.models.cards import ModelCard
from list3r.models.device import out_of_memory_reported

if TYPE_CHECKING:
    import torch


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Swallow what a package prints and warns of while it is imported, loads or runs: standard output is for results,
    and its deprecated calls are no concern of the user's."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def upstream_class(card: ModelCard, module: str, name: str) -> Any:
    """Return a class of the package that a card names.

    Raises `OptionError`, with what installs it, where it is missing.
    """
    try:
        with quiet():
            found = import_module(module)
    except ImportError as error:
        missing = error.name or module
        hint = card.installed_by if missing.split(".")[0] in card.packages else f"pip install {missing.split('.')[0]}"
        raise OptionError(f"{card.name} needs the package {missing.split('.')[0]}: {hint}") from None
    except Exception as error:  # binary packages that do not fit each other raise anything
        raise OptionError(f"{card.name} needs {module}, which cannot be imported here: {first_line(error)}") from None
    if not hasattr(found, name):
        raise OptionError(f"this version of {module} has no {name}: {card.installed_by}")
    return getattr(found, name)


def load_upstream(cls: Any, path: Path, device: torch.device) -> Any:
    """Return a network of the class with the weights at `path`, in evaluation mode on the device.

    A folder is read by the class's own `from_pretrained` (with its `config.json` where it has one); a single file is
    a state dict for the class's defaults, read without unpickling code. Raises `OptionError` in one line when the
    weights are damaged or another network's.
    """
    check_weights(path)
    try:
        with quiet():
            model, names = (_from_folder if path.is_dir() else _from_file)(cls, path)
    except OptionError:
        raise
    except Exception as error:  # what torch, safetensors and the class raise on foreign weights is not a closed list
        raise OptionError(f"{path} cannot be loaded as {cls.__name__}: {first_line(error)}") from None
    _check_complete(model, names, path)
    with out_of_memory_reported(f"the network {path}"):
        return model.to(device).eval()


def _from_folder(cls: Any, folder: Path) -> tuple[Any, set[str]]:
    from safetensors import safe_open

    names: set[str] = set()
    for file in folder.glob("*.safetensors"):
        with safe_open(file, framework="pt") as tensors:
            names.update(tensors.keys())
    if not names:
        return _from_file(cls, _only_checkpoint(folder))
    return cls.from_pretrained(str(folder), local_files_only=True), names


def _only_checkpoint(folder: Path) -> Path:
    """The one file of weights in a folder of an older kind (facebook/VGGT-1B-Commercial is such a repository)."""
    files = [p for p in sorted(folder.iterdir()) if p.suffix in SINGLE_FILES]
    if len(files) != 1:
        raise OptionError(f"{folder} holds {len(files)} checkpoints and none is .safetensors; give one: --weights FILE")
    return files[0]


def _from_file(cls: Any, file: Path) -> tuple[Any, set[str]]:
    import torch

    if file.suffix == ".safetensors":
        from safetensors.torch import load_file

        state: Any = load_file(file)
    else:
        state = torch.load(file, map_location="cpu", weights_only=True)
    if isinstance(state, dict) and isinstance(state.get("model"), dict):
        state = state["model"]
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise OptionError(f"{file} is not a state dict of a network")
    model = cls()
    model.load_state_dict(state, strict=False)
    return model, set(state)


def _check_complete(model: Any, names: set[str], path: Path) -> None:
    """Every parameter must have come from the file, or share its memory with one that did."""
    wanted = model.state_dict()
    held = {wanted[n].data_ptr() for n in names & wanted.keys()}
    missing = sorted(n for n, t in wanted.items() if n not in names and t.data_ptr() not in held and t.numel())
    if missing:
        raise OptionError(
            f"{path} holds other weights than {type(model).__name__} needs: {len(missing)} of {len(wanted)} tensors "
            f"are missing, first {missing[0]}"
        )
