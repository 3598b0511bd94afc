"""A growing catalogue of many memories: cost of loading, adding a memory and queries, recall of the nearest vectors,
concurrent clients, a killed server, and rebuilding from files.

python benchmarks/catalog.py --postgres --busy-s 300 --json benchmarks/results/catalog.json
python benchmarks/catalog.py --stages 5,50 --json catalog-sqlite.json        # the embedded catalogue

The server is the benchmark's own, from the distribution's package with pgvector. Memories are synthetic and passed in
as the reader of files does; `--files` of them are real files. Wall times are valid on an idle machine only; processor
time, of this process and of its server process, is given too.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scale
from machine import write_json
from numpy.typing import NDArray

from list3r.catalog.backends import open_backend
from list3r.catalog.catalog import Catalog
from list3r.catalog.records import (
    CatalogAnswers,
    CatalogError,
    CatalogFilters,
    CatalogInstance,
    MemoryContent,
    MemoryEntry,
    SpaceVectors,
)
from list3r.memory.core.description.words import kind_word
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.store.store import Store
from tests.postgres_server import PostgresServer, running_postgres

SPACES = {
    "benchmark@1/{}": (1.0, 3000),
    "benchmark even@1/{}": (0.0, 3000),
    "benchmark lone@1/{}": (1.0, 0),
}
"""Vectors, by the decay of their variances and the number of clusters of appearance. Of learned ones the variance of
the n-th number is about 1 / n (Agrawal et al. 2022, alpha-ReQ), with clusters: the first. The others are isotropic,
hard for a graph index, and without clusters, hard for inverted lists."""
COLORS = ("red", "blue", "green", "white", "black", "grey", "brown", "yellow")
KINDS = tuple(f"kind{n}" for n in range(400))
SERVER = "-c shared_buffers=2GB -c max_wal_size=4GB -c max_parallel_maintenance_workers=0"
"""Settings of the server: the second keeps checkpoints rare while it is loaded, the third all work in one process."""
Vectors = NDArray[np.float32]


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--postgres", action="store_true", help="A server of its own; else a file of SQLite.")
    words.add_argument("--stages", default="5,50,250,1000", help="Memories at which is measured.")
    words.add_argument("--instances", type=int, default=2000)
    words.add_argument("--dimension", type=int, default=64)
    words.add_argument("--questions", type=int, default=200)
    words.add_argument("--files", type=int, default=5, help="Real files that are added, and rebuilt.")
    words.add_argument("--busy-s", type=float, default=0.0, help="So long 16 ask while 4 write.")
    words.add_argument("--json", type=Path)
    asked = words.parse_args()
    with _started(asked.postgres) as (url, server):
        Growth(url, server, asked).run()


@contextlib.contextmanager
def _started(postgres: bool) -> Iterator[tuple[str, PostgresServer | None]]:
    if postgres:
        with running_postgres(SERVER) as server:
            yield server.url, server
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield f"{folder}/catalog.sqlite", None


class Growth:
    """A catalogue that grows from stage to stage, and its measurements."""

    def __init__(self, url: str, server: PostgresServer | None, asked: argparse.Namespace) -> None:
        self._url, self._server, self._asked = url, server, asked
        self._chance = np.random.default_rng(1)
        self._clusters = {
            name.format(asked.dimension): Clusters(asked.dimension, *how, self._chance) for name, how in SPACES.items()
        }
        self._space, self._even, self._lone = self._clusters
        self._vectors: list[list[Vectors]] = []
        self._backend = open_backend(url)
        self._catalog = Catalog(self._backend)
        report = ("instances", "dimension", "questions")
        self._result: dict[str, Any] = {"database": "PostgreSQL" if server else "SQLite", "stages": []}
        self._result |= {"a_memory": {name: getattr(asked, name) for name in report}}

    def run(self) -> None:
        for count in map(int, self._asked.stages.split(",")):
            self._result["stages"].append(self._stage(count))
            self._report()
        if self._asked.files:
            self._result["from_files"] = self._from_files()
            self._report()
        if self._asked.busy_s:
            self._result["busy"] = self._busy()
            self._report()
        if self._server is not None:
            self._result["killed"] = self._killed(self._server)
            self._report()
        self._catalog.close()

    def _report(self) -> None:
        print(list(self._result.items())[-1], "load", round(os.getloadavg()[0], 1), flush=True)
        write_json(self._asked.json, self._result)

    def _stage(self, count: int) -> dict[str, Any]:
        row: dict[str, Any] = {"memories": count, "instances": count * self._asked.instances}
        server, missing = self._process(), count - len(self._vectors)
        made = 0.0
        with _spent(server) as spent, self._catalog.loading(missing):
            for n in range(len(self._vectors), count):
                began = time.process_time()
                content = make_content(f"m{n:05d}", self._asked.instances, self._clusters, self._chance)
                made += time.process_time() - began
                self._vectors.append([held.vectors.astype(np.float16) for held in content.spaces])
                self._backend.put(content)
        spent["client_cpu_s"] = round(spent["client_cpu_s"] - made, 1)
        row |= {"loaded": {"memories": missing, **spent}, "bytes": self._bytes(), "put of 1000": self._put(server)}
        for name, ask in self._questions().items():
            many = self._server is not None or not name.startswith("similar, all")
            row[name] = _timed(ask, self._asked.questions if many else 5, server)
            print(count, name, row[name], flush=True)
        row["recall@10, similar, all"] = self._recall(self._space, 0)
        row["recall@10, similar, all, even"] = self._recall(self._even, 1)
        row["recall@10, similar, all, lone"] = self._recall(self._lone, 2)
        row["load_average"] = round(os.getloadavg()[0], 1)
        return row

    def _put(self, server: int) -> dict[str, float]:
        """Add a memory of 1,000 three times, each of other objects."""
        clusters = {self._space: self._clusters[self._space]}
        contents = [make_content(f"small{n}", 1000, clusters, self._chance) for n in range(3)]
        found = _timed(lambda n: self._backend.put(contents[n]), 3, server, warm=0)
        for content in contents:
            self._backend.drop(content.entry.name)
        return found

    def _questions(self) -> dict[str, Callable[[int], object]]:
        catalog, chance, space = self._catalog, np.random.default_rng(2), self._space

        def point() -> NDArray[np.float64]:
            return chance.uniform(0, 10, 3)

        return {
            "nearest, one memory": lambda n: catalog.nearest(self._name(n), point=point(), k=10),
            "nearest, rows alone": lambda n: self._backend.near(self._name(n), point().tolist(), 10, CatalogFilters()),
            "within, one memory": lambda n: catalog.within(self._name(n), center=point(), radius=0.5),
            "find, one word, all": lambda n: catalog.find(KINDS[n % 400], k=10),
            "find, frequent word, all": lambda n: catalog.find(COLORS[n % 8], k=10),
            "find, two words, all": lambda n: catalog.find(f"{COLORS[n % 8]} {KINDS[n % 400]}", k=10),
            "find, relation, all": lambda n: catalog.find(f"{KINDS[n % 400]} on {KINDS[(n + 1) % 400]}", k=10),
            "find, one memory": lambda n: catalog.find(COLORS[n % 8], self._name(n), k=10),
            "similar, one memory": lambda n: catalog.similar(
                self._name(n), instance_id=n % 100, space=space, anywhere=False, k=10
            ),
            "similar, all": lambda n: self._alike(space, n),
            "similar, all, even": lambda n: self._alike(self._even, n),
            "similar, all, lone": lambda n: self._alike(self._lone, n),
            "relations, one memory": lambda n: catalog.relations(self._name(n), subject=KINDS[n % 400], k=10),
        }

    def _alike(self, space: str, n: int) -> CatalogAnswers:
        return self._catalog.similar(vector=self._clusters[space].near(n), space=space, k=10)

    def _recall(self, space: str, number: int) -> float:
        """Share of the true ten that are found, over 50 questions."""
        size, queries = self._asked.instances, np.array([self._clusters[space].near(n) for n in range(50)])
        cosine = np.concatenate([queries @ v[number].astype(np.float32).T for v in self._vectors], axis=1)
        hits = 0
        for n, best in enumerate(np.argpartition(-cosine, 10, axis=1)[:, :10].tolist()):
            truth = {(f"m{k // size:05d}", k % size) for k in best}
            hits += len(truth & {(m.memory, m.id) for m in self._alike(space, n)})
        return hits / 500

    def _from_files(self) -> dict[str, Any]:
        """Real files are added, queried, rewritten and queried again."""
        size, names = self._asked.instances, [f"file{n}" for n in range(self._asked.files)]
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder) / f"{name}.l3r" for name in names]
            for n, path in enumerate(paths):
                scale.write_memory(path, size, n)
            with _spent(self._process()) as first:
                for path in paths:
                    self._catalog.add(path)
            before, entries = self._answers(names), self._catalog.memories()
            with _spent(self._process()) as again, self._catalog.loading(len(paths)):
                for path in paths:
                    self._catalog.again(str(path))
            equal = self._answers(names) == before and self._catalog.memories() == entries
        for name in names:
            self._catalog.remove(name)
        return {"files": len(names), "instances": len(names) * size, "added": first, "written_anew": again} | {
            "answers": sum(map(len, before)),
            "equal": equal,
        }

    def _answers(self, names: list[str]) -> list[list[Any]]:
        catalog, point = self._catalog, (3.0, 3.0, 1.0)
        asked = [list(catalog.find(text, n, k=100)) for text in ("red table", "noun7", "box near table") for n in names]
        asked += [list(catalog.nearest(n, point=point, k=50)) for n in names]
        asked += [list(catalog.within(n, center=point, radius=3.0)) for n in names]
        asked += [list(catalog.relations(n, subject="table")) for n in names]
        for n in names:
            with Store.open(self._catalog.memory(n).path) as store:
                vectors = store.embeddings.of(scale.SPACE, [1, 2, 3])[1]
            asked += [
                list(catalog.similar(n, vector=v, space=scale.SPACE, anywhere=where, k=20))
                for v in vectors
                for where in (False, True)
            ]
        return asked

    def _busy(self) -> dict[str, object]:
        """16 threads ask and 4 write, each with a connection of its own."""
        seconds = self._asked.busy_s
        end, done, errors, waited = time.monotonic() + seconds, {"asked": 0, "written": 0}, list[str](), list[float]()

        def work(number: int, writes: bool) -> None:
            chance, backend = np.random.default_rng(number), open_backend(self._url)
            while time.monotonic() < end:
                began = time.perf_counter()
                try:
                    if writes:
                        backend.put(make_content(f"busy{number}", 200, self._clusters, chance))
                    else:
                        self._one(Catalog(backend), chance)
                except Exception as error:
                    errors.append(f"{type(error).__name__}: {error}")
                done["written" if writes else "asked"] += 1
                if not writes:
                    waited.append(1e3 * (time.perf_counter() - began))
            backend.close()

        threads = [threading.Thread(target=work, args=(n, n < 4)) for n in range(20)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        p50, p95 = (round(float(v), 1) for v in np.percentile(waited, (50, 95)))
        return {"seconds": seconds, **done, "three_questions_p50_ms": p50, "three_questions_p95_ms": p95} | {
            "errors": errors[:5],
            "error_count": len(errors),
        }

    def _one(self, catalog: Catalog, chance: np.random.Generator) -> None:
        n = int(chance.integers(1_000_000))
        near = catalog.nearest(self._name(n), point=chance.uniform(0, 10, 3), k=10)
        named = catalog.find(KINDS[n % 400], k=10)
        alike = catalog.similar(vector=self._clusters[self._space].near(n), space=self._space, k=10)
        if len(near) != 10 or not named or len(alike) != 10:
            raise CatalogError(f"answers are missing: {len(near)}, {len(named)}, {len(alike)}")

    def _killed(self, server: PostgresServer) -> dict[str, object]:
        """The server ends as in a crash while a memory goes in; it is started again."""
        names = [self._name(n) for n in range(5)]

        def answers() -> list[object]:
            near = [list(self._catalog.nearest(n, point=(5, 5, 5), k=20)) for n in names]
            alike = [list(self._alike(self._space, n)) for n in range(5)]
            return [*near, *alike, self._catalog.memories()]

        before, said = answers(), list[str]()
        content = make_content("cut off", 20_000, self._clusters, self._chance)

        def write() -> None:
            backend = open_backend(self._url)
            try:
                backend.put(content)
            except CatalogError as error:
                said.append(str(error))
            backend.close()

        thread = threading.Thread(target=write)
        thread.start()
        time.sleep(0.5)
        server.kill()
        thread.join()
        try:
            self._catalog.find(KINDS[0])
        except CatalogError as error:
            said.append(str(error))
        began = time.perf_counter()
        server.start()
        back = time.perf_counter() - began
        said = [text.replace(str(server.folder), "...") for text in said]
        return {"said": said, "back_s": round(back, 1), "equal": answers() == before}

    def _process(self) -> int:
        """The process of PostgreSQL that answers a backend with one connection; 0 of another database."""
        rows = getattr(self._backend, "_rows", None)
        return int(rows("SELECT pg_backend_pid()", ())[0][0]) if self._server and rows else 0

    def _bytes(self) -> dict[str, int]:
        """Bytes of the catalogue, and of its largest parts where the database reports them."""
        if self._server is None:
            return {"all": Path(self._url).stat().st_size}
        query = (
            "SELECT coalesce(substring(relname FROM '^(instance|relation|vector)'), 'other') || CASE relkind WHEN 'i' "
            "THEN ', ' || am.amname ELSE '' END AS part, sum(pg_relation_size(c.oid))::bigint FROM pg_class c "
            "LEFT JOIN pg_am am ON am.oid = c.relam WHERE relkind IN ('r', 'i') "
            "AND relnamespace = 'list3r'::regnamespace GROUP BY 1 ORDER BY 2 DESC"
        )
        parts = {str(name): int(size) for name, size in self._backend._rows(query, ())}  # type: ignore[attr-defined]
        return {"all": sum(parts.values()), **parts}

    def _name(self, n: int) -> str:
        return f"m{n * 7919 % len(self._vectors):05d}"


class Clusters:
    """Vectors of one space: objects in clusters of appearance, or each by itself without clusters."""

    def __init__(self, dimension: int, decay: float, kinds: int, chance: np.random.Generator) -> None:
        """Let the variance of the n-th number be n to the power of -decay."""
        self._spread = np.arange(1, dimension + 1) ** (-decay / 2)
        self._kinds = chance.normal(size=(kinds, dimension)) * self._spread if kinds else np.zeros((1, dimension))

    def of(self, count: int, chance: np.random.Generator) -> Vectors:
        """Return the vectors of so many objects, of unit length."""
        return self._about(chance.integers(0, len(self._kinds), count), chance)

    def near(self, number: int) -> Vectors:
        """Return the vector of an object, the same for the same number."""
        return self._about(np.array([number % len(self._kinds)]), np.random.default_rng(number))[0]

    def _about(self, kinds: NDArray[np.int64], chance: np.random.Generator) -> Vectors:
        vectors = self._kinds[kinds] + 0.5 * self._spread * chance.normal(size=(len(kinds), len(self._spread)))
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)


def make_content(name: str, count: int, clusters: dict[str, Clusters], chance: np.random.Generator) -> MemoryContent:
    """A memory of objects with random places, names, appearances and relations."""
    centers, sizes = chance.uniform(0, 10, (count, 3)), chance.uniform(0.05, 0.8, (count, 3))
    kinds, colors = chance.integers(0, 400, count), chance.integers(0, 8, count)
    instances = []
    for n in range(count):
        label, color = KINDS[kinds[n]], COLORS[colors[n]]
        box = OrientedBox(centers[n], sizes[n], np.eye(3))
        report = (label, f"{color} box, 20 cm", "present", None, float(chance.uniform(0.3, 1.0)), 0.01, 1, box)
        instances.append(CatalogInstance(name, n, *report, {label: 100, kind_word(label): 100, color: 90, "box": 80}))
    pairs = chance.integers(0, count, (2 * count, 2))
    relations = [
        (int(a), "on" if k % 2 else "near", int(b), 0.8, 0.1) for k, (a, b) in enumerate(np.unique(pairs, axis=0))
    ]
    entry = MemoryEntry(
        name, f"/nowhere/{name}.l3r", 0, f"{chance.integers(2**60):x}", 1, 0, "metric", "known", count, 1
    )
    spaces = [SpaceVectors(space, np.arange(count), held.of(count, chance)) for space, held in clusters.items()]
    return MemoryContent(entry, instances, relations, spaces)


@contextlib.contextmanager
def _spent(server: int) -> Iterator[dict[str, float]]:
    """Seconds by the clock, and of a processor of this process and of the server's."""
    found: dict[str, float] = {}
    began, client, other = time.perf_counter(), time.process_time(), _server_ms(server)
    yield found
    found["wall_s"] = round(time.perf_counter() - began, 1)
    found["client_cpu_s"] = round(time.process_time() - client, 1)
    found["server_cpu_s"] = round((_server_ms(server) - other) / 1e3, 1)


def _timed(ask: Callable[[int], object], count: int, server: int, warm: int = 10) -> dict[str, float]:
    """Percentiles of the wall time, mean processor time of this process and the server's; ms."""
    for n in range(min(warm, count)):
        ask(n)
    times, client, other = [], time.process_time(), _server_ms(server)
    for n in range(count):
        started = time.perf_counter()
        ask(n)
        times.append(1e3 * (time.perf_counter() - started))
    cpu = 1e3 * (time.process_time() - client) / count, (_server_ms(server) - other) / count
    names = ("p10_ms", "p50_ms", "p95_ms", "client_cpu_ms", "server_cpu_ms")
    found = (*np.percentile(times, (10, 50, 95)).tolist(), *cpu)
    return {name: round(v, 3) for name, v in zip(names, found, strict=True)}


def _server_ms(process: int) -> float:
    return int(Path(f"/proc/{process}/schedstat").read_text().split()[0]) / 1e6 if process else 0.0


if __name__ == "__main__":
    main()
