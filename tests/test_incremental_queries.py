"""Queries that look at few of many things answer as if they had looked at all."""

from __future__ import annotations

import contextlib
import dataclasses
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import Instance
from list3r.memory.library.maintenance.temporary_views import store_shown
from list3r.memory.store.search import vectors
from list3r.memory.store.search.vectors import VectorIndex
from list3r.memory.store.store import Store
from list3r.queries.match import Filters
from list3r.queries.nearest import nearest
from list3r.queries.similar import similar
from list3r.queries.views.surfaces import distance_between, distance_to_point, surface_of
from list3r.queries.within import within
from tests.conftest import instance

COUNT = 400
SPACE = "test@1/32"


def boxes(rng: np.random.Generator, count: int = COUNT, first: int = 1) -> list[Instance]:
    """Turned boxes of 1 cm to 10 m in heaps that lie far apart, some of them structure, some removed."""
    out = []
    for n in range(first, first + count):
        heap = np.array([40.0 * (n % 3), 0.0, 0.0])
        center, size = heap + rng.normal(size=3) * [4, 4, 1], 0.01 * 1000.0 ** rng.uniform(size=3) ** 3
        angle = rng.uniform(0, np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        box = OrientedBox(center, size, turn)
        made = instance(n, tuple(center), tuple(size), (200, 200, 200))
        corners = box.corners()
        out.append(
            dataclasses.replace(
                made,
                box=box,
                aabb=np.stack([corners.min(axis=0), corners.max(axis=0)]),
                structure="wall" if n % 7 == 0 else None,
                state="removed" if n % 50 == 0 else "present",
                confidence=float(rng.uniform()),
                component=1 + n % 2,
            )
        )
    return out


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store.create(tmp_path / "many.l3r")
    rng = np.random.default_rng(5)
    with made.transaction():
        made.instances.put(boxes(rng))
        made.embeddings.put(SPACE, range(1, COUNT + 1), rng.normal(size=(COUNT, 32)).astype(np.float32))
    return made


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"structure": True},
        {"min_confidence": 0.7},
        {"state": "removed"},
        {"max_distance": 2.0},
        {"component": 2},
        {"min_size": 0.5},
        {"k": 1000},
    ],
)
def test_nearest_to_a_point_is_that_of_a_scan(store: Store, options: dict[str, object]) -> None:
    rng = np.random.default_rng(1)
    k, limit = int(options.get("k", 5)), options.get("max_distance")  # type: ignore[call-overload]
    filters = {n: v for n, v in options.items() if n not in ("k", "max_distance")}
    everything = Filters(**filters).select(store.instances.all())  # type: ignore[arg-type]
    for point in rng.normal(size=(25, 3)) * [60, 6, 3]:
        scan = sorted((distance_to_point(store, i, point), i.id) for i in everything)
        scan = [s for s in scan if limit is None or s[0] <= limit][:k]  # type: ignore[operator]
        found = nearest(store, point=point, **options)  # type: ignore[arg-type]
        assert [m.instance.id for m in found] == [n for _, n in scan]


def test_nearest_to_an_instance_is_that_of_a_scan(store: Store) -> None:
    things = [i for i in store.instances.all(structure=False) if i.state != "removed"]
    for origin in store.instances.all()[::17]:
        scan = sorted(
            (distance_between(store, i, origin), i.id)
            for i in things
            if i.id != origin.id and i.component == origin.component
        )
        found = nearest(store, instance_id=origin.id, k=6)
        assert np.allclose([m.distance_m for m in found], [d for d, _ in scan[:6]])


def test_within_finds_what_a_scan_finds(store: Store) -> None:
    rng = np.random.default_rng(2)
    for center in rng.normal(size=(20, 3)) * [4, 4, 1]:
        found = {m.instance.id for m in within(store, center=center, radius=0.8)}
        things = store.instances.all(structure=False)
        inside = {i.id for i in things if (np.linalg.norm(surface_of(store, i).points - center, axis=1) <= 0.8).any()}
        assert found == inside


def cosine(store: Store, query: np.ndarray) -> dict[int, float]:
    ids, rows = store.embeddings.all(SPACE)
    values = rows @ query / np.linalg.norm(rows, axis=1) / np.linalg.norm(query)
    return dict(zip(ids.tolist(), values.tolist(), strict=True))


def brute(store: Store, query: np.ndarray, k: int) -> list[int]:
    known = cosine(store, query)
    return sorted(known, key=lambda n: (-known[n], n))[:k]


@pytest.mark.parametrize("exact", [100_000, 50])
def test_similar_follows_what_is_written(store: Store, exact: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vectors, "_EXACT", exact)
    monkeypatch.setattr(vectors, "_PROBED", 1000)
    rng = np.random.default_rng(3)
    asked = rng.normal(size=(10, 32)).astype(np.float32)

    def agrees() -> None:
        for query in asked:
            found = similar(store, vector=query, space=SPACE, k=7, structure=True)
            assert [m.instance.id for m in found] == brute(store, query, 7)
            assert np.isclose(found[0].score, cosine(store, query)[found[0].instance.id], atol=1e-4)

    agrees()
    built = VectorIndex.of(store, SPACE)
    with store.transaction():
        store.embeddings.put(SPACE, range(1, 40), rng.normal(size=(39, 32)).astype(np.float32))
        store.instances.put(boxes(rng, 5, COUNT + 1))
        store.embeddings.put(SPACE, range(COUNT + 1, COUNT + 6), asked[:5])
        store.instances.drop(60, None)
    agrees()
    assert VectorIndex.of(store, SPACE) is built, "a few changes do not build the index anew"
    assert similar(store, vector=asked[0], space=SPACE, k=1)[0].instance.id == COUNT + 1
    with pytest.raises(RuntimeError, match="no"), store.transaction():
        store.embeddings.put(SPACE, [70], asked[:1] * 2)
        raise RuntimeError("no")
    agrees()


def test_a_reader_sees_what_another_process_wrote(store: Store) -> None:
    with Store.open(store.path) as reader:
        query = np.ones(32, np.float32)
        similar(reader, vector=query, space=SPACE, k=1)
        with store.transaction():
            store.embeddings.put(SPACE, [9], query[None])
        assert similar(reader, vector=query, space=SPACE, k=1)[0].instance.id == 9
    store.close()


def test_filters_that_few_pass_are_served_in_full(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vectors, "_EXACT", 50)
    monkeypatch.setattr(vectors, "_RANKED", 8)
    query = np.random.default_rng(4).normal(size=32)
    found = similar(store, vector=query, space=SPACE, k=6, state="removed", structure=True)
    known = cosine(store, query)
    removed = [i.id for i in store.instances.all() if i.state == "removed"]
    assert [m.instance.id for m in found] == sorted(removed, key=lambda n: -known[n])[:6]


def test_an_index_is_kept_and_followed_by_what_changes(
    store: Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(vectors, "_EXACT", 50)
    monkeypatch.setattr(vectors, "_PROBED", 1000)
    monkeypatch.setenv("LIST3R_CACHE", str(tmp_path / "cache"))
    query = np.random.default_rng(5).normal(size=32).astype(np.float32)
    similar(store, vector=query, space=SPACE, k=1)
    (kept,) = (tmp_path / "cache" / "vectors").glob("*.faiss")
    first = kept.read_bytes()

    def answers() -> list[int]:
        with Store.open(store.path) as again:
            return [m.instance.id for m in similar(again, vector=query, space=SPACE, k=9, structure=True, state="any")]

    with pytest.MonkeyPatch.context() as unread:
        unread.setattr(vectors, "_filled", None)
        assert answers() == brute(store, query, 9)
        with store.transaction():
            store.embeddings.put(SPACE, [7, 8], np.stack([query, -query]))
            store.instances.drop(brute(store, query, 3)[2], None)
        assert answers()[0] == 7 and answers() == brute(store, query, 9)
        assert kept.read_bytes() == first, "little is new, nothing is kept anew"
    for spoiled in (b"", first[: len(first) // 2]):
        kept.write_bytes(spoiled)
        assert answers() == brute(store, query, 9), "what is kept cannot change an answer"


def test_the_index_of_another_memory_of_its_name_is_not_asked(
    store: Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(vectors, "_EXACT", 50)
    monkeypatch.setenv("LIST3R_CACHE", str(tmp_path / "cache"))
    query = np.random.default_rng(5).normal(size=32).astype(np.float32)
    similar(store, vector=query, space=SPACE, k=1)
    store.close()
    store.path.unlink()
    with Store.create(store.path) as other, other.transaction():
        other.instances.put(boxes(np.random.default_rng(8)))
        far = np.random.default_rng(9).normal(size=(COUNT, 32)).astype(np.float32)
        other.embeddings.put(SPACE, range(1, COUNT + 1), far)
    with Store.open(store.path) as other:
        found = similar(other, vector=far[76], space=SPACE, k=1, structure=True, state="any")
        assert found[0].instance.id == 77


@pytest.mark.parametrize("shown", [False, True])
def test_a_vector_that_would_answer_is_checked_as_it_is_read(
    store: Store, shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vectors, "_EXACT", 50)
    query = store.embeddings.of(SPACE, [77])[1][0]
    similar(store, vector=query, space=SPACE, k=1)
    store.close()
    with contextlib.closing(sqlite3.connect(store.path)) as database, database:
        database.execute("UPDATE embeddings SET vector = zeroblob(128) WHERE instance = 77")
    with store_shown(store.path, lambda shown: None) if shown else Store.open(store.path) as opened:
        for _ in range(2):
            with pytest.raises(MemoryFileError, match="repair"):
                similar(opened, vector=query, space=SPACE, k=1, structure=True, state="any")


@pytest.mark.parametrize("exact", [100_000, 50])
def test_answers_do_not_outlive_transactions_that_were_taken_back(
    store: Store, exact: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vectors, "_EXACT", exact)
    monkeypatch.setattr(vectors, "_PROBED", 1000)
    query = np.random.default_rng(6).normal(size=32).astype(np.float32)

    def best() -> int:
        return similar(store, vector=query, space=SPACE, k=1, structure=True, state="any")[0].instance.id

    wanted = brute(store, query, 1)
    for n in (9, 10):
        with pytest.raises(RuntimeError, match="no"), store.transaction():
            store.embeddings.put(SPACE, [n], query[None])
            assert best() == n
            raise RuntimeError("no")
        assert [best()] == wanted
    store.close()
