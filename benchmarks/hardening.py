"""Effects of hostile files and words on the program: lies, damages, command lines, bombs, and the list of findings.

    python benchmarks/hardening.py --lies 10000 --damages 1000 --command-lines 2000 --bombs \\
        --json benchmarks/results/hardening.json

    python benchmarks/hardening.py --list --json benchmarks/results/hardening-findings.json

`--list`: findings of an attack on version 0.1, row by row, in the last checkout before the repair and in this one.
`--lies`: memories of valid checksums that hold nonsense, each through all commands that read, all exports and an edit.
None may end in a traceback, take over 10 s of a processor or 1 GB. See `hostile/`. Two processes of the
lowest priority; the same command resumes.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))  # the small memories of the tests

from hostile import before_after, bombs, command_lines, damages, lying
from hostile.work import Batch, Run

EACH = 50
"""Tries of a batch."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lies", type=int, default=0)
    parser.add_argument("--damages", type=int, default=0)
    parser.add_argument("--command-lines", type=int, default=0)
    parser.add_argument("--bombs", action="store_true")
    parser.add_argument("--list", action="store_true", help="in a file of its own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.list:
        report = before_after.run_list(args.json)
        print(before_after.table(report))
        raise SystemExit(1 if before_after.open_rows(report) else 0)
    parts: dict[str, tuple[Callable[[Path, int, int], Batch], int]] = {
        "damages": (damages.batch, args.damages),
        "command lines": (command_lines.batch, args.command_lines),
        "lies": (lying.batch, args.lies),
    }
    problems = 0
    if args.bombs:
        with tempfile.TemporaryDirectory() as folder:
            report = bombs.run_bombs(Path(folder))
        Run(args.json, "bombs", {"seconds": bombs.MOST_S, "mb": bombs.MOST_MB}).finish(report)
        problems += len(report["problems"])
    for key, (work, count) in parts.items():
        if count:
            problems += len(_part(key, work, count, args)["problems"])
    raise SystemExit(1 if problems else 0)


def _part(key: str, work: Callable[[Path, int, int], Batch], count: int, args: argparse.Namespace) -> dict[str, Any]:
    batches = -(-count // EACH)
    run = Run(args.json, key, {"tries": batches * EACH, "seed": args.seed})
    with tempfile.TemporaryDirectory(dir=_fast_folder()) as folder:
        run.go(functools.partial(work, Path(folder), args.seed), batches, args.processes)
    report = run.finish()
    print(key, json.dumps(report, indent=2), flush=True)
    return report


def _fast_folder() -> str | None:
    """A folder in memory where there is one."""
    with suppress(OSError), tempfile.TemporaryFile(dir="/dev/shm"):
        return "/dev/shm"
    return None


if __name__ == "__main__":
    main()
