"""What a question and a build pass through: files, functions, calls, and the share of calls that check integrity.

    python scripts/trace.py MEMORY [QUESTION] [--build FRAMES]

The question is `find` in a memory just opened. A file of integrity is one of `INTEGRITY`: what they call counts as
theirs. With `--build` a made-up walk of so many frames is built too.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType

import list3r

ROOT = Path(list3r.__file__).parent
INTEGRITY = ("memory/store/pages.py", "memory/store/verify.py")


class Trace:
    """Calls of functions of this package while something runs."""

    def __init__(self) -> None:
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
            self._inside += file in INTEGRITY
            self.checking += self._inside > 0
            if file is not None:
                self.calls[frame.f_code] += 1
        elif event == "return" and self._file(frame.f_code.co_filename) in INTEGRITY:
            self._inside -= 1

    def _file(self, name: str) -> str | None:
        if name not in self._files:
            path = Path(name)
            self._files[name] = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else None
        return self._files[name]

    def table(self, most: int = 12) -> str:
        """Return what was counted."""
        files: Counter[str] = Counter()
        for code, count in self.calls.items():
            files[str(self._file(code.co_filename))] += count
        lines = [
            f"{len(files)} files, {len(self.calls)} functions, {sum(self.calls.values())} calls of this package;"
            f" {self.all} of all",
            f"{100 * self.checking / max(self.all, 1):.0f} % of all check integrity",
        ]
        return "\n".join([*lines, *(f"  {count:8}  {name}" for name, count in files.most_common(most))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("memory", type=Path)
    parser.add_argument("question", nargs="?", default="cup on table")
    parser.add_argument("--build", type=int, default=0, metavar="FRAMES")
    args = parser.parse_args()

    def ask() -> None:
        with list3r.open(args.memory) as memory:
            memory.find(args.question)

    ask()  # what is imported and compiled once is not the question's
    asked = Trace()
    asked.run(ask)
    print(f"find {args.question!r}: {asked.table()}")
    if args.build:
        from list3r.simulation.dataset import WalkSettings, write_walk

        with tempfile.TemporaryDirectory() as folder:
            walk = write_walk(Path(folder) / "walk", WalkSettings(seed=3, frames=args.build), workers=1)
            built = Trace()
            built.run(lambda: list3r.build(walk, Path(folder) / "walk.l3r"))
            print(f"build of {args.build} frames: {built.table()}")


if __name__ == "__main__":
    main()
