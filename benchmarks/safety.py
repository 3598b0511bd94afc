"""What a memory survives: kill -9 while it is built, updated and edited (`kills`), readers beside a writer, flipped
bytes, truncation.

    python benchmarks/safety.py --kills 200 --minutes 5 --flips 1000 --json benchmarks/results/safety.json

Every process is real. The whole takes about half an hour on a quiet core; each part is written to the file when it is
done, and --resume continues after the last one.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import shutil
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from queue import Empty
from typing import Any

import numpy as np
from kills import build_command, kill_builds, kill_commands, kill_edits, kill_updates, kill_writes, update_command
from machine import end_with_parent, machine, write_json

from list3r.exporters.scene_json import scene_dict
from list3r.memory.core.errors import List3rError, MemoryFileError
from list3r.memory.core.records import Observation, Relation
from list3r.memory.library.maintenance.repair import repair
from list3r.memory.store.connection import remove_memory
from list3r.memory.store.facts import Fact
from list3r.memory.store.store import Store
from list3r.simulation.dataset import WalkSettings, write_walk

Result = dict[str, Any]
_ROUND, _HELD = Fact[int]("round", int, 0), Fact[int]("held", int, 0)
"""A writer's last transaction: its number, and the count of instances after it."""


# ------------------------------------------------------------------------------------------- readers


def write_and_read(memory: Path, seconds: float, readers: int = 8) -> Result:
    """One process that writes, opening and closing the memory now and then, and others that read all the while."""
    context = multiprocessing.get_context("spawn")
    queue: Any = context.Queue()
    ready: Any = context.Barrier(readers + 1)
    work: list[tuple[Callable[..., None], int]] = [(_write, 0), *((_read, k) for k in range(readers))]
    processes = [context.Process(target=_worker, args=(f, str(memory), seconds, k, queue, ready)) for f, k in work]
    for process in processes:
        process.start()
    reports = [queue.get(timeout=seconds + 300) for _ in processes]
    for process in processes:
        process.join()
    total: Counter[str] = Counter()
    for name, count, _ in reports:
        total[name] += count
    with Store.open(memory) as store:
        problems = store.verify()
    return {
        "readers": readers,
        "seconds": seconds,
        **total,
        "problems": problems + [p for *_, ps in reports for p in ps],
    }


def _worker(work: Callable[..., Any], memory: str, seconds: float, k: int, queue: Any, ready: Any) -> None:
    """Run one process and report its errors; all begin together."""
    end_with_parent()
    problems: list[str] = []
    count = 0
    name = "transactions" if work is _write else "snapshots"
    try:
        ready.wait(timeout=300)
        end = time.time() + seconds
        while time.time() < end and not problems:
            count += work(memory, min(end, time.time() + 1.0), k, problems)
    except Exception as error:  # whatever it is, it is a problem to report
        problems.append(f"{name}: {type(error).__name__}: {error}")
    queue.put((name, count, problems))


def _write(memory: str, end: float, _: int, problems: list[str]) -> int:
    count = 0
    with Store.open(memory, writable=True) as store:
        kept = {i.id: i for i in store.instances.all()}
        nodes = [(n.chunk_id, n.local_id) for n in store.local_instances.nodes()]
        n = store.facts[_ROUND]
        while time.time() < end:
            n += 1
            with store.transaction():
                _write_round(store, list(kept.values()), nodes, n)
            count += 1
    return count


def _write_round(store: Store, instances: list[Any], nodes: list[tuple[int, int]], n: int) -> None:
    """All instances get new ids, and everything that points to them follows."""
    from dataclasses import replace

    old = [i.id for i in store.instances.all()]
    for k in old:
        store.instances.drop(k, None)
    fresh = [replace(i, id=1 + 10 * n + k, label=f"round {n}") for k, i in enumerate(instances[: 3 + n % 4])]
    ids = [i.id for i in fresh]
    store.instances.put(fresh)
    store.observations.clear()
    store.observations.set(Observation(ids[k % len(ids)], *node) for k, node in enumerate(nodes))
    store.embeddings.put("test@1/16", ids, np.full((len(ids), 16), n, np.float32))
    store.relations.replace(None, [Relation(a, "near", b, 1.0, 0.0) for a in ids for b in ids if a != b])
    store.facts[_ROUND] = n
    store.facts[_HELD] = len(ids)


def _read(memory: str, end: float, k: int, problems: list[str]) -> int:
    count = 0
    with Store.open(memory) as store:
        while time.time() < end:
            with store.snapshot():
                problems += torn(store)
            count += 1
            if problems:
                break
    return count


def torn(store: Store) -> list[str]:
    """Inconsistencies of one snapshot."""
    instances = store.instances.all()
    ids = {i.id for i in instances}
    n, held = store.facts[_ROUND], store.facts[_HELD] or len(ids)
    found = []
    if len(ids) != held:
        found.append(f"{len(ids)} instances, {held} are counted")
    if n and {i.label for i in instances} != {f"round {n}"}:
        found.append("instances of several rounds")
    if not {o.instance_id for o in store.observations.all()} <= ids:
        found.append("an observation of an instance that is not there")
    if n and len(store.relations.all()) != held * (held - 1):
        found.append("relations are missing")
    if set(store.instances.ids_in_box([-1e3] * 3, [1e3] * 3)) != ids:
        found.append("the R*Tree holds other instances")
    vectors = store.embeddings.all("test@1/16")
    if n and (set(vectors[0].tolist()) != ids or not (vectors[1] == n).all()):
        found.append("vectors of another round")
    return found


# ------------------------------------------------------------------------------------------- flips


def flip(memory: Path, folder: Path, count: int, seed: int = 0) -> Result:
    """Damage copies of a memory and test opening, reading and `verify`; in its own process."""
    outcomes: Counter[str] = Counter()
    problems: list[str] = []
    context = multiprocessing.get_context("spawn")
    batch = 100
    for first in range(0, count, batch):
        queue: Any = context.Queue()
        arguments = (str(memory), str(folder), range(first, min(first + batch, count)), seed, queue)
        process = context.Process(target=_flip_batch, args=arguments)
        process.start()
        found: list[tuple[str, str]] = []
        while True:
            try:
                found.append(queue.get(timeout=1.0))
            except Empty:
                if not process.is_alive() and queue.empty():
                    break
        process.join()
        if process.exitcode != 0:
            problems.append(f"a crash with status {process.exitcode} after {len(found)} of {arguments[2]}")
        outcomes.update(outcome for outcome, _ in found)
        problems += [text for outcome, text in found if outcome in ("traceback", "silent")]
    return {"damages": count, **outcomes, "problems": problems}


def _flip_batch(memory: str, folder: str, numbers: range, seed: int, queue: Any) -> None:
    end_with_parent()
    original = Path(memory).read_bytes()
    with Store.open(memory) as store:
        wanted = answers(store)
    copy = Path(folder) / f"flipped-{numbers.start}.l3r"
    for n in numbers:
        rng = random.Random(seed * 1_000_003 + n)
        remove_memory(copy)
        data, what = damaged(original, rng)
        copy.write_bytes(data)
        queue.put(outcome_of(copy, wanted, what))
    remove_memory(copy)


def damaged(original: bytes, rng: random.Random) -> tuple[bytes, str]:
    """A copy with one byte changed, or, one time in ten, cut short."""
    if rng.random() < 0.1:
        length = rng.randrange(len(original))
        return original[:length], f"cut to {length} bytes"
    at = rng.randrange(100) if rng.random() < 0.05 else rng.randrange(len(original))
    data = bytearray(original)
    data[at] ^= rng.randrange(1, 256)
    return bytes(data), f"byte {at} changed from {original[at]} to {data[at]}"


def outcome_of(copy: Path, wanted: Any, what: str) -> tuple[str, str]:
    """(detected at open, detected by reading, detected by verify, harmless, silent or traceback, the damage)."""
    try:
        store = Store.open(copy)
    except MemoryFileError:
        return "detected at open", what
    except Exception as error:
        return "traceback", f"{what}: {type(error).__name__}: {error}"
    said = "detected by verify"
    got = wanted
    try:
        with store:
            got = answers(store)
    except List3rError:
        said = "detected by reading"
    except Exception as error:
        return "traceback", f"{what}: {type(error).__name__}: {error}"
    if not same(got, wanted):
        return "silent", f"{what}: the answers differ"
    try:
        with Store.open(copy) as again:
            if again.verify():
                return said, what
    except MemoryFileError:
        return said, what
    if said == "detected by reading":
        return "silent", f"{what}: reading fails, verify finds nothing"
    return "harmless", what


def answers(store: Store) -> list[Any]:
    """All that a memory can be asked."""
    out: list[Any] = [
        scene_dict(store),
        sorted(store.ids.aliases().items()),
        [repr(d) for d in store.merges.decisions()],
    ]
    for chunk in store.chunks.all():
        out += [chunk.S_world_chunk.as_matrix(), *(k.depth_small for k in store.keyframes.of(chunk.chunk_id))]
        out += [store.chunks.samples(chunk.chunk_id).points, store.chunks.cannot_links(chunk.chunk_id)]
    for instance in store.instances.all():
        out.append(store.surfaces.of(instance.id).points)
    for o in store.observations.all():
        out += store.local_instances.mask_track(o.chunk_id, o.local_id).masks
    out += [store.embeddings.all(space) for space in store.embeddings.spaces()]
    return out + [f.T_chunk_cam for f in store.frames.all()] + [e.S_v_u.as_matrix() for e in store.edges.all()]


def same(a: Any, b: Any) -> bool:
    """Whether two answers are equal, arrays to the bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def repair_flips(memory: Path, folder: Path, count: int, seed: int = 1) -> Result:
    """Damage copies and repair them: the result must verify, or the command must say why it cannot be done."""
    original = memory.read_bytes()
    outcomes: Counter[str] = Counter()
    problems: list[str] = []
    for n in range(count):
        copy, out = folder / "broken.l3r", folder / "mended.l3r"
        remove_memory(copy)
        remove_memory(out)
        data, what = damaged(original, random.Random(seed * 1_000_003 + n))
        copy.write_bytes(data)
        try:
            report = repair(copy, out)
            outcomes["nothing lost" if not report.lost else "repaired with losses"] += 1
            with Store.open(out) as store:
                problems += [f"{what}: {text}" for text in store.verify()]
        except MemoryFileError:
            outcomes["refused"] += 1
        except Exception as error:
            problems.append(f"{what}: {type(error).__name__}: {error}")
    return {"damages": count, **outcomes, "problems": problems}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="in all: builds and updates 30 %% each, edits the rest")
    parser.add_argument("--minutes", type=float, default=5.0, help="how long eight readers and a writer run")
    parser.add_argument("--flips", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--resume", action="store_true", help="keep the parts that the file holds already")
    args = parser.parse_args()
    print(machine())
    asked = {name: getattr(args, name) for name in ("kills", "minutes", "flips", "seed")}
    result: Result = {"asked": asked}
    if args.resume and args.json is not None and args.json.exists():
        held = json.loads(args.json.read_text(encoding="utf-8"))
        if held.pop("machine") != machine() or held["asked"] != asked:
            raise SystemExit(f"{args.json} was measured on another machine or asked for something else")
        result = held
    with tempfile.TemporaryDirectory() as name:
        for key, part in _parts(Path(name), args):
            if key not in result:
                result[key] = part()
                print(key, json.dumps(result[key], indent=2), flush=True)
                write_json(args.json, result)
    if any(isinstance(v, dict) and v.get("problems") for v in result.values()):
        raise SystemExit(1)


def _parts(folder: Path, args: argparse.Namespace) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Name and function of each part, in order; shared inputs are made by the first that needs them."""
    seed, runs = args.seed, 3 * args.kills // 10
    edits, writes = (args.kills - 2 * runs) // 4, (args.kills - 2 * runs) // 4
    made = _Memories(folder)
    yield "kills while building", lambda: kill_builds(made.first, folder, runs, seed)
    yield "kills while updating", lambda: kill_updates(made.built, made.second, folder, runs, seed + 1)
    for part, kill, count in (
        ("kills while writing", kill_writes, writes),
        ("kills while editing", kill_edits, edits),
        ("kills of commands that edit", kill_commands, args.kills - 2 * runs - edits - writes),
    ):
        # A file of its own for each: leftovers of a killed writer belong to one file only.
        yield part, lambda k=kill, n=count: k(_copy(made.updated, k.__name__), n, seed + 2)
    yield "flips", lambda: flip(made.built, folder, args.flips, seed)
    yield "repairs", lambda: repair_flips(made.built, folder, args.flips // 10, seed + 1)
    yield "file_mb", lambda: round(made.built.stat().st_size / 1e6, 2)
    yield "verify_s", lambda: _verify_s(made.built)
    yield "readers", lambda: write_and_read(_copy(made.built, "read"), 60 * args.minutes)


class _Memories:
    """Two videos of one home, the memory of the first, and that of both; each made when it is asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def first(self) -> Path:
        """36 frames, 4 chunks."""
        return write_walk(self.folder / "first", WalkSettings(seed=3, frames=36, size=(128, 96)), workers=1)

    @cached_property
    def second(self) -> Path:
        """40 frames, 5 chunks, along another path."""
        settings = WalkSettings(seed=3, walk_seed=4, start=6, frames=40, size=(128, 96))
        return write_walk(self.folder / "second", settings, workers=1)

    @cached_property
    def built(self) -> Path:
        """The memory of the first video."""
        memory = self.folder / "built.l3r"
        subprocess.run(build_command(self.first, memory), check=True, capture_output=True)
        return memory

    @cached_property
    def updated(self) -> Path:
        """The memory of both videos."""
        memory = Path(shutil.copy(self.built, self.folder / "both.l3r"))
        subprocess.run(update_command(self.second, memory), check=True, capture_output=True)
        return memory


def _copy(memory: Path, name: str) -> Path:
    return Path(shutil.copy(memory, memory.with_name(f"{name}.l3r")))


def _verify_s(memory: Path) -> float:
    started = time.process_time()
    with Store.open(memory) as store:
        store.verify()
    return round(time.process_time() - started, 3)


if __name__ == "__main__":
    main()
