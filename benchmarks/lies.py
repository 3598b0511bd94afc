"""Memories that lie: well-formed files with valid checksums that hold what no program of ours writes.

    python benchmarks/lies.py MEMORY --count 1000 --seed 0

Each lie takes a sound memory, changes a value or a few (another type, out of range, too long or short, not finite, in a
circle, arrays of another shape), signs all rows anew and goes through all commands that read, and all exports. None may
end in a traceback, run for over `LONGEST_S`, or take over a gigabyte.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import resource
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from list3r.cli.app import run
from list3r.memory.store.checksums import OWN_CRC, summed_tables, write_all
from list3r.memory.store.rows.codec import pack, unpack
from list3r.memory.store.word_index import write_words

LONGEST_S = 10.0
COMMANDS = (
    "list --structure",
    "show 2",
    "info --loops",
    "merges",
    "verify",
    "query find {white box on table}",
    "query nearest --id 3",
    "query nearest --point 0,0,1",
    "query within --view 3",
    "query within --center 0,0,1 --radius 2",
    "query seen 2",
    "query seen --view 3",
    "query relations --predicate on",
    "query path 3 1",
    "query similar --id 2",
    "query changes",
    "list --at 1",
    "export --to json --out OUT.json",
    "export --to usd --out OUT.usda",
    "export --to ply --out OUT.ply",
    "export --to glb --out OUT.glb",
    "export --to tum --out OUT.txt",
    "export --to plan --out OUT.png",
    "export --to csv --out OUT.csv",
)
EDITS = ("label 2 cup", "delete 3", "merge 2 4", "undo")
_TEXTS = ("", "x", "\x1b[2J\n9 forged", "a\x00b", "é" * 5000, "'\"<script>&\\", "[]", "{}", "null", "NaN", "[" * 3000)
_NUMBERS = (0, -1, 1, 2**31, 2**62, -(2**62), 0.5, -0.5, 1e300, -1e300, float("inf"), 1e-300)


def tell_lies(base: Path, count: int, seed: int, folder: Path, *, edits: bool = True) -> dict[str, Any]:
    """Return how `count` lies ended: exits, problems (lie, command, what happened), the longest command, memory."""
    outcomes: Counter[str] = Counter()
    problems: list[dict[str, str]] = []
    longest = 0.0
    for n in range(count):
        rng = random.Random(f"{seed}:{n}")
        path = folder / "lie.l3r"
        what = write_lie(base, path, rng)
        for command in (*COMMANDS, *(rng.sample(EDITS, 1) if edits else ())):
            ended, seconds, told = outcome(path, command, folder)
            outcomes[ended] += 1
            longest = max(longest, seconds)
            if ended not in ("0", "1", "2"):
                problems.append({"lie": f"{seed}:{n} {what}", "command": command, "ended": ended, "told": told})
                print(problems[-1], file=sys.stderr, flush=True)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    told_of = {"lies": count, "seed": seed, "commands": sum(outcomes.values()), "exits": dict(sorted(outcomes.items()))}
    return told_of | {"problems": problems, "longest_s": round(longest, 2), "peak_mb": round(peak_mb)}


def outcome(path: Path, command: str, folder: Path) -> tuple[str, float, str]:
    """Run one command: how it ended (exit status, or the kind of failure), in what time, and what it said of that."""
    words = [str(folder / w) if w.startswith("OUT") else w for w in _words(command)]
    place = 2 if words[0] == "query" else 1
    out, err, started = io.StringIO(), io.StringIO(), time.monotonic()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), _alarm():
            ended = str(run([*words[:place], str(path), *words[place:]]))
    except _TooLongError:
        return "hang", time.monotonic() - started, ""
    except SystemExit as stop:
        ended = str(stop.code)
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        name = f"{type(error).__name__}: {str(error)[:150]} at {Path(where.filename).name}:{where.lineno}"
        return "traceback", time.monotonic() - started, name
    return ended, time.monotonic() - started, err.getvalue()[:300]


class _TooLongError(BaseException):
    """A command took longer than any may."""


@contextlib.contextmanager
def _alarm() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise _TooLongError

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _words(command: str) -> list[str]:
    """Words of a command; braces hold several together."""
    head, _, rest = command.partition("{")
    text, _, tail = rest.partition("}")
    return [*head.split(), *([text] if text else []), *tail.split()]


# --------------------------------------------------------------------------------------------- lies


def write_lie(base: Path, path: Path, rng: random.Random) -> str:
    """Copy a memory, change it and sign it anew; in words what was changed."""
    while True:
        shutil.copyfile(base, path)
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.execute("PRAGMA synchronous=OFF")
            database.execute("BEGIN")
            told = [_change(database, rng) for _ in range(rng.choice((1, 1, 1, 2)))]
            if any(told):
                _sign(database)
                database.execute("COMMIT")
                return "; ".join(filter(None, told))


def _change(database: sqlite3.Connection, rng: random.Random) -> str:
    """Change one value of a random row, or of all rows of a table; empty where SQLite refuses it."""
    tables = {n: t for n, t in summed_tables().items() if database.execute(f"SELECT 1 FROM {n} LIMIT 1").fetchall()}
    name = rng.choice(sorted(tables))
    table = tables[name]
    column = rng.choice(table.columns)
    keys = ", ".join(table.key)
    rows = database.execute(f"SELECT {keys}, {column} FROM {name} ORDER BY {keys}").fetchall()
    chosen = rows if rng.random() < 0.25 else [rng.choice(rows)]
    lie: Any = None
    for row in chosen:
        lie = _lie(row[-1], rows, rng)
        where = " AND ".join(f"{k} IS ?" for k in table.key)
        try:
            database.execute(f"UPDATE {name} SET {column} = {lie[0]} WHERE {where}", (*lie[1], *row[:-1]))
        except sqlite3.Error:
            return ""
    return f"{name}.{column} of {len(chosen)}: {str(lie)[:80]}"


def _lie(value: Any, rows: list[Any], rng: random.Random) -> tuple[str, tuple[Any, ...]]:
    """An SQL expression and its arguments, to stand in the place of a value."""
    kind = rng.choice(("type", "range", "text", "other", "own", "own"))
    if kind == "type":
        return "?", (rng.choice((None, "text", 7, 0.5, b"\x00\x01\x02", b"")),)
    if kind == "range":
        return "?", (rng.choice(_NUMBERS),)
    if kind == "text":
        return ("CAST(? AS TEXT)", (b"caf\xe9 \xff",)) if rng.random() < 0.2 else ("?", (rng.choice(_TEXTS),))
    if kind == "other":
        return "?", (rng.choice(rows)[-1],)
    return "?", (_own_kind(value, rng),)


def _own_kind(value: Any, rng: random.Random) -> Any:
    """A value of the same type that says something else."""
    if isinstance(value, bytes):
        return _arrays(value, rng) if value[:2] == b"PK" and rng.random() < 0.8 else _bytes(value, rng)
    if isinstance(value, str):
        changed = value.replace("1", rng.choice(("-1", "1e400", '"x"', "null", "[]", "99999999999"))).replace("]", "")
        return rng.choice((value * rng.choice((2, 50)), value[: len(value) // 2], changed, value[::-1]))
    if isinstance(value, int):
        return rng.choice((value + 1, value - 1, -value, value + 1000, value * 7 + 3))
    return rng.choice((-1.0, 2.0, 1e12, 0.0)) if isinstance(value, float) else rng.choice(("x", 1, 2.5, b"1234"))


def _bytes(value: bytes, rng: random.Random) -> bytes:
    data = bytearray(value)
    if len(data) >= 8 and rng.random() < 0.7:
        number = rng.choice((float("nan"), float("inf"), 1e300, -1e300, 0.0, 1e-300, -1.0))
        at = 8 * rng.randrange(len(data) // 8)
        data[at : at + 8] = np.float64(number).tobytes() * 1
        return bytes(data)
    return rng.choice((bytes(data[:-1]), bytes(data[: len(data) // 2]), bytes(data) * 2, bytes(len(data)), b""))


def _arrays(value: bytes, rng: random.Random) -> bytes:
    """The same archive with one of its arrays changed."""
    arrays = unpack(value, "a row")
    name = rng.choice(sorted(arrays))
    array = arrays[name]
    change = rng.choice(("drop", "type", "shape", "numbers", "empty", "bomb"))
    if change == "drop":
        del arrays[name]
    elif change == "type":
        arrays[name] = array.astype(rng.choice(("<f8", "|b1", "<i8", "<u1")))
    elif change == "shape":
        arrays[name] = array.reshape(-1) if array.ndim != 1 else array.reshape(1, -1)
    elif change == "empty":
        arrays[name] = array[:0] if array.ndim else array.reshape(-1)[:0]
    elif change == "bomb":
        arrays[name] = np.zeros((4_000_000,), array.dtype)
    else:
        number = rng.choice((-1, 2**31 - 1, 0, 250))
        changed = array.astype(np.float64)
        changed = changed * 0 + (float("nan") if array.dtype.kind == "f" and rng.random() < 0.5 else number)
        arrays[name] = changed.astype(array.dtype)
    return pack(arrays)


def _sign(database: sqlite3.Connection) -> None:
    """Make every checksum that of what is there."""
    for name, blobs in OWN_CRC.items():
        keys = summed_tables()[name].key
        where = " AND ".join(f"{k} IS ?" for k in keys)
        for row in database.execute(f"SELECT {', '.join((*keys, *blobs))} FROM {name}").fetchall():
            value = 0
            for blob in row[len(keys) :]:
                value = zlib.crc32(blob if isinstance(blob, bytes) else repr(blob).encode(), value)
            database.execute(f"UPDATE {name} SET crc = ? WHERE {where}", (value, *row[: len(keys)]))
    database.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
    with contextlib.suppress(sqlite3.Error):
        write_all(database)
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    with contextlib.suppress(sqlite3.Error, UnicodeError):
        write_words(database)


def main() -> None:
    """Tell lies of a memory and print how they ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("memory", type=Path)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    words = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report = tell_lies(words.memory, words.count, words.seed, Path(folder))
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
