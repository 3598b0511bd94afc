"""One command in this process, bounded in time, and how it ended."""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib.util
import io
import os
import re
import shutil
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from machine import end_with_parent

from list3r.cli.app import run
from list3r.exporters.plan import drawing
from list3r.exporters.registry import FORMATS
from list3r.exporters.simready import thumbnail

LONGEST_S = 10.0
"""Processor time of a command; one that waits for something else than a processor for `WAITING_S` hangs too."""
WAITING_S = 120.0
SERVING_S = 10.0
COSTLY = ("simready", "prompt", "report", "plan", "usd")
"""Formats that take longer than all other commands about a small memory together."""
MOST_MB = 1024
READS = (
    "list --structure",
    "list --at 1",
    "list --min-confidence 0",
    "show 2",
    "show 3 --json",
    "info --loops",
    "merges",
    "verify",
    "picture 2 --out OUT.jpg",
    "find {white box on table}",
    "nearest 3",
    "nearest --point 0,0,1 --state any",
    "within --view 3",
    "within --point 0,0,1 --radius 2",
    "seen 2",
    "seen --view 3",
    "relations --predicate on",
    "relations --predicate left_of --object 2 --from camera",
    "path 3 1",
    "similar 2",
    "changes --seen-again",
)
"""Commands that read, and answer about a sound `subject`."""
EDITS = ("label 2 cup", "delete 3", "merge 2 5", "undo", "split 2 --out 2:1", "delete 5")


def exports(*, costly: bool = False) -> list[str]:
    """Return a command for each installed format, of the costly formats or of the others."""
    known = {n: f for n, f in FORMATS.items() if (n in COSTLY) == costly}
    there = {n: f for n, f in known.items() if not f.package or importlib.util.find_spec(f.package)}
    endings = {
        name: "" if form.folder else ".usda" if name == "usd" else form.suffixes[0] for name, form in there.items()
    }
    return [f"export --to {name} --out OUT-{name}{ending}" for name, ending in endings.items()]


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    ended: str
    """Its exit status, or hang, traceback, memory."""
    seconds: float
    """Processor time."""
    out: str
    message: str
    """Standard error, or the error and its place."""
    peak_mb: int = 0

    @property
    def fine(self) -> bool:
        """Whether it ended as a command may."""
        return self.ended in ("0", "1", "2")


class _TooLongError(BaseException):
    """A command took longer than any may."""


def ask(words: Sequence[str], longest_s: float | None = None, *, serves: bool = False) -> Outcome:
    """Run one command; one that serves is interrupted as by Ctrl-C."""
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace", write_through=True) for _ in range(2))
    started = time.process_time()
    message = ""
    _forget_peak()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), _alarm(longest_s, serves):
            ended = str(run(list(words)))
    except _TooLongError as error:
        ended, message = "hang", _place(error)
    except SystemExit as stop:
        ended = str(stop.code)
    except BaseException as error:
        ended, message = "traceback", f"{type(error).__name__}: {str(error)[:150]} at {_place(error)}"
    peak = peak_mb()
    if peak > MOST_MB and ended not in ("hang", "traceback"):
        ended, message = "memory", f"{peak} MB"
    printed, errors = (stream.detach().getvalue().decode() for stream in (out, err))  # type: ignore[attr-defined]
    return Outcome(ended, time.process_time() - started, printed, message or errors[:300], peak)


def command_on(memory: Path, command: str, folder: Path) -> list[str]:
    """Return the words of one of the commands above, about a memory; output goes to a new folder."""
    words = [str(folder / w) if w.startswith("OUT") else w for w in _words(command)]
    for made in (Path(word) for word in words if word.startswith(f"{folder / 'OUT'}") and Path(word).is_dir()):
        shutil.rmtree(made)
    place = 2 if words[0] == "edit" else 1
    return [*words[:place], str(memory), *words[place:]]


def warm_up(memory: Path, folder: Path, commands: Sequence[str]) -> None:
    """Run every command about a sound memory: all must answer. Makes those that follow as fast as they can be."""
    drawing.PlanSettings = functools.partial(drawing.PlanSettings, width_px=700, max_map_px=100)  # type: ignore[assignment, misc]
    thumbnail._SIDE_PX = 16
    for command in commands:
        ended = ask(command_on(memory, command, folder))
        if ended.ended != "0":
            raise SystemExit(f"`{command}` about a sound memory ended with {ended}")
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def peak_mb() -> int:
    """Return the most memory that this process had since `_forget_peak`, where the system reports it."""
    with contextlib.suppress(OSError):
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
        return int(found[1]) // 1024 if found else 0
    return 0


def _forget_peak() -> None:
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:  # noqa: PTH123
        file.write("5")


def _ready_s() -> float:
    """Return how long this process had a processor or waited for one, where the system reports it."""
    with contextlib.suppress(OSError):
        had, stood = Path("/proc/self/schedstat").read_text().split()[:2]
        return (int(had) + int(stood)) / 1e9
    return 0.0


def _place(error: BaseException) -> str:
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{Path(where.filename).name}:{where.lineno}"


@contextlib.contextmanager
def _alarm(longest_s: float | None, serves: bool) -> Iterator[None]:
    started, ready = time.monotonic(), _ready_s()

    def ring(*_: object) -> None:
        raise _TooLongError

    def look(*_: object) -> None:
        waited_s = time.monotonic() - started - (_ready_s() - ready)
        if waited_s >= WAITING_S - 1.0:
            ring()
        signal.setitimer(signal.ITIMER_REAL, WAITING_S - waited_s)

    def interrupt(*_: object) -> None:
        signal.signal(signal.SIGALRM, look)
        signal.setitimer(signal.ITIMER_REAL, WAITING_S)
        raise KeyboardInterrupt

    before = {signal.SIGPROF: signal.signal(signal.SIGPROF, ring)}
    before[signal.SIGALRM] = signal.signal(signal.SIGALRM, interrupt if serves else look)
    signal.setitimer(signal.ITIMER_PROF, longest_s or LONGEST_S)
    signal.setitimer(signal.ITIMER_REAL, SERVING_S if serves else WAITING_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _words(command: str) -> list[str]:
    """Words of a command; braces hold several together."""
    head, _, rest = command.partition("{")
    text, _, tail = rest.partition("}")
    return [*head.split(), *([text] if text else []), *tail.split()]


def be_nice() -> None:
    """Let others go first, and end with the parent."""
    end_with_parent()
    with contextlib.suppress(OSError):
        os.nice(15)
