"""The errors a user can meet. Every message names the thing that is wrong, its value, and how to put it right."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path


class List3rError(Exception):
    """Base of every error that the user can fix; the command line prints it in one line and exits with 2."""


class SourceError(List3rError):
    """A video or folder that cannot be read as frames."""


class FrameError(List3rError):
    """One frame of a source that cannot be decoded; the frame is skipped and counted."""


class OptionError(List3rError):
    """A value of an option or argument that makes no sense."""


class MemoryFileError(List3rError):
    """A memory file that is absent, foreign, damaged, locked, or of a newer schema."""


class MemoryFileWarning(UserWarning):
    """Something beside a memory file that is not its own; the command line prints it as a note."""


class UnknownIdError(List3rError, KeyError):
    """An instance id that the memory has never held, or a name that nothing in it carries."""

    __str__ = Exception.__str__  # a KeyError would put its message in quotes


class TrackingError(List3rError):
    """A video in which the camera cannot be followed."""


class BaselineError(TrackingError):
    """A stretch through which the camera moves too little for depth from colour."""


class DegenerateError(List3rError):
    """Correspondences that do not determine a transform: too few, collinear, or without extent."""


class SpaceMismatchError(List3rError):
    """Vectors of two different embedding spaces in one comparison."""


class MissingPackageError(List3rError):
    """A package that only some installs have."""


class ExportError(List3rError):
    """An export that cannot be written."""


def first_line(error: BaseException) -> str:
    """Return the first line of what an error says, or its kind where it says nothing."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = " ".join(lines[:2]) if lines and lines[0].endswith(":") else (lines[0] if lines else type(error).__name__)
    return text[:240]


def check_choice(name: str, value: str, known: Collection[str]) -> None:
    """Raise `OptionError` for a value that is none of the known ones."""
    if value not in known:
        raise OptionError(f"{name} {value} is not known; choose one of: {', '.join(known)}")


def check_share(name: str, value: float) -> None:
    """Raise `OptionError` for a share that is not in [0, 1]."""
    if not 0.0 <= value <= 1.0:
        raise OptionError(f"{name} {value:g} must lie between 0 and 1")


DISTRIBUTION = "list3r-memory"
"""This program's name in package indexes, where `list3r` is somebody else's."""
EXTRA_OF_PACKAGE = {
    "cv2": "build",
    "numba": "build",
    "av": "build",
    "PIL": "export",
    "threadpoolctl": "build",
    "torch": "colour",
    "pycolmap": "colour",
    "pxr": "export",
    "trimesh": "export",
    "matplotlib": "export",
    "ncnn": "detector",
    "lzfse": "record3d",
    "rosbags": "ros",
    "open3d": "open3d",
    "fast_simplification": "surfaces",
    "pyarrow": "parquet",
    "rerun": "rerun",
    "mcp": "mcp",
    "viser": "view",
    "fsspec": "batch",
    "ray": "ray",
    "fastapi": "serve",
    "uvicorn": "serve",
    "psycopg": "catalog",
    "transformers": "models",
    "huggingface_hub": "models",
    "safetensors": "models",
}
"""Modules that a smaller install lacks, and the extra of this package that brings each."""


def install_hint(extra: str, *also: str) -> str:
    """Return the command that adds an extra, and further packages, to the installation that runs.

    From a checkout it installs the checkout, elsewhere the distribution to which the running files belong.
    """
    root = Path(__file__).resolve().parents[3]
    checkout = _is_checkout(root)
    what = f"'.[{extra}]'" if checkout else f"'{_distribution()}[{extra}]'"
    command = " ".join(("pip install", what, *also))
    return f"{command} in the folder {shlex.quote(str(root))}" if checkout and not root.samefile(".") else command


def _is_checkout(root: Path) -> bool:
    """Whether a folder is one of ours to install from; other packages leave a `pyproject.toml` among installed ones."""
    try:
        return f'name = "{DISTRIBUTION}"' in (root / "pyproject.toml").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False


def _distribution() -> str:
    """Return the name under which what runs was installed; the usual one where several or none claim the module."""
    from importlib import metadata  # takes longer than many a question

    owners = metadata.packages_distributions().get("list3r", [])
    return owners[0] if len(owners) == 1 else DISTRIBUTION


@contextmanager
def naming_extras() -> Iterator[None]:
    """Turn a missing package of an extra into `MissingPackageError`, which names what to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in EXTRA_OF_PACKAGE:
            raise
        install = install_hint(EXTRA_OF_PACKAGE[module])
        raise MissingPackageError(f"this needs {module}, which is not installed: {install}") from None
