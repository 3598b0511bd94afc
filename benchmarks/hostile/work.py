"""Many small tries in two processes: in batches that are named by a number, so that a run that ended goes on."""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from machine import STARTED_AT, machine, write_json

from hostile.asking import Outcome, be_nice

Batch = dict[str, Any]
"""Counts of how tries ended, problems, the longest and the most memory."""


class Tally:
    """Counts of a batch while it runs."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.problems: list[dict[str, str]] = []
        self.longest_s, self.peak_mb = 0.0, 0

    def add(self, what: str, command: str, outcome: Outcome, *, name: str | None = None) -> None:
        """Count how one command ended; `name` where an exit status says too little."""
        self.counts[name or f"exit {outcome.ended}"] += 1
        self.longest_s = max(self.longest_s, outcome.seconds)
        self.peak_mb = max(self.peak_mb, outcome.peak_mb)
        if not outcome.fine:
            self.problem(what, command, f"{outcome.ended} {outcome.message}")

    def problem(self, what: str, command: str, ended: str) -> None:
        """Record a violation."""
        self.problems.append({"what": what[:600], "command": command[:200], "ended": ended[:400]})
        print(self.problems[-1], file=sys.stderr, flush=True)

    def batch(self, tries: int) -> Batch:
        """Return the counts."""
        message = {"tries": tries, "counts": dict(self.counts), "problems": self.problems}
        return message | {"longest_s": round(self.longest_s, 2), "peak_mb": self.peak_mb}


class Run:
    """The tries of one kind, held in a file as they are done."""

    def __init__(self, path: Path | None, key: str, asked: dict[str, Any]) -> None:
        self.path, self.key = path, key
        held = json.loads(path.read_text(encoding="utf-8")) if path is not None and path.exists() else {}
        if held.pop("machine", machine()) != machine():
            raise SystemExit(f"{path} was measured on another machine; name another file")
        held.pop("commit", None)
        self._all: dict[str, Any] = held
        mine = held.get(key, {})
        self.batches: dict[str, Batch] = mine.get("batches", {}) if mine.get("asked") == asked else {}
        self.asked = asked

    def go(self, work: Callable[[int], Batch], count: int, processes: int) -> dict[str, Any]:
        """Do the batches that are not done, and return the sum of all; `work` is a function of a module."""
        left = [n for n in range(count) if str(n) not in self.batches]
        while left:
            broken = self._go(work, left, processes)
            for n in broken:  # a process was killed or crashed: which of the batches under way did it, alone
                if self._go(work, [n], 1):
                    self._keep(n, {"tries": 0, "problems": [{"what": f"batch {n}", "ended": "the process crashed"}]})
            left = [n for n in range(count) if str(n) not in self.batches]
        return total(self.batches.values())

    def _go(self, work: Callable[[int], Batch], numbers: list[int], processes: int) -> list[int]:
        """Do batches; returns the numbers of batches under way when a process broke."""
        todo, started = list(numbers), time.monotonic()
        under_way: dict[Future[Batch], int] = {}
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(processes, mp_context=context, initializer=be_nice) as pool:
            try:
                while todo or under_way:
                    while todo and len(under_way) < processes:
                        n = todo.pop(0)
                        under_way[pool.submit(work, n)] = n
                    for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                        self._keep(under_way[future], future.result())
                        del under_way[future]
                        done = len(numbers) - len(todo) - len(under_way)
                        print(f"{self.key}: {done} of {len(numbers)}, {time.monotonic() - started:.0f} s", flush=True)
            except BrokenProcessPool:
                return [n for n in under_way.values() if str(n) not in self.batches]
        return []

    def _keep(self, n: int, batch: Batch) -> None:
        self.batches[str(n)] = batch | {"commit": STARTED_AT}
        self._all[self.key] = {"asked": self.asked, **total(self.batches.values()), "batches": self.batches}
        write_json(self.path, self._all)

    def finish(self, message: dict[str, Any] | None = None) -> dict[str, Any]:
        """Write the given result, or the sum of the batches, and return it."""
        message = {"asked": self.asked, **(message or total(self.batches.values()))}
        self._all[self.key] = message
        write_json(self.path, self._all)
        return message


def total(batches: Iterable[Batch]) -> dict[str, Any]:
    """Return the sum of batches."""
    done, counts = list(batches), Counter[str]()
    for batch in done:
        counts.update(batch.get("counts", {}))
    return {
        "tries": sum(b["tries"] for b in done),
        "commits": sorted({b.get("commit", STARTED_AT) for b in done}),
        "counts": dict(sorted(counts.items())),
        "problems": [p for b in done for p in b["problems"]],
        "longest_s": max((b.get("longest_s", 0.0) for b in done), default=0.0),
        "peak_mb": max((b.get("peak_mb", 0) for b in done), default=0),
    }
