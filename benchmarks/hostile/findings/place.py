"""The place of a test for a finding: a folder, and the program of this process's checkout.

Uses only parts of the program that both the old and the present version have: its commands, `list3r.open`, and the
small memory of its own tests.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import traceback
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

MOST_ADDRESSES = 6 * 2**30
"""Address space of a command, bytes: a command that takes more is ended."""
PRECIOUS = b"my own words; they stay\n" * 100


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    status: int | None
    """Exit status, below 0 a signal; None if it was still running when its time was over."""
    out: str
    err: str
    wall_s: float
    cpu_s: float
    peak_mb: int

    @property
    def message(self) -> str:
        """Return all that it said."""
        return self.out + self.err

    @property
    def bad(self) -> str:
        """Return violations by a command; empty where there are none."""
        if self.status is None:
            return f"hangs ({self.wall_s:.0f} s)"
        if "Traceback" in self.err:
            return "traceback: " + self.err.strip().splitlines()[-1][:100]
        return f"ends by signal {-self.status}" if self.status < 0 else ""

    def beyond(self, seconds: float, megabytes: int) -> str:
        """Return its use beyond these bounds, or `bad`."""
        if self.peak_mb > megabytes:
            return f"takes {self.peak_mb} MB" + (f", {self.bad}" if self.bad else "")
        return self.bad or (f"takes {self.cpu_s:.1f} s of a processor" if self.cpu_s > seconds else "")


class Place:
    """An empty folder, and the program."""

    def __init__(self, folder: Path, checkout: Path) -> None:
        self.folder, self.checkout = folder, checkout

    @cached_property
    def _room(self) -> bytes:
        """A sound memory of `tests/conftest.py`, with one edit."""
        conftest = importlib.import_module("tests.conftest")
        store = importlib.import_module("list3r.memory.store.store").Store
        path = self.folder / "room.l3r"
        with store.create(path) as room, room.transaction():
            conftest.write_small_room(room)
        self.ask("label", path, 5, "old label")
        data = path.read_bytes()
        path.unlink()
        return data

    def memory(self, name: str = "m.l3r") -> Path:
        """Return a sound memory: floor, table, two mugs, chair and wall are 1 to 6."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self._room)
        return path

    def two_sessions(self) -> Path:
        """Return the memory with a second session, in which nothing was seen."""
        path = self.memory()
        with contextlib.closing(sqlite3.connect(path)) as database:
            names = [row[1] for row in database.execute("PRAGMA table_info(sessions)") if row[1] != "session_id"]
        rest = ", ".join(names)
        return lie(path, f"INSERT INTO sessions (session_id, {rest}) SELECT 2, {rest} FROM sessions")

    def older(self, name: str = "m.l3r") -> Path:
        """Return a memory of an older schema."""
        return Path(shutil.copy(self.checkout / "tests/fixtures/schema6.l3r", self.folder / name))

    def precious(self) -> Path:
        """Return a file of the user's."""
        path = self.folder / "precious.txt"
        path.write_bytes(PRECIOUS)
        return path

    def walk(self, name: str = "walk", frames: int = 4, size: tuple[int, int] = (64, 48)) -> Path:
        """Return a folder in the TUM layout: a wall 2 m away, the camera moves sideways."""
        root, (width, height) = self.folder / name, size
        wall = np.random.default_rng(0).integers(0, 255, (height, width + 2 * frames, 3), np.uint8)
        for kind in ("rgb", "depth"):
            (root / kind).mkdir(parents=True)
        for k in range(frames):
            Image.fromarray(wall[:, 2 * k : 2 * k + width]).save(root / "rgb" / f"{k}.png")
            Image.fromarray(np.full((height, width), 10_000, np.uint16)).save(root / "depth" / f"{k}.png")
        for kind in ("rgb", "depth"):
            (root / f"{kind}.txt").write_text("".join(f"{0.1 * k:.1f} {kind}/{k}.png\n" for k in range(frames)))
        step = 2 * 2.0 / width
        poses = "".join(f"{0.1 * k:.1f} {step * k} 0 0 0 0 0 1\n" for k in range(frames))
        (root / "groundtruth.txt").write_text(poses)
        (root / "calibration.txt").write_text(f"{width} {width} {width / 2} {height / 2}\n")
        return root

    def ask(self, *words: object, longest_s: float = 20.0, limit: Mapping[int, int] | None = None) -> Ended:
        """Run one command in a child of this process."""
        run = importlib.import_module("list3r.cli.app").run
        return self.do(
            lambda: run([os.fsdecode(w) if isinstance(w, bytes) else str(w) for w in words]), longest_s, limit
        )

    def do(self, work: Callable[[], Any], longest_s: float = 20.0, limit: Mapping[int, int] | None = None) -> Ended:
        """Run a function in a child of this process; its result is the exit status."""
        importlib.import_module("list3r.cli.app")
        out, err = self.folder / ".out", self.folder / ".err"
        started, child = time.monotonic(), os.fork()
        if child == 0:
            _serve(work, out, err, {resource.RLIMIT_AS: MOST_ADDRESSES} | dict(limit or {}))
        status, used = _waited(child, started + longest_s)
        texts = [p.read_text("utf-8", "backslashreplace") if p.exists() else "" for p in (out, err)]
        wall = time.monotonic() - started
        return Ended(status, texts[0], texts[1], wall, used.ru_utime + used.ru_stime, used.ru_maxrss // 1024)

    def shell(self, line: str, longest_s: float = 60.0, **environment: str) -> Ended:
        """Run a line of the shell in the folder, in which `list3r` is the program."""
        program = f'list3r() {{ "{sys.executable}" -m list3r "$@"; }}\n'
        started = time.monotonic()
        process = subprocess.Popen(
            ["bash", "-c", program + line],
            cwd=self.folder,
            env=os.environ | environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            message = process.communicate(timeout=longest_s)
            status: int | None = process.returncode
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            message, status = process.communicate(), None
        out, err = (text.decode("utf-8", "backslashreplace") for text in message)
        return Ended(status, out, err, time.monotonic() - started, 0.0, 0)


def _serve(work: Callable[[], Any], out: Path, err: Path, limits: Mapping[int, int]) -> None:
    """In the child: run the function, end with its status."""
    status: Any = 3
    try:
        for number, path in ((1, out), (2, err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        for kind, most in limits.items():
            resource.setrlimit(kind, (most, most))
        status = work()
    except SystemExit as stop:
        status = stop.code
    except BaseException:
        traceback.print_exc()
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status if isinstance(status, int) else 0)


def _waited(child: int, end: float) -> tuple[int | None, Any]:
    """Return the status of a child and its resources; None where it had to be killed."""
    while time.monotonic() < end:
        pid, status, used = os.wait4(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status), used
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    return None, os.wait4(child, 0)[2]


def spoil(path: Path, *statements: str) -> None:
    """Change rows behind the back of the program."""
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            assert database.execute(statement).rowcount > 0, statement


def lie(path: Path, *statements: str) -> Path:
    """Change rows, and make every checksum match."""
    sums = importlib.import_module("list3r.memory.store.checksums")
    words = importlib.import_module("list3r.memory.store.word_index")
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            assert database.execute(statement).rowcount, statement
        database.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
        for name, blobs in sums.OWN_CRC.items():
            keys = sums.summed_tables()[name].key
            for row in database.execute(f"SELECT {', '.join((*keys, *blobs))} FROM {name}").fetchall():
                value = 0
                for blob in row[len(keys) :]:
                    value = zlib.crc32(blob if isinstance(blob, bytes) else repr(blob).encode(), value)
                where = " AND ".join(f"{k} IS ?" for k in keys)
                database.execute(f"UPDATE {name} SET crc = ? WHERE {where}", (value, *row[: len(keys)]))
        with contextlib.suppress(sqlite3.Error, UnicodeError):
            sums.write_all(database)
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        with contextlib.suppress(sqlite3.Error, UnicodeError, AttributeError):
            words.write_words(database)
    return path


def first(*found: str) -> str:
    """Return the first that says something."""
    return next((text for text in found if text), "")
