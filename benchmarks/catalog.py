"""A catalogue of many memories: what adding a memory and asking costs, and how good the nearest vectors are.

python benchmarks/catalog.py --memories 1000 --instances 2000 --postgres      # needs a server that may be started
python benchmarks/catalog.py --memories 100 --instances 2000 --url catalog.sqlite
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.catalog.base import Backend, open_backend
from list3r.catalog.catalog import Catalog
from list3r.catalog.records import CatalogFilters, CatalogThing, MemoryContent, MemoryEntry, SpaceVectors
from list3r.memory.geometry import OrientedBox

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
SPACE = "benchmark@1/{}"
COLORS = ("red", "blue", "green", "white", "black", "grey", "brown", "yellow")
KINDS = tuple(f"kind{n}" for n in range(400))


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--url", default="catalog-benchmark.sqlite", help="A catalogue without memories.")
    words.add_argument("--postgres", action="store_true", help="Start a server for the benchmark instead.")
    words.add_argument("--memories", type=int, default=100)
    words.add_argument("--instances", type=int, default=2000)
    words.add_argument("--dimension", type=int, default=128)
    words.add_argument("--questions", type=int, default=200)
    words.add_argument("--busy-s", type=float, default=0.0, help="So long 16 ask while 4 write.")
    words.add_argument("--out", type=Path, default=Path("catalog-benchmark.json"))
    asked = words.parse_args()
    with _server(asked.postgres) as url:
        result = _measure(url or asked.url, asked)
    asked.out.write_text(json.dumps(result, indent=2))
    print(json.dumps(result, indent=2))


@contextmanager
def _server(wanted: bool) -> Iterator[str]:
    if not wanted:
        yield ""
        return
    from tests.postgres_server import running_postgres

    with running_postgres() as server:
        yield server.url


def _measure(url: str, asked: argparse.Namespace) -> dict[str, object]:
    chance = np.random.default_rng(1)
    looks = chance.normal(size=(3000, asked.dimension)).astype(np.float32)
    backend = open_backend(url)
    catalog, rows, growth = Catalog(backend), asked.memories * asked.instances, []
    vectors, places = [], []
    began = time.perf_counter()
    for n in range(asked.memories):
        content = make_content(f"m{n:05d}", asked.instances, looks, chance)
        vectors.append(content.spaces[0].vectors)
        places += [(content.entry.name, t.id) for t in content.things]
        started = time.perf_counter()
        backend.put(content)
        growth.append(time.perf_counter() - started)
        if n + 1 in (10, 30, 100, 300, 1000):
            print(f"{n + 1} memories, {time.perf_counter() - began:.0f} s", flush=True)
    small = make_content("small", 1000, looks, chance)
    result: dict[str, object] = {"url": url.partition(":")[0], "memories": asked.memories, "instances": rows}
    result |= {"dimension": asked.dimension, "build_s": round(sum(growth), 1)}
    result["put_s_first_last_tenth"] = [round(statistics.median(g), 3) for g in (growth[:10], growth[-10:])]
    server = _server_process(backend)
    result["put of 1000"] = _timed(lambda n: backend.put(small), 1, server)
    backend.drop("small")
    questions: dict[str, Callable[[int], object]] = {
        "nearest, one memory": lambda n: catalog.nearest(_name(n, asked), point=chance.uniform(0, 10, 3), k=10),
        "nearest, rows alone": lambda n: backend.near(
            _name(n, asked), chance.uniform(0, 10, 3).tolist(), 10, CatalogFilters()
        ),
        "within, one memory": lambda n: catalog.within(_name(n, asked), center=chance.uniform(0, 10, 3), radius=0.5),
        "find, one word, all": lambda n: catalog.find(KINDS[n % 400], k=10),
        "find, frequent word, all": lambda n: catalog.find(COLORS[n % 8], k=10),
        "find, two words, all": lambda n: catalog.find(f"{COLORS[n % 8]} {KINDS[n % 400]}", k=10),
        "find, relation, all": lambda n: catalog.find(f"{KINDS[n % 400]} on {KINDS[(n + 1) % 400]}", k=10),
        "find, one memory": lambda n: catalog.find(COLORS[n % 8], _name(n, asked), k=10),
        "similar, one memory": lambda n: catalog.similar(_name(n, asked), instance_id=n % 100, anywhere=False, k=10),
        "similar, all": lambda n: catalog.similar(vector=_near(looks, n), space=SPACE.format(asked.dimension), k=10),
        "relations, one memory": lambda n: catalog.relations(_name(n, asked), subject=KINDS[n % 400], k=10),
    }
    for name, ask in questions.items():
        count = asked.questions if url.startswith("postgres") or name != "similar, all" else 10
        result[name] = _timed(ask, count, server)
        print(name, result[name], flush=True)
    result["recall@10, similar, all"] = _recall(catalog, looks, np.concatenate(vectors), places, asked.dimension)
    if asked.busy_s:
        result["busy"] = _busy(url, asked, looks)
    catalog.close()
    return result


def make_content(name: str, count: int, looks: NDArray[np.float32], chance: np.random.Generator) -> MemoryContent:
    """A memory of things of random places, names, looks and relations."""
    centers, sizes = chance.uniform(0, 10, (count, 3)), chance.uniform(0.05, 0.8, (count, 3))
    kinds, colors = chance.integers(0, 400, count), chance.integers(0, 8, count)
    things = []
    for n in range(count):
        label, color = KINDS[kinds[n]], COLORS[colors[n]]
        box = OrientedBox(centers[n], sizes[n], np.eye(3))
        told = (label, f"{color} box, 20 cm", "present", None, float(chance.uniform(0.3, 1.0)), 0.01, 1, box)
        things.append(CatalogThing(name, n, *told, {label: 100, color: 90, "box": 80}))
    pairs = chance.integers(0, count, (2 * count, 2))
    relations = [
        (int(a), "on" if k % 2 else "near", int(b), 0.8, 0.1) for k, (a, b) in enumerate(np.unique(pairs, axis=0))
    ]
    vectors = looks[chance.integers(0, len(looks), count)] + 0.5 * chance.normal(size=(count, looks.shape[1]))
    vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    entry = MemoryEntry(
        name, f"/nowhere/{name}.l3r", 0, f"{chance.integers(2**60):x}", 1, 0, "metric", "known", count, 1
    )
    space = SpaceVectors(SPACE.format(looks.shape[1]), np.arange(count), vectors)
    return MemoryContent(entry, things, relations, [space])


def _near(looks: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """A look with noise of its own, the same for the same number."""
    return looks[n % len(looks)] + 0.5 * np.random.default_rng(n).normal(size=looks.shape[1])


def _recall(
    catalog: Catalog, looks: NDArray[np.float32], vectors: NDArray[np.float32], places: list[tuple[str, int]], size: int
) -> float:
    hits = 0
    for n in range(50):
        query = _near(looks, n)
        best = np.argsort(-(vectors @ query))[:10]
        found = {(m.memory, m.id) for m in catalog.similar(vector=query, space=SPACE.format(size), k=10)}
        hits += len(found & {places[k] for k in best})
    return hits / 500


def _timed(ask: Callable[[int], object], count: int, server: int = 0) -> dict[str, float]:
    """Median and 95th percentile of the wall time, mean processor time of this process and of a server's; ms."""
    times, before = [], _cpu_ms(server)
    for n in range(count):
        started = time.perf_counter()
        ask(n)
        times.append(1e3 * (time.perf_counter() - started))
    cpu = (_cpu_ms(server) - before) / count
    found = (*np.percentile(times, (50, 95)).tolist(), cpu)
    return {name: round(v, 3) for name, v in zip(("p50_ms", "p95_ms", "cpu_ms"), found, strict=True)}


def _cpu_ms(process: int) -> float:
    """Milliseconds on a processor of this process and of another."""
    other = int(Path(f"/proc/{process}/schedstat").read_text().split()[0]) / 1e6 if process else 0.0
    return 1e3 * time.process_time() + other


def _server_process(backend: Backend) -> int:
    """The process of PostgreSQL that answers a backend with one connection; 0 of another database."""
    rows = getattr(backend, "_rows", None)
    return int(rows("SELECT pg_backend_pid()", ())[0][0]) if type(backend).__name__ == "PostgresBackend" else 0


def _busy(url: str, asked: argparse.Namespace, looks: NDArray[np.float32]) -> dict[str, object]:
    """16 threads ask and 4 write, each with a connection of its own."""
    end, done, errors = time.monotonic() + asked.busy_s, {"asked": 0, "written": 0}, list[str]()

    def work(number: int, writes: bool) -> None:
        chance, backend = np.random.default_rng(number), open_backend(url)
        while time.monotonic() < end:
            try:
                if writes:
                    backend.put(make_content(f"busy{number}", 200, looks, chance))
                    done["written"] += 1
                else:
                    _one(backend, asked, chance)
                    done["asked"] += 1
            except Exception as error:
                errors.append(f"{type(error).__name__}: {error}")
        backend.close()

    threads = [threading.Thread(target=work, args=(n, n < 4)) for n in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return {"seconds": asked.busy_s, **done, "errors": errors[:5], "error_count": len(errors)}


def _one(backend: Backend, asked: argparse.Namespace, chance: np.random.Generator) -> None:
    catalog, n = Catalog(backend), int(chance.integers(1_000_000))
    catalog.nearest(_name(n, asked), point=chance.uniform(0, 10, 3), k=10)
    catalog.find(KINDS[n % 400], k=10)


def _name(n: int, asked: argparse.Namespace) -> str:
    return f"m{n * 7919 % asked.memories:05d}"


if __name__ == "__main__":
    main()
