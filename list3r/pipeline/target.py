"""The memory that a build writes: a new one, one to go on with, or one that takes an old one's place."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from types import TracebackType
from typing import Self

from list3r.frames.base import SourceInfo
from list3r.memory.core.errors import MemoryFileError, OptionError
from list3r.memory.store.connection import remove_memory
from list3r.memory.store.file import rename_exclusively, taken
from list3r.memory.store.store import Store
from list3r.pipeline.interrupts import uninterrupted
from list3r.pipeline.settings import BuildSettings, session_settings


class Target:
    """The memory being written. When nothing of worth came into it, what was there before is put back."""

    def __init__(self, store: Store, *, fresh: bool, replaced: Path | None = None) -> None:
        self.store = store
        self._fresh = fresh
        self._replaced = replaced

    def keep(self) -> None:
        """From now on the new memory stays, whatever happens."""
        self._fresh = False
        if self._replaced is not None and _is_marked(self.store, self._replaced):
            self._replaced.unlink(missing_ok=True)
            with self.store.transaction():
                self.store.facts.replaces = None
        self._replaced = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with uninterrupted():
            self.store.close()
            if kind is not None and self._fresh:
                remove_memory(self.store.path)
                if self._replaced is not None:
                    rename_exclusively(self._replaced, self.store.path)


def open_target(path: Path, info: SourceInfo, settings: BuildSettings, *, resume: bool, force: bool) -> Target:
    """Open what a build writes to. Raises `MemoryFileError` and `OptionError` where it may not or cannot."""
    path = path.resolve() if path.is_symlink() else path
    if path.is_dir():
        raise MemoryFileError(f"{path} is a folder; name a file for the memory, such as {path / 'memory.l3r'}")
    if path.exists() and not path.is_file():
        raise MemoryFileError(f"{path} is a device or pipe, not a regular file; name another file for the memory")
    if path.exists() and path.stat().st_size == 0:
        path.unlink()
    aside = path.with_name(f"{path.name}.replaced")  # the old memory until a camera is placed in the new one
    if not path.exists():
        if not _is_memory(aside):
            return _created(path)
        rename_exclusively(aside, path)  # a replacement was killed before the new memory was there
    if resume and not force:
        with Store.open(path) as store:
            _check_same(store, info, settings)
            begun, replaced = _holds_something(store), aside if _is_marked(store, aside) else None
        return _kept(Target(Store.open(path, writable=True), fresh=not begun, replaced=replaced), begun)
    if not force:
        raise MemoryFileError(taken(path))
    return _replacing(path, aside)


def _kept(target: Target, begun: bool) -> Target:
    """The target of a build that goes on; what it had replaced goes where the new memory holds something."""
    if begun:
        target.keep()
    return target


def _replacing(path: Path, aside: Path) -> Target:
    """A new memory in the place of an old one, which is set aside. Raises `MemoryFileError` where that cannot be."""
    with Store.open(path) as store:
        begun, ours = _holds_something(store), _is_marked(store, aside)
    if os.path.lexists(aside) and not ours:
        raise MemoryFileError(f"{aside} is in the way: --force keeps {path.name} there while it builds; move it away")
    Store.open(path, writable=True).close()
    target = None
    try:
        with uninterrupted():
            if ours and not begun:
                remove_memory(path)
            else:
                aside.unlink(missing_ok=True)
                rename_exclusively(path, aside)
            target = Target(Store.create(path), fresh=True, replaced=aside)
            with target.store.transaction():
                target.store.facts.replaces = _identity(aside)
    except BaseException as error:
        if target is not None:
            target.__exit__(type(error), error, error.__traceback__)
        elif not os.path.lexists(path):
            rename_exclusively(aside, path)
        raise
    return target


def _created(path: Path) -> Target:
    """A new memory where none was; an interruption leaves none."""
    target = None
    try:
        with uninterrupted():
            target = Target(Store.create(path), fresh=True)
    except BaseException as error:
        if target is not None:
            target.__exit__(type(error), error, error.__traceback__)
        raise
    return target


def _holds_something(store: Store) -> bool:
    """Whether the camera of any frame is placed."""
    return any(f.state == "posed" for f in store.frames.all())


def _identity(path: Path) -> tuple[int, ...] | None:
    """What tells an ordinary file from any other that may take its name."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return (found.st_ino, found.st_size, found.st_mtime_ns) if stat.S_ISREG(found.st_mode) else None


def _is_marked(store: Store, aside: Path) -> bool:
    """Whether a file is the very one that this memory replaces, and no other of that name."""
    return _identity(aside) is not None and store.facts.replaces == _identity(aside)


def _is_memory(path: Path) -> bool:
    if _identity(path) is None:
        return False
    try:
        Store.open(path).close()
    except MemoryFileError:
        return False
    return True


def _check_same(store: Store, info: SourceInfo, settings: BuildSettings) -> None:
    """Raise `OptionError` when a memory was begun from another source or with other settings."""
    for session in store.sessions.all():
        if session.fingerprint != info.fingerprint:
            same = session.source in (info.path, str(Path(info.path).resolve()))
            how = "with other frames or camera options" if same else f"not from {info.path}"
            raise OptionError(
                f"{store.path} was begun from {session.source}, {how}; "
                "give the same source and options to --resume, or --force to start again"
            )
        different = session_settings(session).differing(settings)
        if different:
            raise OptionError(
                f"{store.path} was begun with other settings ({', '.join(different)}); "
                "give the same ones to --resume, or --force to start again"
            )


def make_folder(path: Path) -> None:
    """A folder to write to, with those above it. Raises `OptionError`."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"the folder {path} cannot be created: {error.strerror}; name another one") from error
