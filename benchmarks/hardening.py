"""What hostile files and words do to the program: command lines and bombs. What damage does: `damage.py`.

    python benchmarks/hardening.py --command-lines 2000 --bombs --json benchmarks/results/hardening.json

None may end in a traceback, take over 10 s of a processor or 1 GB. The rest is said in `hostile/`. Two processes of the
lowest priority; the same command goes on where it was ended.
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

from hostile import bombs, command_lines
from hostile.work import Batch, Run

EACH = 50
"""Tries of a batch."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--command-lines", type=int, default=0)
    parser.add_argument("--bombs", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    parts: dict[str, tuple[Callable[[Path, int, int], Batch], int]] = {
        "command lines": (command_lines.batch, args.command_lines),
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
