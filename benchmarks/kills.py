"""kill -9 at random moments: while a memory is built, updated, written to, and edited by an operator or by commands.

Every process is real and is killed by the kernel. After each kill the file must verify and hold all that was committed
before; a build or an update goes on with --resume and must come to the scene of one that was left alone.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from machine import descendants

from list3r.exporters.scene_json import scene_dict
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import MergeDecision, Relation
from list3r.memory.library.consolidation import consolidate
from list3r.memory.store.connection import remove_memory
from list3r.memory.store.facts import Fact
from list3r.memory.store.store import Store

Result = dict[str, Any]
_EDIT = Fact[int]("edit", int, 0)
"""The number of the change that was written last."""
CHUNKING = ("--poses", "given", "--chunk", "12", "--overlap", "4", "--workers", "1")


def build_command(walk: Path, memory: Path, *more: str) -> list[str]:
    """The program, building."""
    return [sys.executable, "-m", "list3r", "build", str(walk), "-m", str(memory), *CHUNKING, *more]


def update_command(walk: Path, memory: Path, *more: str) -> list[str]:
    """The program, adding one more video."""
    return [sys.executable, "-m", "list3r", "update", str(memory), str(walk), *CHUNKING, *more]


def chunks_in(memory: Path) -> int:
    """Chunks that a reader sees now."""
    try:
        with Store.open(memory) as store:
            return len(store.chunks.all())
    except MemoryFileError:
        return 0


def judge(memory: Path, committed: int) -> list[str]:
    """Errors of a memory after a kill."""
    if not memory.exists():
        return [f"{committed} committed chunks are gone with the file"] if committed else []
    try:
        with Store.open(memory) as store:
            found = store.verify()
            held = len(store.chunks.all())
    except Exception as error:  # whatever it is, it is a problem to report
        return [f"{type(error).__name__}: {error}"]
    return [*found, *([f"{committed} chunks were committed, {held} are left"] if held < committed else [])]


# ------------------------------------------------------------------------------------------- builds and updates


def kill_builds(walk: Path, folder: Path, kills: int, seed: int = 0) -> Result:
    """Kill builds at random moments; each resumes, and starts again once it is done."""
    whole, memory = folder / "whole.l3r", folder / "killed.l3r"
    return _kill_runs(
        build_command(walk, whole),
        build_command(walk, memory, "--resume"),
        whole,
        memory,
        lambda _: None,
        kills,
        random.Random(seed),
    )


def kill_updates(base: Path, walk: Path, folder: Path, kills: int, seed: int = 0) -> Result:
    """Kill updates of a built memory with a second video; each resumes, and starts again once it is done."""
    whole, memory = folder / "updated.l3r", folder / "killed-update.l3r"
    return _kill_runs(
        update_command(walk, whole),
        update_command(walk, memory, "--resume"),
        whole,
        memory,
        lambda path: shutil.copy(base, path),
        kills,
        random.Random(seed),
    )


def _kill_runs(
    alone: list[str],
    resumed: list[str],
    whole: Path,
    memory: Path,
    begin: Callable[[Path], object],
    kills: int,
    rng: random.Random,
) -> Result:
    remove_memory(whole)
    begin(whole)
    first = chunks_in(whole)
    pace = _pace(alone, whole)
    with Store.open(whole) as store:
        wanted = scene_dict(store)
    remove_memory(memory)
    begin(memory)
    counts: Counter[str] = Counter()
    problems: list[str] = []
    while True:
        least = chunks_in(memory)
        process = subprocess.Popen(resumed, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if counts["kills"] < kills and _reaches(process, memory, *_moment(pace, first, least, rng)):
            before = chunks_in(memory)
            process.kill()
            process.communicate()
            counts["kills"] += 1
            counts["with chunks committed"] += before > first
            counts["with chunks committed by the killed run"] += before > least
            counts["after the last chunk"] += before == first + len(pace) - 1
            problems += judge(memory, max(least, before))
            continue
        text = process.communicate()[1]
        counts["completed"] += 1
        problems += judge(memory, least)
        if process.returncode != 0:
            problems.append(f"--resume failed: {text.strip()}")
        else:
            with Store.open(memory) as store:
                if scene_dict(store) != wanted:
                    problems.append("what was resumed differs from what was left alone")
        if counts["kills"] >= kills:
            return {"kills": kills, **counts, "problems": problems}
        remove_memory(memory)
        begin(memory)


def _pace(command: list[str], memory: Path) -> list[float]:
    """Run to the end; processor seconds to the first chunk that is committed, from each to the next, and to the end."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    held, spent, at = chunks_in(memory), 0.0, [0.0]
    while process.poll() is None:
        spent = max(spent, _spent_s(process))
        now = chunks_in(memory)
        at += [spent] * (now - held)
        held = now
        time.sleep(0.05)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: {process.communicate()[1].strip()}")
    return [b - a for a, b in zip(at, [*at[1:], spent], strict=True)]


def _moment(pace: list[float], first: int, held: int, rng: random.Random) -> tuple[int, float]:
    """When to kill: some time after so many chunks are committed. All stretches between commits come up alike often, so
    that most kills meet a memory that is being written; the one before the first commit is the longest.
    """
    stretch = rng.randrange(held - first, len(pace))
    return first + stretch, rng.uniform(0.0, 1.0) * pace[0 if stretch == held - first else stretch]


def _reaches(process: subprocess.Popen[str], memory: Path, chunks: int, cpu_s: float) -> bool:
    """Wait until so many chunks are committed and so much of a processor was used since; False when it ends before."""
    while process.poll() is None:
        if chunks_in(memory) >= chunks:
            return _runs_for(process, _spent_s(process) + cpu_s)
        time.sleep(0.05)
    return False


def _runs_for(process: subprocess.Popen[str], cpu_s: float) -> bool:
    """Wait until a process and its children have used so much of a processor; False when it ends before.

    Not by the clock, so that the moment of a kill does not depend on what else the machine does.
    """
    while process.poll() is None:
        if _spent_s(process) >= cpu_s:
            return True
        time.sleep(0.05)
    return False


def _spent_s(process: subprocess.Popen[str]) -> float:
    """Processor seconds of a process and of its children that run."""
    return sum(map(_cpu_s, [process.pid, *descendants(process.pid)]))


def _cpu_s(pid: int) -> float:
    """Of the process and of its children that have ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended meanwhile
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


# ------------------------------------------------------------------------------------------- single transactions


def write_for_ever(path: str, first: int) -> None:
    """Write one transaction after another and say the number of each once it is committed."""
    with Store.open(path, writable=True) as store:
        ids = [i.id for i in store.instances.all()]
        n = first
        while True:
            n += 1
            with store.transaction():
                write_round(store, ids, n)
            _say(n)


def write_round(store: Store, ids: list[int], n: int) -> None:
    """One change in several tables, all of which say `n`."""
    from dataclasses import replace

    store.facts[_EDIT] = n
    store.instances.put([replace(store.instances.get(k), label=f"edit {n}") for k in ids])
    store.merges.add_all(1, [MergeDecision("edit", f"#{n}", "#0", {"n": n}, "an edit")])
    pair = [ids[n % len(ids)], ids[(n + 1) % len(ids)]]
    store.relations.replace([pair[0]], [Relation(pair[0], "near", pair[1], 1.0, float(n))])


def rounds_in(store: Store) -> set[int]:
    """Numbers of rounds that the tables speak of; one number where none is torn."""
    logged = [int(d.scores["n"]) for d in store.merges.decisions() if d.kind == "edit"]
    labels = {i.label for i in store.instances.all()}
    if logged != list(range(1, len(logged) + 1)):
        return {-1}
    return {store.facts[_EDIT], len(logged), *(int((x or "edit 0").split()[1]) for x in labels)}


def kill_writes(memory: Path, kills: int, seed: int = 0) -> Result:
    """Kill a process that writes transactions over several tables, at random moments."""
    rng = random.Random(seed)
    problems: list[str] = []
    done = 0
    for _ in range(kills):
        said = _killed([str(Path(__file__).resolve()), "--write", str(memory), str(done)], rng, 0.25)
        least = said[-1] if said else done + 1
        problems += judge(memory, 0)
        with Store.open(memory) as store:
            found = rounds_in(store)
        if len(found) != 1 or not least <= max(found) <= least + 1:
            problems.append(f"round {least} was committed, the memory speaks of {sorted(found)}")
        done = max(found)
    return {"kills": kills, "transactions": done, "problems": problems}


def _killed(arguments: list[str], rng: random.Random, longest_s: float) -> list[int]:
    """Start a Python program that says numbers, kill it some time after the first; the numbers."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    first = process.stdout.readline()
    time.sleep(rng.uniform(0.0, longest_s))
    process.kill()
    lines = [first, *process.communicate()[0].splitlines(keepends=True)]
    return [int(line) for line in lines if line.endswith("\n")]


def _say(number: int) -> None:
    sys.stdout.write(f"{number}\n")
    sys.stdout.flush()


# ------------------------------------------------------------------------------------------- what operators edit


def edit_for_ever(path: str, seed: int) -> None:
    """Edit as an operator does, and say the number of each entry once it is committed."""
    from list3r.memory.core.errors import List3rError
    from list3r.memory.library.maintenance import edits

    rng = random.Random(seed)
    with Store.open(path, writable=True) as store:
        while True:
            ids = [i.id for i in store.instances.all(structure=False)]
            verbs: list[Callable[[], Any]] = [lambda: edits.undo(store)] * 2
            if len(ids) > 4:
                a, b = rng.sample(ids, 2)
                verbs += [
                    lambda a=a: edits.label(store, a, f"object {rng.randrange(99)}"),
                    lambda a=a, b=b: edits.merge(store, a, b),
                    lambda a=a: edits.split(store, a),
                    lambda a=a: edits.delete(store, a),
                ]
            try:
                _say(rng.choice(verbs)().entry)
            except List3rError:  # nothing to split, undo, or join there; the next will do
                continue


def kill_edits(memory: Path, kills: int, seed: int = 0) -> Result:
    """Kill a process that merges, splits, labels, deletes and undoes, at random moments.

    The derived state must be the result of the edits that remain.
    """
    rng = random.Random(seed)
    problems: list[str] = []
    for n in range(kills):
        report = _killed([str(Path(__file__).resolve()), "--edit", str(memory), str(seed * 1000 + n)], rng, 0.5)
        problems += judge(memory, 0)
        with Store.open(memory) as store:
            entries = {e.entry for e in store.edits.all()}
        lost = sorted(set(report) - entries)
        if lost:
            problems.append(f"edits {lost} were committed and are lost")
        problems += _underived(memory)
    with Store.open(memory) as store:
        return {"kills": kills, "edits": len(store.edits.all()), "problems": problems}


def _underived(memory: Path) -> list[str]:
    """Whether the library differs from the result of the chunks and the edits."""
    with Store.open(memory, writable=True) as store:
        before = scene_dict(store)
        with store.transaction():
            consolidate(store)
        return [] if scene_dict(store) == before else ["the library is not what the edits come to"]


def kill_commands(memory: Path, kills: int, seed: int = 0) -> Result:
    """Kill `list3r edit label`, `delete`, `merge` and `undo` at random moments: all of an edit is there or nothing."""
    rng = random.Random(seed)
    problems: list[str] = []
    counts: Counter[str] = Counter()
    while counts["kills"] < kills:
        with Store.open(memory) as store:
            known = {e.entry for e in store.edits.all()}
            before = scene_dict(store)
            ids = [i.id for i in store.instances.all(structure=False)]
        command = _edit_command(memory, ids, known, rng)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        if _runs_for(process, rng.uniform(0.5, 1.6)):
            process.kill()
            counts["kills"] += 1
        process.communicate()
        problems += judge(memory, 0)
        with Store.open(memory) as store:
            fresh = {e.entry for e in store.edits.all()} - known
            counts["edits"] += len(fresh)
            if process.returncode == 0 and len(fresh) != 1:
                problems.append(f"{command[3]} ended well and left {len(fresh)} edits")
            if not fresh and scene_dict(store) != before:
                problems.append(f"{command[3]} left no edit and changed the library")
    return {**counts, "problems": problems + _underived(memory)}


def _edit_command(memory: Path, ids: list[int], known: set[int], rng: random.Random) -> list[str]:
    a, b = (str(n) for n in rng.sample(ids, 2))
    path = str(memory)
    verbs = [["edit", "label", path, a, f"object {rng.randrange(99)}"]]
    if len(ids) > 5:
        verbs += [["edit", "merge", path, a, b], ["edit", "delete", path, a]]
    if known:
        verbs.append(["edit", "undo", path])
    return [sys.executable, "-m", "list3r", *rng.choice(verbs)]


if __name__ == "__main__":
    {"--write": write_for_ever, "--edit": edit_for_ever}[sys.argv[1]](sys.argv[2], int(sys.argv[3]))
