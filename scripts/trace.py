"""What a question and a build pass through: files, functions, calls, and the share of calls that check integrity.

    python scripts/trace.py MEMORY [QUESTION] [--build FRAMES] [--json FILE]

The question is `find` in a memory just opened, counted without and with the opening. A file of integrity is one of
`INTEGRITY`: what they call counts as theirs. Processor time is that of opening and asking, of `find` and of `nearest`,
the median of `ROUNDS`. With `--build` a made-up walk of so many frames is built too. Another checkout is traced with
its folder in PYTHONPATH.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import list3r

ROOT = Path(list3r.__file__).parent
INTEGRITY = ("memory/store/pages.py", "memory/store/verify.py")
ROUNDS = 50


class Trace:
    """Calls of functions of this package while something runs."""

    def __init__(self, integrity: tuple[str, ...]) -> None:
        self.integrity = integrity
        self.calls: Counter[CodeType] = Counter()
        self.checking = 0
        """Calls, of any package, made by a file of integrity or in one."""
        self.all = 0
        self._inside = 0
        self._files: dict[str, str | None] = {}

    def run(self, work: Callable[[], object]) -> None:
        """Run something and count."""
        sys.setprofile(self._note)
        try:
            work()
        finally:
            sys.setprofile(None)

    def _note(self, frame: FrameType, event: str, argument: object) -> None:
        if event == "call":
            file = self._file(frame.f_code.co_filename)
            self.all += 1
            self._inside += file in self.integrity
            self.checking += self._inside > 0
            if file is not None:
                self.calls[frame.f_code] += 1
        elif event == "return" and self._file(frame.f_code.co_filename) in self.integrity:
            self._inside -= 1

    def _file(self, name: str) -> str | None:
        if name not in self._files:
            path = Path(name)
            self._files[name] = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else None
        return self._files[name]

    def figures(self) -> dict[str, Any]:
        """Return what was counted; the calls of each file last, most first."""
        files: Counter[str] = Counter()
        for code, count in self.calls.items():
            files[str(self._file(code.co_filename))] += count
        return {
            "files": len(files),
            "functions": len(self.calls),
            "calls": sum(files.values()),
            "calls_of_all_packages": self.all,
            "share_that_checks_integrity": round(self.checking / max(self.all, 1), 4),
            "by_file": dict(files.most_common()),
        }


def processor_ms(work: Callable[[], object]) -> float:
    """Return the median processor time of something, ms."""
    spent = []
    for _ in range(ROUNDS):
        started = time.process_time()
        work()
        spent.append(1000 * (time.process_time() - started))
    return round(statistics.median(spent), 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("memory", type=Path)
    parser.add_argument("question", nargs="?", default="cup on table")
    parser.add_argument("--build", type=int, default=0, metavar="FRAMES")
    parser.add_argument("--integrity", default=",".join(INTEGRITY), help="files of the package, with commas")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    integrity = tuple(args.integrity.split(","))

    def ask() -> None:
        with list3r.open(args.memory) as memory:
            memory.find(args.question)

    def nearest() -> None:
        with list3r.open(args.memory) as memory:
            memory.nearest((0.0, 0.0, 1.0), k=5)

    ask()  # what is imported and compiled once is not the question's
    nearest()
    asked, opened = Trace(integrity), Trace(integrity)
    with list3r.open(args.memory) as memory:
        asked.run(lambda: memory.find(args.question))
    opened.run(ask)
    result: dict[str, Any] = {"question": args.question, "find": asked.figures(), "open + find": opened.figures()}
    result["processor_ms"] = {"open + find": processor_ms(ask), "open + nearest": processor_ms(nearest)}
    if args.build:
        from list3r.simulation.dataset import WalkSettings, write_walk

        with tempfile.TemporaryDirectory() as folder:
            walk = write_walk(Path(folder) / "walk", WalkSettings(seed=3, frames=args.build), workers=1)
            built = Trace(integrity)
            built.run(lambda: list3r.build(walk, Path(folder) / "walk.l3r"))
            result[f"build of {args.build} frames"] = built.figures()
    print(json.dumps(result, indent=1))
    if args.json:
        args.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
