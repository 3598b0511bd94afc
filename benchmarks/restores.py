"""Backups put in the place of a memory whose writer was killed: what is opened is the file that was put there.

    python benchmarks/restores.py --count 300 --json benchmarks/results/restores.json

Each time a process that edits a memory is killed (SIGKILL) at a random moment. Then a backup, an older one, a copy made
while it was written, another memory or half a copy takes the name, by moving or copying, and of what the writer left
beside it (-wal, -shm, -writer) some or all is there. Or nothing was put there, or the file and its log were moved
elsewhere together: then the log must be applied. Commands that read and edit run on it in a random order. What a file
holds is read by SQLite alone, from a copy. A reader that finds anything but that is a problem, an edit that rests on
anything else, and a refusal that does not leave every byte.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import machine, write_json

from list3r.cli.app import run
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.library.maintenance import edits
from list3r.memory.store.log_mark import Log
from list3r.memory.store.store import Store
from list3r.pipeline.build import build
from list3r.pipeline.request import BuildRequest, RunOptions
from list3r.simulation.dataset import WalkSettings, write_walk

Content = dict[str, list[tuple[Any, ...]]]
Result = dict[str, Any]
BESIDE = ("-wal", "-shm", "-writer")
PUT_THERE = ("backup", "older backup", "live copy", "another memory", "half a backup", "half of the killed file")
LEFT = ("nothing", "pair moved", "pair copied", "pair of a stopped writer")
COMMANDS = ("info", "list", "verify", "label", "repair")
_NOT_COMPARED = ("pages", "log_mark")
"""What follows from the other tables."""
_FIXED = ("chunks", "frames", "local_instances", "supports", "observations")
"""What no label changes."""
_KILLED_WRITER = """
import sys
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.library.maintenance import edits
from list3r.memory.store.log_mark import Log
from list3r.memory.store.store import Store
store = Store.open(sys.argv[1], writable=True)
pages = int(sys.argv[2])
ids = [i.id for i in store.instances.all()]
for n in range(100_000):
    print(edits.label(store, ids[n % len(ids)], f"killed {n}").entry, flush=True)
    if n % pages == pages - 1:
        store.connection._database.execute("PRAGMA wal_checkpoint").fetchall()
"""


def content(path: Path, log: Path | None = None) -> Content | None:
    """What SQLite reads of a file, with a log or without one; None where it cannot."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copy(path, copy)
        if log is not None and log.exists():
            shutil.copy(log, f"{copy}-wal")
        with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(copy)) as database:
            if database.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",):
                return None
            return _rows(lambda query: database.execute(query).fetchall())
    return None


def _rows(ask: Callable[[str], list[tuple[Any, ...]]]) -> Content:
    names = [n for (n,) in ask("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY 1")]
    names = [n for n in names if not n.startswith(("instance_boxes", "words")) and n not in _NOT_COMPARED]
    return {n: sorted(ask(f"SELECT * FROM {n}"), key=repr) for n in names}


@dataclass
class Case:
    """One restore: where the file is, and what it may be opened as."""

    kind: str
    path: Path
    allowed: list[Content | None]
    """None: that it is refused."""
    foreign: bytes | None = None
    """The log of another file beside it."""


def restores(memory: Path, other: Path, folder: Path, count: int, seed: int = 0) -> Result:
    """Kill a writer of a copy of `memory` and restore something, so many times; problems, and how often what was
    done.
    """
    rng = random.Random(seed)
    outcomes: Counter[str] = Counter()
    problems: list[str] = []
    for k in range(count):
        place = folder / f"restore-{k}"
        place.mkdir()
        kind = (*PUT_THERE, *LEFT)[k % 10]
        case = _case(kind, memory, other, place, rng)
        outcome, found = _judged(case, rng)
        outcomes[f"{kind}: {outcome}"] += 1
        problems += [f"{k}, {kind}: {text}" for text in found]
        shutil.rmtree(place)
    return {"restores": count, "outcomes": dict(sorted(outcomes.items())), "problems": problems}


# ------------------------------------------------------------------------------------------- what is put there


def _case(kind: str, memory: Path, other: Path, place: Path, rng: random.Random) -> Case:
    path, kept = place / "m.l3r", place / "kept"
    kept.mkdir()
    shutil.copy(memory, path)
    _edit(path, rng.randint(1, 3))
    shutil.copy(path, kept / "older backup")
    _edit(path, rng.randint(1, 3))
    shutil.copy(path, kept / "backup")
    shutil.copy(other, kept / "another memory")
    _killed(path, kept, rng)
    log = Path(f"{path}-wal")
    if kind in LEFT:
        return _left(kind, path, kept, place)
    if kind.startswith("half"):
        whole = kept / "backup" if kind == "half a backup" else path
        data = whole.read_bytes()
        (kept / kind).write_bytes(data[: rng.randrange(len(data) // 4, len(data) * 9 // 10)])
    alone = content(kept / kind)
    with_log = content(kept / kind, log) if kind == "live copy" else None
    getattr(shutil, rng.choice(("move", "copy", "copy2")))(kept / kind, path)
    for end in BESIDE:
        if rng.random() < (0.15 if end == "-wal" else 0.4):
            Path(f"{path}{end}").unlink(missing_ok=True)
    allowed = [alone] if alone is not None else [None]
    if kind == "live copy":  # the same bytes as the killed file, where nothing was checkpointed since
        allowed += [with_log, None]
    foreign = kind not in ("live copy", "half of the killed file") and Log.read(log) is not None
    return Case(kind, path, allowed, log.read_bytes() if foreign else None)


def _left(kind: str, path: Path, kept: Path, place: Path) -> Case:
    """The file and its own log, here or elsewhere."""
    log = Path(f"{path}-wal")
    if kind == "nothing":
        return Case(kind, path, [content(path, log)])
    if kind == "pair of a stopped writer":  # over what was written later
        for end in ("", "-wal"):
            shutil.copy(kept / f"stopped{end}", f"{path}{end}")
        return Case(kind, path, [content(path, log)])
    there = place / "elsewhere" / "other name.l3r"
    there.parent.mkdir()
    for end in ("", "-wal"):
        (shutil.move if kind == "pair moved" else shutil.copy)(f"{path}{end}", f"{there}{end}")
    return Case(kind, there, [content(there, Path(f"{there}-wal"))])


def _edit(path: Path, count: int) -> None:
    with Store.open(path, writable=True) as store:
        for n in range(count):
            edits.label(store, store.instances.all()[n].id, f"label {n}")


def _killed(path: Path, kept: Path, rng: random.Random) -> None:
    """Kill a writer amid its edits; before that, copy its file, and both of its files while it is stopped."""
    command = [sys.executable, "-c", _KILLED_WRITER, str(path), str(rng.choice((2, 4, 1000)))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for _ in range(rng.randint(1, 6)):
            writer.stdout.readline()
        writer.send_signal(signal.SIGSTOP)
        time.sleep(0.01)
        shutil.copy(path, kept / "live copy")
        for end in ("", "-wal"):
            shutil.copy(f"{path}{end}", kept / f"stopped{end}")
        writer.send_signal(signal.SIGCONT)
        for _ in range(rng.randint(1, 6)):
            writer.stdout.readline()
        time.sleep(rng.uniform(0.0, 0.03))
        writer.kill()


# ------------------------------------------------------------------------------------------- what is done with it


def _judged(case: Case, rng: random.Random) -> tuple[str, list[str]]:
    """How a case came out, and what is wrong with that."""
    found: list[str] = []
    opened: set[bool] = set()
    noted = False
    holds = case.allowed
    for command in rng.sample(COMMANDS, len(COMMANDS)):
        before = case.path.read_bytes()
        status, out, err = _list3r(command, case.path)
        noted = noted or "the log of another file" in err
        now = _read(case.path)
        if status and command == "repair" and case.path.read_bytes() != before:
            found.append("a refused repair changed the file")
        if status:
            opened.add(False)
            if None not in holds:
                found.append(f"{command} was refused: {out}{err}")
            if case.path.read_bytes() != before:
                found.append(f"a refused {command} changed the file")
            continue
        if command == "repair" and None in holds and "nothing was changed" not in out:
            if Path(f"{case.path}.damaged").read_bytes() != before:
                found.append("repair did not keep the original")
            return "refused, then repaired", found
        opened.add(True)
        if command == "label":
            held = [c for c in holds if c is not None and _is_labelled(c, now)]
            if not held:
                found.append("label wrote on something else than the file")
            holds = [now]
        elif now not in holds:
            found.append(f"{command} found something else than the file")
        if command in ("info", "list", "verify") and case.path.read_bytes() != before:
            found.append(f"{command} wrote into the file")
    if case.foreign is not None:
        found += _foreign_faults(case, noted)
    return "refused" if opened == {False} else "opened", found


def _list3r(command: str, path: Path) -> tuple[int, str, str]:
    """Status, output and errors of one command."""
    words = [*(["edit", "label"] if command == "label" else [command]), str(path)]
    if command == "label":
        words += ["2", "restored"]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = run(words)
    return status, out.getvalue(), err.getvalue()


def _read(path: Path) -> Content | None:
    """What a reader of the program finds; None where it is refused."""
    with warnings.catch_warnings(action="ignore"), contextlib.suppress(MemoryFileError), Store.open(path) as store:
        with store.connection.snapshot():
            return _rows(store.connection.rows)
    return None


def _is_labelled(before: Content, now: Content | None) -> bool:
    """Whether the one difference is a label, and its entry is the next."""
    if now is None:
        return False
    old, new = before["edits"], now["edits"]
    fixed = all(before[name] == now[name] for name in _FIXED)
    others = [[r for r in state["instances"] if r[0] != 2] for state in (before, now)]
    added = [row for row in new if row not in old]
    next_entry = max((row[0] for row in old), default=0) + 1
    return fixed and others[0] == others[1] and len(new) == len(old) + 1 and [r[0] for r in added] == [next_entry]


def _foreign_faults(case: Case, noted: bool) -> list[str]:
    aside = Path(f"{case.path}-wal.foreign-1")
    if None not in case.allowed and not noted:
        return ["nothing was said of the log of another file"]
    kept = aside if aside.exists() else Path(f"{case.path}-wal")
    return [] if kept.exists() and kept.read_bytes() == case.foreign else ["the log of another file is lost"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k in range(2):
            walk = write_walk(folder / f"walk{k}", WalkSettings(seed=3 + k, frames=20, size=(128, 96)), workers=1)
            build(walk, folder / f"{k}.l3r", settings=BuildRequest(poses="given"), run=RunOptions(workers=0))
        result = restores(folder / "0.l3r", folder / "1.l3r", folder, args.count, args.seed)
    print(machine(), json.dumps(result, indent=2))
    write_json(args.json, {"asked": {"count": args.count, "seed": args.seed}, **result})
    if result["problems"]:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
