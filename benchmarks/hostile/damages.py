"""Damaged memories through all questions and edits: equal to the sound file's answer or refused, never signed anew.

A damage flips bits, swaps, zeroes, tears or repeats pages, appends some or cuts some off. A question to the damaged
file must have the answer of the sound one, or be refused. An edit of a file that `verify` reports as damaged must leave
it reported; an edit of one reported as sound must have the result of the same edit of the sound file.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from hostile.asking import EDITS, READS, Outcome, ask, command_on, warm_up
from hostile.subject import write_subject
from hostile.work import Batch, Tally

EACH = 50
QUESTIONS = (*(c for c in READS if c != "verify"), "export --to json --out OUT.json", "export --to tum --out OUT.txt")
_CONTENT = "export --to json --out OUT.json"
_PAGE = 4096


@dataclass(frozen=True)
class _Sound:
    """A sound memory, and its answers."""

    path: Path
    data: bytes
    older: bytes
    """The file some edits earlier."""
    answers: dict[str, str]
    edited: dict[str, str]
    """Result of each edit, by the edit."""


def batch(folder: Path, first_seed: int, n: int) -> Batch:
    """Damage the memory as often as a batch says, and count what came of it."""
    sound = _sound(folder)
    tally = Tally()
    for k in range(n * EACH, (n + 1) * EACH):
        rng = random.Random(f"{first_seed}:{k}")
        data, what = damaged(sound.data, sound.older, rng)
        _write(sound.path, data)
        _ask_all(sound, what, tally)
        verdict = _ask(sound.path, "verify")
        tally.add(what, "verify", verdict, name=f"verify: {'sound' if verdict.ended == '0' else 'damaged'}")
        for edit in (EDITS[0], EDITS[1 + k % (len(EDITS) - 1)]):
            _write(sound.path, data)
            _edit(sound, edit, what, verdict, tally)
    return tally.batch(EACH)


def damaged(data: bytes, older: bytes, rng: random.Random) -> tuple[bytes, str]:
    """Return a damaged copy, and the damage."""
    kind = rng.choice(sorted(_KINDS))
    changed = bytearray(data)
    message = _KINDS[kind](changed, older, rng)
    return bytes(changed), f"{kind} {message}"


def _flip(data: bytearray, _: bytes, rng: random.Random) -> str:
    places = [rng.randrange(len(data)) for _ in range(rng.choice((1, 1, 3)))]
    for at in places:
        data[at] ^= 1 << rng.randrange(8)
    return f"at {places}"


def _swap(data: bytearray, _: bytes, rng: random.Random) -> str:
    a, b = (rng.randrange(len(data) // _PAGE) for _ in range(2))
    one, two = _page(a), _page(b)
    data[one], data[two] = data[two], data[one]
    return f"pages {a}, {b}"


def _zero(data: bytearray, _: bytes, rng: random.Random) -> str:
    page = rng.randrange(len(data) // _PAGE)
    data[_page(page)] = bytes(_PAGE)
    return f"page {page}"


def _tear(data: bytearray, older: bytes, rng: random.Random) -> str:
    """Of a page that an edit wrote, one part was never written."""
    pages = [k for k in range(len(older) // _PAGE) if older[_page(k)] != data[_page(k)]]
    page, part = rng.choice(pages), 512 * rng.randrange(1, 8)
    data[page * _PAGE + part : (page + 1) * _PAGE] = older[page * _PAGE + part : (page + 1) * _PAGE]
    return f"page {page} from byte {part}"


def _stale(data: bytearray, older: bytes, rng: random.Random) -> str:
    """A page that an edit wrote was never written."""
    page = rng.choice([k for k in range(len(older) // _PAGE) if older[_page(k)] != data[_page(k)]])
    data[_page(page)] = older[_page(page)]
    return f"page {page}"


def _append(data: bytearray, _: bytes, rng: random.Random) -> str:
    count = rng.choice((1, 1, 7, 100))
    more = rng.choice((bytes(_PAGE), rng.randbytes(_PAGE), bytes(data[_page(rng.randrange(len(data) // _PAGE))])))
    data += more * count
    return f"{count} pages"


def _cut(data: bytearray, _: bytes, rng: random.Random) -> str:
    length = rng.choice((rng.randrange(len(data)), _PAGE * rng.randrange(len(data) // _PAGE)))
    del data[length:]
    return f"to {length} bytes"


_KINDS: dict[str, Callable[[bytearray, bytes, random.Random], str]] = {
    "flip": _flip,
    "swap": _swap,
    "zero": _zero,
    "tear": _tear,
    "stale": _stale,
    "append": _append,
    "cut": _cut,
}


def _page(k: int) -> slice:
    return slice(k * _PAGE, (k + 1) * _PAGE)


def _ask_all(sound: _Sound, what: str, tally: Tally) -> None:
    for question in QUESTIONS:
        outcome = _ask(sound.path, question)
        message = "refused" if outcome.ended == "2" else "equal" if outcome.ended == "0" else outcome.ended
        tally.add(what, question, outcome, name=f"question: {message}")
        if outcome.ended == "0" and _answer(outcome, sound.path) != sound.answers[question]:
            tally.problem(what, question, f"another answer: {outcome.out[:300]}")


def _edit(sound: _Sound, edit: str, what: str, verdict: Outcome, tally: Tally) -> None:
    before = sound.path.read_bytes()
    outcome = _ask(sound.path, edit)
    message = "refused" if outcome.ended == "2" else "accepted" if outcome.ended == "0" else outcome.ended
    tally.add(what, edit, outcome, name=f"edit: {message}")
    after = _ask(sound.path, "verify")
    if verdict.ended != "0" and after.ended == "0":
        tally.problem(what, edit, f"{message}, and the damaged file verifies as sound")
    if verdict.ended == "0" and outcome.ended == "0":
        content = _answer(_ask(sound.path, _CONTENT), sound.path)
        if after.ended != "0" or content != sound.edited[edit]:
            tally.problem(what, edit, "accepted, and comes to something else than that of the sound file")
    if outcome.ended == "2" and verdict.ended != "0" and len(before) != sound.path.stat().st_size:
        tally.counts["edit: refused, the file has another length"] += 1


def _answer(outcome: Outcome, path: Path) -> str:
    """Output of a command without the size of the file, and its files."""
    written = [p.read_bytes() for p in sorted(path.parent.glob("OUT.*"))]
    return f"{[line for line in outcome.out.splitlines() if not line.startswith('size mb')]}{written}"


def _write(path: Path, data: bytes) -> None:
    for old in path.parent.glob(f"{path.name}*"):
        old.unlink()
    path.write_bytes(data)


def _ask(path: Path, command: str) -> Outcome:
    """Run a command in an empty folder."""
    for old in path.parent.glob("OUT.*"):
        old.unlink()
    return ask(command_on(path, command, path.parent))


@cache
def _sound(folder: Path) -> _Sound:
    own = folder / str(os.getpid())
    own.mkdir()
    path = write_subject(own / "subject.l3r")
    warm_up(path, own, QUESTIONS)
    older = path.read_bytes()
    for edit in ("label 5 chair", "label 6 wall"):
        _ask(path, edit)
    data, edited = path.read_bytes(), {}
    answers = {q: _answer(_ask(path, q), path) for q in QUESTIONS}
    for edit in EDITS:
        _write(path, data)
        if _ask(path, edit).ended != "0":
            raise SystemExit(f"`{edit}` of a sound memory was refused")
        edited[edit] = _answer(_ask(path, _CONTENT), path)
    return _Sound(path, data, older, answers, edited)
