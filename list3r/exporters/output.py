"""Write files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from list3r.memory.core.errors import ExportError, OptionError

if TYPE_CHECKING:
    from list3r.memory.store.store import Store


T = TypeVar("T")


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name next to `path` to write to; it replaces `path` when the block ends without an error.

    Raises `ExportError` before the block when the folder is absent or not writable or when something is at `path` that
    an export must not replace (a folder, a device, a memory file), and for every failure of the disk inside it.
    """
    path = Path(path)
    check_target(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        for left in _left_behind(path, f".{path.stem}.*.tmp{path.suffix}"):
            left.unlink(missing_ok=True)
        temporary.unlink(missing_ok=True)
        temporary.touch(exist_ok=False)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise ExportError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_together(parts: Iterable[tuple[Path, T]], write: Callable[[T, Path], None]) -> tuple[Path, ...]:
    """Write each part to its file by `write(part, path)`, all of them or none. Returns the files."""
    written = []
    with contextlib.ExitStack() as stack:
        for target, part in parts:
            write(part, stack.enter_context(replacing(target)))
            written.append(target)
    return tuple(written)


@contextlib.contextmanager
def replacing_folder(folder: str | Path, kind: str) -> Iterator[Path]:
    """Yield a temporary folder next to `folder`; it takes its place when the block ends without an error.

    The file `list3r-KIND.json` marks it: a folder that has one is replaced, any other folder with files is refused.
    Raises `ExportError` for that, and for every failure of the disk inside the block.
    """
    folder, ours = Path(folder), f"list3r-{kind}.json"
    if not folder.parent.is_dir():
        raise ExportError(f"the folder {folder.parent} does not exist; create it first")
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder} is a file; name a folder for the export")
    temporary, old = (folder.with_name(f".{folder.name}.{os.getpid()}.{end}") for end in ("tmp", "old"))
    try:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / ours).is_file():
            raise ExportError(f"{folder} holds other files; name a new folder for the export")
        for left in _left_behind(folder, f".{folder.name}.*.old"):
            if not folder.exists():  # the earlier folder, where the exchange was interrupted
                left.replace(folder)
            shutil.rmtree(left, ignore_errors=True)
        for left in [*_left_behind(folder, f".{folder.name}.*.tmp"), temporary]:
            shutil.rmtree(left, ignore_errors=True)
        temporary.mkdir()
        yield temporary
        if not (temporary / ours).exists():
            (temporary / ours).write_text(
                json.dumps({"format": f"list3r-{kind}", "version": 1}) + "\n", encoding="utf-8"
            )
        if folder.is_dir():
            folder.replace(old)
        temporary.replace(folder)
    except OSError as error:
        raise ExportError(f"{folder} cannot be written: {error.strerror or error}") from error
    finally:
        if old.is_dir() and not folder.exists():
            old.replace(folder)
        for rest in (temporary, old):
            shutil.rmtree(rest, ignore_errors=True)


def _left_behind(path: Path, pattern: str) -> list[Path]:
    """Return leftovers of killed exports to `path`; the number of the process is the `*`."""
    if sys.platform == "win32":  # where asking for a process would end it
        return []
    before, after = pattern.split("*")
    found = [p for p in path.parent.iterdir() if p.name.startswith(before) and p.name.endswith(after)]
    numbers = {p: p.name[len(before) : -len(after)] for p in found}
    return [p for p, number in numbers.items() if number.isdecimal() and not _runs(int(number))]


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def check_target(path: Path) -> None:
    """Raise `ExportError` when `path` cannot or must not be written."""
    try:
        if not path.parent.is_dir():
            raise ExportError(f"the folder {path.parent} does not exist; create it first")
        if path.is_dir():
            raise ExportError(f"{path} is a folder; name a file in it")
        if path.exists() and not path.is_file():
            raise ExportError(f"{path} is not a regular file; name another one")
        if is_database(path):
            raise ExportError(f"{path} is a memory file or another SQLite database; name another file for the export")
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise ExportError(f"the folder {path.parent} is not writable; choose another one or change its permissions")
    except OSError as error:
        raise ExportError(f"{path} cannot be written: {error.strerror or error}") from error


def is_database(path: Path) -> bool:
    """Return whether a path is a memory or another SQLite file."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(16) == b"SQLite format 3\x00"
    except PermissionError:
        return False


def part_path(path: Path, name: str) -> Path:
    """Return the path of a further file: `scene.component_7.ply` next to `scene.ply`; `path` for no name."""
    return path.with_name(f"{path.stem}.{name}{path.suffix}") if name else path


def units(store: Store) -> str:
    """Return the unit of length: "m" for a metric or anchored memory, "unit" for a relative one (arbitrary scale) and a
    guessed one (about a metre)."""
    return "m" if store.facts.scale_kind in ("metric", "anchored") else "unit"


def check_metre(store: Store, *, guessed: bool) -> None:
    """Raise `OptionError` for a memory without metric scale; where the metre is guessed, unless that is taken."""
    from list3r.memory.library.world.scale import lengths_of  # numpy, which help does not need

    known = lengths_of(store).metric == "guessed"
    if units(store) != "m" and not (known and guessed):
        raise OptionError(
            f"{store.path.name} has no metric scale, which a simulator needs: `list3r edit scale --anchor` gives it one"
            + (", --guessed-metre takes the guess" if known else "")
        )


def check_density(density: float | None) -> None:
    """Raise `OptionError` for a density, kg per cubic metre, that nothing has."""
    if density is not None and not 0 < density < 1e6:
        raise OptionError(f"density {density:g}: give kilograms per cubic metre, such as 300")
