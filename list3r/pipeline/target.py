"""The memory that a build writes: a new one, one to go on with, or one that takes an old one's place."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Self

from list3r.frames.base import SourceInfo
from list3r.memory.errors import MemoryFileError, OptionError
from list3r.memory.store.codec import to_json
from list3r.memory.store.connection import remove_memory
from list3r.memory.store.store import Store
from list3r.pipeline.chunk import BuildSettings


class Target:
    """The memory being written. When nothing of worth came into it, what was there before is put back."""

    def __init__(self, store: Store, *, fresh: bool, replaced: Path | None = None) -> None:
        self.store = store
        self._fresh = fresh
        self._replaced = replaced

    def keep(self) -> None:
        """From now on the new memory stays, whatever happens."""
        self._fresh = False
        if self._replaced is not None:
            self._replaced.unlink(missing_ok=True)
            self._replaced = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.store.close()
        if kind is not None and self._fresh:
            remove_memory(self.store.path)
            if self._replaced is not None:
                self._replaced.rename(self.store.path)


def open_target(path: Path, info: SourceInfo, settings: BuildSettings, *, resume: bool, force: bool) -> Target:
    """Open what a build writes to. Raises `MemoryFileError` and `OptionError` where it may not or cannot."""
    path = path.resolve() if path.is_symlink() else path
    if path.is_dir():
        raise MemoryFileError(f"{path} is a folder; name a file for the memory, such as {path / 'memory.l3r'}")
    if path.exists() and not path.is_file():
        raise MemoryFileError(f"{path} is a device or pipe, no ordinary file; name another file for the memory")
    if path.exists() and path.stat().st_size == 0:
        path.unlink()
    replaced = _left_aside(path)
    if not path.exists():
        return Target(Store.create(path), fresh=True)
    if resume and not force:
        with Store.open(path) as store:
            _check_same(store, info, settings)
            begun = _holds_something(store)
        return Target(Store.open(path, writable=True), fresh=not begun, replaced=replaced)
    if not force:
        raise MemoryFileError(f"{path} exists already; use --resume to go on with it or --force to replace it")
    Store.open(path, writable=True).close()
    if replaced is None:
        replaced = _aside(path)
        path.rename(replaced)
    else:
        remove_memory(path)
    return Target(Store.create(path), fresh=True, replaced=replaced)


def _holds_something(store: Store) -> bool:
    """Whether the camera of any frame is placed."""
    return any(f.state == "posed" for f in store.frames())


def _aside(path: Path) -> Path:
    """Where `--force` keeps the old memory until a camera is placed in the new one."""
    return path.with_name(f"{path.name}.replaced")


def _left_aside(path: Path) -> Path | None:
    """The old memory that a killed `--force` left aside: put back where no new one is, removed where one has begun."""
    aside = _aside(path)
    if not aside.is_file():
        return None
    try:
        Store.open(aside).close()
    except MemoryFileError:
        raise MemoryFileError(f"{aside} is no memory, but has the name that --force needs; move it away") from None
    if not path.exists():
        aside.rename(path)
        return None
    with Store.open(path) as store:
        begun = _holds_something(store)
    if begun:
        aside.unlink()
    return None if begun else aside


def _check_same(store: Store, info: SourceInfo, settings: BuildSettings) -> None:
    """Raise `OptionError` when a memory was begun from another source or with other settings."""
    for session in store.sessions():
        if session.fingerprint != info.fingerprint:
            raise OptionError(
                f"{store.path} was begun from {session.source} with other frames or camera options; "
                "give the same source and options to --resume, or --force to begin anew"
            )
        wanted = json.loads(to_json(asdict(settings)))
        different = sorted(k for k in wanted if session.settings.get(k) != wanted[k])
        if different:
            raise OptionError(
                f"{store.path} was begun with other settings ({', '.join(different)}); "
                "give the same ones to --resume, or --force to begin anew"
            )


def make_folder(path: Path) -> None:
    """A folder to write to, with those above it. Raises `OptionError`."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"the folder {path} cannot be made: {error.strerror}; name another one") from error
