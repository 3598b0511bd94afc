"""The weights of the learned discoverer: one file without pickle that says its version and proves to be whole."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import OptionError

VERSION = 3
"""Of the features and layers that weights belong to; others are refused."""
SHIPPED = Path(__file__).with_name("weights.npz")
COMPUTED = Path(__file__).with_name("weights-computed.npz")
"""Shipped for depth that was computed: those that learned from few colours, too, are worse there (decision 0179)."""

Float = NDArray[np.float32]


def write_weights(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    """Write weights in half precision with version and checksum."""
    packed = {name: _packed(value) for name, value in sorted(arrays.items())}
    np.savez_compressed(path, version=np.int64(VERSION), checksum=np.array(_checksum(packed)), **packed)  # type: ignore[arg-type]


@lru_cache(maxsize=4)
def load_weights(path: Path | None = None, *, sensed: bool = True) -> Mapping[str, Float]:
    """Return the weights of a file, by default the shipped ones, for depth that a sensor measured or that was computed.

    Raises `OptionError` for what is wrong with the file.
    """
    file = path or (SHIPPED if sensed else COMPUTED)
    fix = "make it again with training/train.py" if path else "install list3r again"
    try:
        with np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        version, checksum = int(arrays.pop("version")), str(arrays.pop("checksum"))
    except FileNotFoundError:
        raise OptionError(f"the weights of discovery are missing ({file.name}): {fix}") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise OptionError(f"the weights of discovery in {file.name} cannot be read ({error}): {fix}") from error
    if version != VERSION:
        raise OptionError(f"the weights of discovery in {file.name} are of version {version}, not {VERSION}: {fix}")
    if checksum != _checksum(arrays):
        raise OptionError(f"the weights of discovery in {file.name} are damaged (checksum): {fix}")
    return {n: v.astype(np.float32) if v.dtype == np.float16 else v for n, v in arrays.items()}


def _packed(value: NDArray[np.generic]) -> NDArray[np.generic]:
    return value.astype(np.float16) if value.dtype == np.float32 and value.ndim == 2 else value


def _checksum(arrays: Mapping[str, NDArray[np.generic]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode() + b"\0" + str(arrays[name].shape).encode() + arrays[name].tobytes())
    return digest.hexdigest()
