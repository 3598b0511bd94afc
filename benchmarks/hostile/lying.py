"""Lies through all commands that read, all exports, and each fifth through an edit."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings

from hostile.asking import EDITS, READS, SLOW_S, ask, command_on, exports, warm_up
from hostile.lies import Lie, lies, write_lie
from hostile.subject import write_subject
from hostile.work import Batch, Tally, total

EACH = 50
SLOWLY = 25
"""One lie of so many goes through the slow formats."""


@cache
def _subject(folder: Path) -> tuple[Path, dict[str, frozenset[str]]]:
    """Return a sound memory of this process, and the tables that each command reads of it."""
    own = folder / str(os.getpid())
    own.mkdir()
    subject = write_subject(own / "sound.l3r")
    return subject, warm_up(subject, own, (*READS, *exports()))


def tell(folder: Path, first_seed: int, count: int) -> Batch:
    """Tell so many lies in this process."""
    batches = [batch(folder, first_seed, n) for n in range(-(-count // EACH))]
    return total(batches)


def batch(folder: Path, first_seed: int, n: int) -> Batch:
    """Tell the lies of one batch, and count how commands ended."""
    subject, reads = _subject(folder)
    tally, told = Tally(), 0

    @seed(first_seed * 1_000_003 + n)
    @settings(
        max_examples=EACH,
        database=None,
        deadline=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
        verbosity=Verbosity.quiet,
    )
    @given(lies(subject))
    def tell(lie: Lie) -> None:
        nonlocal told
        path = subject.with_name("lie.l3r")
        write_lie(subject, path, lie)
        told += 1
        for command in exports(slow=True) if told % SLOWLY == 0 else ():
            tally.add(repr(lie), command, ask(command_on(path, command, subject.parent), SLOW_S))
        edits = [EDITS[told // 5 % len(EDITS)]] if told % 5 == 0 else []
        for command in (*reads, *edits):
            if command in reads and not reads[command] & lie.tables:
                tally.counts["reads nothing that lies"] += 1
                continue
            tally.add(repr(lie), command, ask(command_on(path, command, subject.parent)))

    tell()
    return tally.batch(told)
