"""Where videos come from and memories go to: this machine's disk, or any store that fsspec reaches."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

from list3r.frames.files import MAX_TEXT_BYTES, read_file
from list3r.memory.core.errors import MemoryFileError, OptionError, SourceError
from list3r.memory.store.file import rename_exclusively

_NAME = re.compile(r"[\w][\w.-]{0,99}")


def checked_name(name: str) -> str:
    """Return a memory's name, which becomes part of paths. Raises `OptionError` for one that could lead elsewhere."""
    if not _NAME.fullmatch(name):
        raise OptionError(f"{name!r} cannot be the name of a memory; use letters, digits, - and _")
    return name


def is_remote(where: str) -> bool:
    """Return whether it is a URL such as s3://bucket/walk.mp4, not a path."""
    return "://" in where


def joined(where: str, name: str) -> str:
    """Return the place of a name inside a folder or below a URL."""
    return f"{where.rstrip('/')}/{name}" if is_remote(where) else str(Path(where) / name)


def children(folder: str) -> list[tuple[str, bool]]:
    """Return the names in a folder in order, each with whether it is a folder itself. Raises `SourceError`."""
    if not is_remote(folder):
        return sorted((p.name, p.is_dir()) for p in Path(folder).iterdir())
    fs, path = _filesystem(folder)
    try:
        found = fs.ls(path, detail=True)
    except OSError as error:
        raise SourceError(f"{folder} cannot be listed: {error}") from error
    return sorted((str(f["name"]).rstrip("/").rpartition("/")[2], f["type"] == "directory") for f in found)


def listing(source: str) -> list[tuple[str, int, str]]:
    """Return name, size and, where the store has one, content tag of every file of a source, in order."""
    if not is_remote(source):
        root = Path(source)
        if root.is_file():
            return [(root.name, root.stat().st_size, "")]
        files = sorted(Path(at) / name for at, _, names in os.walk(root) for name in names)
        return [(p.relative_to(root).as_posix(), p.stat().st_size, "") for p in files if p.is_file()]
    fs, path = _filesystem(source)
    found = fs.find(path, detail=True) or {path: fs.info(path)}
    return [(name[len(path) :], int(f["size"]), str(f.get("ETag", ""))) for name, f in sorted(found.items())]


def read_text(where: str) -> str:
    """Return a text file. Raises `OptionError`."""
    try:
        if not is_remote(where):
            return read_file(Path(where), MAX_TEXT_BYTES).decode("utf-8")
        fs, path = _filesystem(where)
        return bytes(fs.cat_file(path)).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OptionError(
            f"{where} cannot be read as a manifest: {reason}; name a folder, or a file with one video per line"
        ) from error


def fetched(source: str, folder: Path) -> Path:
    """Return a source on this machine's disk: copied into `folder` where it is elsewhere. Raises `SourceError`."""
    if not is_remote(source):
        return Path(source)
    fs, path = _filesystem(source)
    target = folder / path.rstrip("/").rpartition("/")[2]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        if fs.isdir(path):
            fs.get(path.rstrip("/") + "/", f"{target}/", recursive=True)
        else:
            fs.get_file(path, str(target))
    except OSError as error:
        raise SourceError(f"{source} cannot be fetched: {error}") from error
    return target


class Output:
    """The folder or URL that memories are published to. A memory appears there whole or not at all."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._remote = is_remote(where)

    def place(self, name: str) -> str:
        """Return where a memory is."""
        return joined(self._where, f"{name}.l3r")

    def prepare(self) -> None:
        """Make the folder, and see that it can be reached. Raises `OptionError`."""
        try:
            if not self._remote:
                Path(self._where).mkdir(parents=True, exist_ok=True)
                return
            fs, path = _filesystem(self._where)
            fs.makedirs(path, exist_ok=True)
        except (OSError, PermissionError) as error:
            raise OptionError(f"--out {self._where} cannot be written: {error}") from error

    def size(self, name: str) -> int | None:
        """Return the bytes of a memory that is there, None where none is."""
        if not self._remote:
            path = Path(self.place(name))
            return path.stat().st_size if path.is_file() else None
        fs, path_there = _filesystem(self.place(name))
        return int(fs.info(path_there)["size"]) if fs.exists(path_there) else None

    def fetch(self, name: str, to: Path) -> None:
        """Copy a memory to this machine's disk, whole or not at all."""
        part = to.with_name(f"{to.name}.part")
        if self._remote:
            fs, path = _filesystem(self.place(name))
            fs.get_file(path, str(part))
        else:
            shutil.copyfile(self.place(name), part)
        part.replace(to)

    def publish(self, file: Path, name: str, *, replace: bool) -> None:
        """Put a memory there. Raises `MemoryFileError` where one is that must not be replaced, or it cannot be."""
        try:
            if self._remote:
                self._upload(file, name, replace)
            else:
                self._move(file, name, replace)
        except FileExistsError:
            raise MemoryFileError(f"{self.place(name)} already exists; move it away or name another --out") from None
        except OSError as error:
            raise MemoryFileError(f"{self.place(name)} cannot be written: {error.strerror or error}") from error

    def _move(self, file: Path, name: str, replace: bool) -> None:
        target = Path(self.place(name))
        part = target.with_name(f".{target.name}.part")
        shutil.copyfile(file, part)
        with part.open("rb") as copy:
            os.fsync(copy.fileno())
        if replace:
            part.replace(target)
        else:
            part_of(part, target)

    def _upload(self, file: Path, name: str, replace: bool) -> None:
        """An object of a store is there when all of it is."""
        fs, path = _filesystem(self.place(name))
        if not replace and fs.exists(path):
            raise FileExistsError(path)
        fs.put_file(str(file), path)
        if int(fs.info(path)["size"]) != file.stat().st_size:
            raise OSError(f"only {fs.info(path)['size']} of {file.stat().st_size} bytes were copied")


def part_of(part: Path, target: Path) -> None:
    """Give a finished copy its name, and remove it where the name is taken. Raises `FileExistsError`."""
    try:
        rename_exclusively(part, target)
    except FileExistsError:
        part.unlink(missing_ok=True)
        raise


def _filesystem(url: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it. Raises `OptionError` for one that is not known."""
    import fsspec

    try:
        fs, path = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except (ValueError, ImportError) as error:
        raise OptionError(f"{url} cannot be reached: {error}") from error
    return fs, str(path)
