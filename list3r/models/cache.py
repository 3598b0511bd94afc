"""The cache of the Hugging Face hub: its contents, their size and commit, and downloads into it.

The cache's own layout on the disk is read (`models--owner--name/refs|snapshots`), so that looking needs neither network
nor package. Fetched weights are used from then on: the name of a branch means the commit that the cache holds of
it, and nothing asks the network again.
"""

from __future__ import annotations

import os
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import getproxies

from list3r.memory.core.errors import OptionError, first_line, install_hint
from list3r.models.cards import OTHER, UNPINNED, Weights

CONFIG = "config.json"
SINGLE_FILES = (".safetensors", ".pt", ".pth", ".bin")
OLD_FILES = ("*.bin", "*.pt", "*.pth")
"""Fetched only where there is nothing newer; read without running their code."""
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_COMMIT = re.compile(r"[0-9a-f]{40}")

NO_NETWORK = (
    "the hub cannot be reached, and the cache has no copy; run `list3r models fetch {name}` where there is a network, "
    "or give --weights DIR"
)


@dataclass(frozen=True)
class Cached:
    """One commit of a repository in the cache."""

    repository: str
    commit: str
    folder: Path
    size_bytes: int

    @property
    def name(self) -> str:
        """`owner/name@commit`, which names these weights for ever."""
        return f"{self.repository}@{self.commit}"


def cache_folder() -> Path:
    """Return the hub's cache folder, by the environment variables of its own package."""
    if "HF_HUB_CACHE" in os.environ:
        return Path(os.environ["HF_HUB_CACHE"]).expanduser()
    base = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(os.environ.get("HF_HOME", f"{base}/huggingface")).expanduser() / "hub"


def find_cached(repository: str, revision: str = UNPINNED) -> Cached | None:
    """Return the cached commit of a repository at a revision; None without one that has weights."""
    base = cache_folder() / f"models--{repository.replace('/', '--')}"
    commit = revision
    if not _COMMIT.fullmatch(revision):
        reference = base / "refs" / revision
        if not reference.is_file():
            return None
        commit = reference.read_text().strip()
    folder = base / "snapshots" / commit
    files = [p for p in folder.rglob("*") if p.is_file()] if _COMMIT.fullmatch(commit) and folder.is_dir() else []
    if not any(p.suffix in SINGLE_FILES for p in files):
        return None
    return Cached(repository, commit, folder, sum(p.stat().st_size for p in files))


def split_name(name: str) -> tuple[str, str] | None:
    """`owner/name` or `owner/name@revision` as (repository, revision); None where it is no such name."""
    repository, _, revision = name.partition("@")
    return (repository, revision or UNPINNED) if _REPOSITORY.fullmatch(repository) else None


def resolve(asked: str | None, weights: Weights | None, option: str) -> str:
    """Return the weights that a run will use, fetched where they are not in the cache: a path, or `owner/name@commit`.

    `asked` is what the user gave (a path, a repository, a repository at a revision), `weights` what the card names.
    Raises `OptionError` when there is nothing to use, or it can be had neither from the disk nor from the hub.
    """
    if asked is not None and (Path(asked).expanduser().exists() or split_name(asked) is None):
        return str(_own(Path(asked).expanduser(), option).resolve())
    if asked is not None:
        repository, revision = split_name(asked) or (asked, UNPINNED)
        known = weights if weights is not None and weights.repository == repository else Weights(repository, OTHER)
        wanted = revision if "@" in asked else known.revision
    elif weights is not None:
        known, wanted = weights, weights.revision
    else:
        raise OptionError(f"{option} has no weights of its own; give them with --weights")
    return (find_cached(known.repository, wanted) or fetch(known, wanted)).name


def locate(name: str) -> Path:
    """Return the file or folder of weights that `resolve` named. Raises `OptionError` when it is no longer there."""
    if Path(name).exists():
        return Path(name)
    parts = split_name(name)
    cached = find_cached(*parts) if parts is not None else None
    if cached is None:
        raise OptionError(f"the weights {name} are gone; see `list3r models list`")
    return cached.folder


def fetch(weights: Weights, revision: str | None = None) -> Cached:
    """Bring weights into the cache, with progress on standard error; cached files are not loaded again.

    Raises `OptionError` when the hub cannot be reached, does not know them, or wants the user to be granted access.
    """
    try:
        from huggingface_hub import constants, snapshot_download
        from huggingface_hub.errors import GatedRepoError, HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled
    except ImportError:
        raise OptionError(f"downloading weights needs a package: {install_hint('models')}") from None
    name, wanted = weights.repository, revision or weights.revision
    if not _is_known(constants.ENDPOINT):  # refused at once; the package would try for half a minute
        raise OptionError(f"{name}@{wanted} cannot be fetched: {NO_NETWORK.format(name=name)}")
    why = ""
    try:
        folder = Path(snapshot_download(name, revision=wanted, allow_patterns=list(weights.files)))
        if find_cached(name, folder.name) is None:  # an old repository, from before .safetensors
            snapshot_download(name, revision=folder.name, allow_patterns=list(OLD_FILES))
    except GatedRepoError:
        why = f"its owner must grant access first: ask on its page ({name}), then `hf auth login`"
    except (LocalEntryNotFoundError, OfflineModeIsEnabled, ConnectionError, TimeoutError):
        why = NO_NETWORK
    except HfHubHTTPError as error:
        code = getattr(error.response, "status_code", "?")
        why = f"the hub refuses it (status {code}); check the name and the revision"
    except Exception as error:  # what the hub's transport raises without a network is not a closed list
        if not _is_transport(error):
            raise
        why = NO_NETWORK
    if why:
        raise OptionError(f"{name}@{wanted} cannot be fetched: {why.format(name=name)}")
    cached = find_cached(name, wanted) or find_cached(name, folder.name)
    if cached is None:
        raise OptionError(f"{name}@{wanted} has no weights of a known form ({', '.join(SINGLE_FILES)})")
    return cached


def check_weights(path: Path) -> None:
    """Raise `OptionError` for a file or folder of weights that is absent, truncated or of another format."""
    files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.suffix in SINGLE_FILES)
    if not files:
        raise OptionError(f"{path} holds no weights ({', '.join(SINGLE_FILES)})")
    for file in files:
        if file.suffix == ".safetensors":
            _check_tensors(file)
        elif file.stat().st_size < 1024:
            raise OptionError(f"{file} is {file.stat().st_size} bytes long and not a checkpoint; fetch it again")


def _check_tensors(file: Path) -> None:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file, framework="np"):
            return
    except (SafetensorError, OSError) as error:
        raise OptionError(
            f"{file} is no .safetensors file, cut off or damaged ({first_line(error)}); fetch it again"
        ) from None


def _own(path: Path, option: str) -> Path:
    if not path.exists():
        raise OptionError(
            f"--weights {path}: no such file or folder, and not a repository such as owner/name; {option} needs one"
        )
    return path


def _is_known(endpoint: str) -> bool:
    """Return whether the name of the hub's host can be looked up here; a proxy looks it up itself."""
    if getproxies():
        return True
    try:
        socket.getaddrinfo(urlparse(endpoint).hostname, None)
    except OSError:
        return False
    return True


def _is_transport(error: Exception) -> bool:
    """Return whether an error comes from the network's side, by the packages that speak to it."""
    return type(error).__module__.split(".")[0] in ("httpx", "httpcore", "requests", "urllib3", "huggingface_hub")
