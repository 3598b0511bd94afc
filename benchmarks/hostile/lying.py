"""Lies through all commands that read, all exports, and each fifth through an edit."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings

from hostile.asking import EDITS, READS, ask, checked_once, command_on, exports, warm_up
from hostile.lies import Lie, lies, write_lie
from hostile.subject import write_subject
from hostile.work import Batch, Tally, total

EACH = 50


@cache
def _subject(folder: Path) -> tuple[Path, dict[str, frozenset[str]]]:
    """Return a sound memory of this process, and the tables that each command reads of it."""
    own = folder / str(os.getpid())
    own.mkdir()
    subject = write_subject(own / "sound.l3r")
    return subject, warm_up(subject, own, (*READS, *exports(), *exports(costly=True)))


def tell(folder: Path, first_seed: int, count: int) -> Batch:
    """Tell so many lies in this process."""
    batches = [batch(folder, first_seed, n) for n in range(-(-count // EACH))]
    return total(batches)


def batch(folder: Path, first_seed: int, n: int) -> Batch:
    """Tell the lies of one batch, and count how commands ended."""
    subject, reads = _subject(folder)
    tally, told, costly = Tally(), 0, exports(costly=True)

    def meet(lie: Lie, path: Path, command: str) -> None:
        tally.add(repr(lie), command, ask(command_on(path, command, subject.parent)))

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
        with checked_once():
            for command in (*READS, *exports(), costly[told % len(costly)]):
                if reads[command] & lie.tables:
                    meet(lie, path, command)
                else:
                    tally.counts["reads nothing that lies"] += 1
        if told % 5 == 0:
            meet(lie, path, EDITS[told // 5 % len(EDITS)])

    tell()
    return tally.batch(told)
