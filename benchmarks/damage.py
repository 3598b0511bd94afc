"""What damage does to answers: bytes flipped, pages zeroed, swapped, of an earlier state, the log of another file.

    python benchmarks/damage.py --damages 1000 --json benchmarks/results/damage.json

Memories of three sizes: one of the tests, one built of a short walk, one of made-up instances. Each is damaged, opened
and asked nine questions, each in a memory opened anew. An answer must be that of the sound memory, or a refusal in one
line; the counts say how many were silent, wrong, or a traceback. Every tenth is edited too: a file that `verify` calls
damaged must not verify as sound after it. A third of the damages falls on each size.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))  # the small memory of the tests

from hostile.subject import write_subject
from machine import machine, write_json
from scale import write_memory

import list3r
from list3r.cli.app import run
from list3r.exporters.scene_json import scene_dict
from list3r.memory.core.errors import List3rError
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
from list3r.simulation.dataset import WalkSettings, write_walk

PAGE = 16384
QUESTIONS: dict[str, Callable[[list3r.SceneMemory], object]] = {
    "find words": lambda m: m.find("red table"),
    "find relation": lambda m: m.find("box on table"),
    "nearest": lambda m: m.nearest((1.0, 1.0, 0.5)),
    "within": lambda m: m.within(center=(1.0, 1.0, 0.5), radius=2.0),
    "get": lambda m: m.store.instances.get(2),
    "relations": lambda m: m.relations(3),
    "similar": lambda m: m.store.embeddings.of(m.store.embeddings.spaces()[0], [2, 3, 5])[1].tobytes(),
    "cameras": lambda m: [f.T_chunk_cam.tobytes() for f in m.store.frames.all()],
    "surface": lambda m: m.store.surfaces.of(2).points.tobytes(),
}


def flip(data: bytearray, old: bytes, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 3))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def flip_header(data: bytearray, old: bytes, rng: random.Random) -> None:
    data[rng.randrange(100)] ^= 1 << rng.randrange(8)


def zero(data: bytearray, old: bytes, rng: random.Random) -> None:
    page, length = rng.randrange(len(data) // PAGE), rng.choice((512, 4096, PAGE, PAGE))
    at = page * PAGE + rng.randrange(PAGE // length) * length
    data[at : at + length] = bytes(length)


def swap(data: bytearray, old: bytes, rng: random.Random) -> None:
    a, b = (PAGE * n for n in rng.sample(range(len(data) // PAGE), 2))
    data[a : a + PAGE], data[b : b + PAGE] = data[b : b + PAGE], data[a : a + PAGE]


def stale(data: bytearray, old: bytes, rng: random.Random) -> None:
    """Some pages, or a part of one, are those of an earlier state: a copy made while the file was written."""
    pages = [n for n in range(min(len(old), len(data)) // PAGE) if old[n * PAGE :][:PAGE] != data[n * PAGE :][:PAGE]]
    for page in rng.sample(pages, min(len(pages), rng.choice((1, 1, 2, 4)))):
        start = page * PAGE + rng.choice((0, 0, 4096, 8192))
        data[start : (page + 1) * PAGE] = old[start : (page + 1) * PAGE]


DAMAGES = {"flip": flip, "header": flip_header, "zero": zero, "swap": swap, "stale": stale}


class Subject:
    """A sound memory, what it answers, its state some edits earlier, and the log of a copy that went another way."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.old = path.read_bytes()
        other = path.with_name("other.l3r")
        shutil.copy(path, other)
        for n, label in ((5, "chair"), (2, "red table")):
            with Store.open(path, writable=True) as store:
                edits.label(store, n, label)
        self.data = path.read_bytes()
        with Store.open(other, writable=True) as store:
            edits.label(store, 5, "lamp")
            edits.label(store, 6, "red table")
            self.log = Path(f"{other}-wal").read_bytes()
        self.sound = {name: str(ask(path, name)[1]) for name in QUESTIONS}

    def damage(self, kind: str, rng: random.Random) -> None:
        """Write the damaged file."""
        data = bytearray(self.data)
        for old in self.path.parent.glob(f"{self.path.name}*"):
            old.unlink()
        if kind == "log":
            Path(f"{self.path}-wal").write_bytes(self.log)
        else:
            DAMAGES[kind](data, self.old, rng)
        self.path.write_bytes(data)


def ask(path: Path, name: str) -> tuple[str, str]:
    """How a question ended: answered, refused or a traceback; and with what."""
    try:
        with list3r.open(path) as memory:
            return "answered", repr(QUESTIONS[name](memory))
    except List3rError as error:
        return "refused", str(error)
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {error}"


def try_one(subject: Subject, kind: str, seed: str, counts: Counter[str], problems: list[str], edit: bool) -> None:
    """Damage a memory and ask it."""
    subject.damage(kind, random.Random(seed))
    for name in QUESTIONS:
        ended, told = ask(subject.path, name)
        if ended == "answered":
            ended = "right" if told == subject.sound[name] else "wrong"
        counts[f"{kind}: {ended}"] += 1
        if ended in ("wrong", "traceback"):
            problems.append(f"{subject.path.stem}, {seed}: {name}: {ended} {told[:200] if ended != 'wrong' else ''}")
    if edit:
        before = run(["verify", str(subject.path), "--json"])
        run(["edit", "label", str(subject.path), "3", "vase"])
        if before and not run(["verify", str(subject.path), "--json"]) and not _is_mended(subject.path):
            problems.append(f"{subject.path.stem}, {seed}: an edit signed the damage")
        counts[f"{kind}: verify {'sound' if before == 0 else 'damaged'}"] += 1


def _is_mended(path: Path) -> bool:
    """Whether a memory can be read as a whole; what was damaged may be of no use to it."""
    try:
        with Store.open(path) as store:
            return bool(scene_dict(store))
    except List3rError:
        return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--damages", type=int, default=1000)
    parser.add_argument("--instances", type=int, default=20_000, help="of the largest memory")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    counts: Counter[str] = Counter()
    problems: list[str] = []
    kinds = [*DAMAGES, "log"]
    started, sizes = time.process_time(), {}
    with tempfile.TemporaryDirectory() as name:
        for n, make in enumerate((_small, _built, lambda folder: _large(folder, args.instances))):
            folder = Path(name) / str(n)
            folder.mkdir()
            subject = Subject(make(folder))
            sizes[subject.path.stem] = round(len(subject.data) / 1e6, 2)
            for k in range(n, args.damages, 3):
                kind = kinds[k // 3 % len(kinds)]
                try_one(subject, kind, f"{args.seed}:{k}", counts, problems, k // 3 // len(kinds) % 10 == 0)
    told: dict[str, Any] = {"damages": args.damages, "file_mb": sizes, "outcomes": dict(sorted(counts.items()))}
    told |= {"cpu_s": round(time.process_time() - started, 1), "problems": problems}
    print(machine(), json.dumps(told, indent=1))
    write_json(args.json, told)
    raise SystemExit(1 if problems else 0)


def _small(folder: Path) -> Path:
    return write_subject(folder / "small.l3r")


def _built(folder: Path) -> Path:
    source = write_walk(folder / "walk", WalkSettings(seed=3, frames=36, size=(128, 96)), workers=1)
    assert run(["build", str(source), "-m", str(folder / "built.l3r")]) == 0
    return folder / "built.l3r"


def _large(folder: Path, count: int) -> Path:
    write_memory(folder / "large.l3r", count, 1)
    return folder / "large.l3r"


if __name__ == "__main__":
    main()
