"""Lies through all commands that read and all exports, one form of each in turn, and each fifth through an edit."""

from __future__ import annotations

import gc
import os
from collections.abc import Sequence
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
    tally, message = Tally(), 0
    forms = [*_forms(READS), *([e] for e in exports()), exports(costly=True)]

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
        nonlocal message
        path = subject.with_name("lie.l3r")
        write_lie(subject, path, lie)
        message += 1
        with checked_once():
            for command in (form[message % len(form)] for form in forms):
                if reads[command] & lie.tables:
                    meet(lie, path, command)
                else:
                    tally.counts["reads nothing that lies"] += 1
        if message % 5 == 0:
            meet(lie, path, EDITS[message // 5 % len(EDITS)])

    gc.disable()
    try:
        tell()
    finally:
        gc.enable()
        gc.collect()
    return tally.batch(message)


def _forms(commands: Sequence[str]) -> list[list[str]]:
    """Return the forms of each command; a lie goes through one of each, in turn."""
    forms: dict[str, list[str]] = {}
    for command in commands:
        name, second, *_ = (*command.split(), "")
        forms.setdefault(f"{name} {second}" if name == "query" else name, []).append(command)
    return list(forms.values())
