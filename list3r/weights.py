"""Files of weights: arrays without pickle, in half precision, that say their version and prove to be whole."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import OptionError
from list3r.memory.store.derived import cache_folder

Float = NDArray[np.float32]


@dataclass(frozen=True)
class WeightsFormat:
    """What weights are for, and of which version."""

    what: str
    """As in "the weights of ...", for messages."""
    version: int
    """Of the features and layers that weights belong to; others are refused."""

    def write(self, path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Write arrays, matrices among them in half precision, with version and checksum."""
        packed = {name: _packed(value) for name, value in sorted(arrays.items())}
        np.savez_compressed(path, version=np.int64(self.version), checksum=np.array(_checksum(packed)), **packed)  # type: ignore[arg-type]

    def read(self, path: Path, fix: str) -> dict[str, Float]:
        """Return the arrays of a file. Raises `OptionError` for what is wrong with it, and says how to `fix` it."""
        name = f"the weights of {self.what}"
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays = {key: data[key] for key in data.files}
            version, checksum = int(arrays.pop("version")), str(arrays.pop("checksum"))
        except FileNotFoundError:
            raise OptionError(f"{name} are missing ({path.name}): {fix}") from None
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise OptionError(f"{name} in {path.name} cannot be read ({error}): {fix}") from error
        if version != self.version:
            raise OptionError(f"{name} in {path.name} are of version {version}, not {self.version}: {fix}")
        if checksum != _checksum(arrays):
            raise OptionError(f"{name} in {path.name} are damaged (checksum): {fix}")
        return {n: v.astype(np.float32) if v.dtype == np.float16 else v for n, v in arrays.items()}


def _packed(value: NDArray[np.generic]) -> NDArray[np.generic]:
    return value.astype(np.float16) if value.dtype == np.float32 and value.ndim >= 2 else value


def _checksum(arrays: Mapping[str, NDArray[np.generic]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode() + b"\0" + str(arrays[name].shape).encode() + arrays[name].tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class PublishedFile:
    """A file that somebody published, known by its digest."""

    url: str
    sha256: str
    size_bytes: int


def fetch_files(what: str, files: Mapping[str, PublishedFile], note: Callable[[str], None]) -> Path:
    """Return the folder that holds files by name, loaded where they are not in the cache; `note` hears of that before.

    Raises `OptionError` where the network cannot be reached, or where what comes is not what was published.
    """
    folder = cache_folder("weights")
    missing = {n: f for n, f in files.items() if not _is(folder / n, f)}
    if missing:
        host = urlsplit(next(iter(missing.values())).url).hostname
        size = sum(f.size_bytes for f in missing.values()) / 1e6
        note(f"fetching {what} from {host}, {size:.1f} MB, once; it is kept in {folder}")
    for name, file in missing.items():
        try:
            with urlopen(file.url, timeout=30) as answer:
                data = answer.read(file.size_bytes + 1)
        except OSError as error:
            raise OptionError(f"{what} cannot be fetched ({error}); give its file by --detector FILE") from None
        if hashlib.sha256(data).hexdigest() != file.sha256:
            raise OptionError(f"{name} from {file.url} is not the file that was published; give one by --detector FILE")
        folder.mkdir(parents=True, exist_ok=True)
        part = folder / f"{name}.{os.getpid()}.part"
        part.write_bytes(data)
        part.replace(folder / name)
    return folder


def _is(path: Path, file: PublishedFile) -> bool:
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == file.sha256
