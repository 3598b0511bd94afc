"""Loads a network whose class comes with its authors' own package and whose weights lie in a folder or one file."""

from __future__ import annotations

import contextlib
import io
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.memory.errors import OptionError
from list3r.models.cache import check_weights
from list3r.models.cards import ModelCard

if TYPE_CHECKING:
    import torch


def upstream_class(card: ModelCard, module: str, name: str) -> Any:
    """A class of the package that a card names. Raises `OptionError`, with what installs it, where it is missing."""
    try:
        return getattr(import_module(module), name)
    except ImportError as error:
        missing = error.name or module
        hint = card.install if missing.split(".")[0] in card.packages else f"pip install {missing.split('.')[0]}"
        raise OptionError(f"{card.name} needs the package {missing.split('.')[0]}: {hint}") from None
    except AttributeError:
        raise OptionError(f"this version of {module} has no {name}: {card.install}") from None


def load_upstream(cls: Any, path: Path, device: torch.device) -> Any:
    """A network of the class with the weights at `path`, in evaluation mode on the device.

    A folder is read by the class's own `from_pretrained` (with its `config.json` where it has one); a single file is
    a state dict for the class's defaults, read without unpickling code. Raises `OptionError` in one line when the
    weights are damaged or another network's.
    """
    check_weights(path)
    try:
        with contextlib.redirect_stdout(
            io.StringIO()
        ):  # packages print while they load; standard output is for results
            model, names = (_from_folder if path.is_dir() else _from_file)(cls, path)
    except OptionError:
        raise
    except Exception as error:  # what torch, safetensors and the class raise on foreign weights is not a closed list
        raise OptionError(f"{path} cannot be loaded as {cls.__name__}: {first_line(error)}") from None
    _check_complete(model, names, path)
    return model.to(device).eval()


def _from_folder(cls: Any, folder: Path) -> tuple[Any, set[str]]:
    from safetensors import safe_open

    names: set[str] = set()
    for file in folder.glob("*.safetensors"):
        with safe_open(file, framework="pt") as tensors:
            names.update(tensors.keys())
    if not names:
        raise OptionError(f"{folder} holds no .safetensors file; give the checkpoint itself: --weights FILE")
    return cls.from_pretrained(str(folder), local_files_only=True), names


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
        raise OptionError(f"{file} is no state dict of a network")
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


def first_line(error: BaseException) -> str:
    """The first line of what an error says, or its kind where it says nothing."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = " ".join(lines[:2]) if lines and lines[0].endswith(":") else (lines[0] if lines else type(error).__name__)
    return text[:240]
