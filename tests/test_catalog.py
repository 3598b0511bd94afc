"""A catalogue of many memories, in SQLite and in a real PostgreSQL: the same answers, and nothing wrong by force."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from list3r.catalog import Catalog
from list3r.catalog.backends import open_backend
from list3r.catalog.catalog import box_distances
from list3r.catalog.reading import read_content
from list3r.catalog.records import (
    CatalogError,
    CatalogFilters,
    CatalogInstance,
    MemoryContent,
    MemoryEntry,
    SpaceVectors,
)
from list3r.cli.app import run as list3r
from list3r.memory.core.description.words import vocabulary
from list3r.memory.core.errors import List3rError, OptionError, SpaceMismatchError, UnknownIdError
from list3r.memory.core.geometry import OrientedBox, rotation_exp
from list3r.memory.store.store import Store
from tests.conftest import write_small_room
from tests.postgres_server import Network, PostgresServer, running_postgres

SPACE = "test@1/16"
STRANGE = ("x'; DROP TABLE memory; --", '"%s ? $1 {}', "\\", "a\x00b", "mug' OR 1=1")


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    pytest.importorskip("psycopg", reason="psycopg is not installed: pip install '.[catalog]'")
    with running_postgres() as found:
        yield found


@pytest.fixture(scope="module", params=["sqlite", "postgres"])
def url(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A catalogue with a random memory, which the tests only add to."""
    if request.param == "sqlite":
        found = str(tmp_path_factory.mktemp("catalog") / "catalog.sqlite")
    else:
        found = request.getfixturevalue("server").url
    backend = open_backend(found)
    backend.put(content("random"))
    backend.put(content("other", seed=2))
    backend.close()
    return found


@pytest.fixture
def catalog(url: str) -> Iterator[Catalog]:
    with Catalog.open(url) as opened:
        yield opened


def content(name: str, count: int = 120, seed: int = 1) -> MemoryContent:
    """A memory of boxes that stand askew, with names, relations and vectors."""
    chance = np.random.default_rng(seed)
    instances = []
    for n in range(count):
        box = OrientedBox(chance.uniform(0, 4, 3), chance.uniform(0.1, 1.0, 3), rotation_exp(chance.normal(size=3)))
        label, structure = ("mug", "box", "lamp")[n % 3], "floor" if n % 10 == 9 else None
        state = "removed" if n % 7 == 6 else "present"
        told = (label, f"red {label}", state, structure, float(n % 5) / 5 + 0.1, 0.01, 1, box)
        words = {word: round(100 * fits) for word, fits in vocabulary(label, None, f"red {label}", "dark red").items()}
        instances.append(CatalogInstance(name, n, *told, words))
    relations = [(n, "on", n + 1, 0.9, 0.1) for n in range(0, count - 1, 2)]
    vectors = chance.normal(size=(count, 16)).astype(np.float32)
    entry = MemoryEntry(name, f"/none/{name}.l3r", 0, f"{name}{seed}", 9, 0, "relative", "known", count, 1)
    return MemoryContent(entry, instances, relations, [SpaceVectors(SPACE, np.arange(count), vectors)])


def box_distance(instance: CatalogInstance, point: np.ndarray[Any, Any]) -> float:
    return float(box_distances([instance], point)[0])


def passing(filters: CatalogFilters) -> list[CatalogInstance]:
    wanted = content("random").instances
    wanted = [t for t in wanted if t.confidence >= filters.min_confidence and (filters.structure or not t.structure)]
    return [t for t in wanted if filters.state == "any" or t.state == (filters.state or "present")]


FILTERS = [
    CatalogFilters(),
    CatalogFilters(structure=True, state="any"),
    CatalogFilters(min_confidence=0.6, state="removed"),
]


@pytest.mark.parametrize("filters", FILTERS)
@pytest.mark.parametrize("point", [(1.0, 2.0, 3.0), (50.0, -9.0, 0.5)])
def test_nearest_are_those_of_all_boxes(catalog: Catalog, filters: CatalogFilters, point: tuple[float, ...]) -> None:
    found = catalog.nearest("random", point=point, k=7, filters=filters)
    truth = sorted((box_distance(t, np.array(point)), t.id) for t in passing(filters))[:7]
    assert [m.distance for m in found] == pytest.approx([d for d, _ in truth], abs=2e-4)
    assert {(m.memory, m.revision, m.units) for m in found} == {("random", 1, "unit")}
    assert not [m for m in catalog.nearest("random", instance_id=4, k=7) if m.id == 4]


def test_within_are_the_boxes_that_meet_a_region(catalog: Catalog) -> None:
    middle = np.array((2.0, 2.0, 2.0))
    inside = {m.id for m in catalog.within("random", center=middle, radius=0.8)}
    assert inside == {t.id for t in passing(CatalogFilters()) if box_distance(t, middle) <= 0.8}
    met = {m.id for m in catalog.within("random", lower=middle - 1, upper=middle + 1)}
    assert inside <= met
    assert all(t.aabb_distance(middle) > 1 for t in passing(CatalogFilters()) if t.id not in met)


def test_places_of_one_memory_are_found_by_the_index_of_memory_and_box(server: PostgresServer) -> None:
    """Values as they are bound: a number sent as another type than the column's is no condition to that index."""
    from list3r.catalog.postgres import PostgresBackend

    class Explained(PostgresBackend):
        def _rows(self, query: str, values: Sequence[Any]) -> list[Any]:
            if "bounds" in query:
                told = "".join(row[0] for row in super()._rows(f"EXPLAIN {query}", values))
                plans.append(told)
            return super()._rows(query, values)

    plans: list[str] = []
    backend = Explained(server.url)
    backend.put(content("explained"))
    assert backend.near("explained", (1.0, 2.0, 3.0), 5, CatalogFilters())
    backend.drop("explained")
    backend.close()
    assert re.search(r"memory_id_bounds_idx.*Index Cond: \(memory_id = \d+\)", plans[0]), plans


def test_phrases_find_things_in_one_memory_and_over_all(catalog: Catalog) -> None:
    mugs = {t.id for t in passing(CatalogFilters()) if t.label == "mug"}
    assert {m.id for m in catalog.find("red mugs", "random", k=100)} == mugs
    everywhere = catalog.find("mug", k=1000)
    assert {m.id for m in everywhere if m.memory == "random"} == mugs
    assert "other" in {m.memory for m in everywhere}
    confident = [m.confidence for m in everywhere if m.memory == "random"]
    assert confident == sorted(confident, reverse=True)
    on = {m.id for m in catalog.find("mug on a box", "random", k=100)}
    assert on == {n for n in mugs if n % 2 == 0 and (n + 1) % 3 == 1}
    found = [(m.memory, m.id) for m in catalog.find("mug on a box", k=1000) if m.memory in ("random", "other")]
    assert sorted(found) == [(n, i) for n in ("other", "random") for i in sorted(on)]
    assert catalog.find("purple mug") == []
    for text in ("small mug", "mug left of box", "#3", "mug between box and lamp"):
        with pytest.raises(OptionError, match="ask the memory file"):
            catalog.find(text)


def test_stored_relations_answer_by_words_and_ids(catalog: Catalog) -> None:
    found = catalog.relations("random", subject=2)
    assert [(r.subject, r.predicate, r.object) for r in found] == [(2, "on", 3)]
    found = catalog.relations(subject="mug", predicate="on", object="box", k=1000)
    assert {r.memory for r in found} == {"random", "other"}
    assert {(r.subject % 3, r.object % 3) for r in found} == {(0, 1)}
    with pytest.raises(OptionError, match="is not stored"):
        catalog.relations("random", predicate="left_of")
    with pytest.raises(OptionError, match="belongs to one memory"):
        catalog.relations(subject=3)


def test_vectors_find_what_is_alike(catalog: Catalog) -> None:
    held = {
        (n, i): v for n, s in (("random", 1), ("other", 2)) for i, v in enumerate(content(n, seed=s).spaces[0].vectors)
    }
    query = held["random", 3]
    try:
        found = catalog.similar("random", instance_id=3, k=5)
    except CatalogError as error:
        assert "has no pgvector" in str(error)
        pytest.skip(str(error))
    shown = {("random", t.id) for t in passing(CatalogFilters())}
    cosine = {p: float(v @ query / np.linalg.norm(v) / np.linalg.norm(query)) for p, v in held.items()}
    own = sorted((p for p in shown if p != ("random", 3)), key=lambda p: -cosine[p])[:5]
    assert [(m.memory, m.id) for m in catalog.similar("random", instance_id=3, anywhere=False)] == own
    assert [m.score for m in found] == pytest.approx([cosine[m.memory, m.id] for m in found], abs=2e-3)
    assert found[0].score >= cosine[own[0]] - 2e-3
    assert catalog.similar(vector=query, space=SPACE, k=1)[0].id == 3
    with pytest.raises(List3rError, match=r"no vectors of|16"):
        catalog.similar(vector=np.ones(3), space=SPACE)
    with pytest.raises(OptionError, match="not all zero"):
        catalog.similar(vector=np.zeros(16), space=SPACE)


@pytest.mark.parametrize("length", [1e38, 1e-38, 1e300, 1e-300])
def test_how_long_a_vector_is_does_not_matter(catalog: Catalog, length: float) -> None:
    query = content("random").spaces[0].vectors[3].astype(np.float64)
    skip_without_vectors(catalog)
    found = [(m.memory, m.id) for m in catalog.similar(vector=query, space=SPACE, k=9)]
    assert [(m.memory, m.id) for m in catalog.similar(vector=length * query, space=SPACE, k=9)] == found
    assert found[0] == ("random", 3)


@pytest.mark.parametrize("length", [5e37, 1e-37])
def test_how_long_a_stored_vector_is_does_not_matter(catalog: Catalog, length: float) -> None:
    skip_without_vectors(catalog)
    held = looking("long", 50, 3, f"long{length}@1/16")
    usual = held.spaces[0].vectors
    catalog._backend.put(replace(held, spaces=[replace(held.spaces[0], vectors=usual * np.float32(length))]))
    found = catalog.similar("long", instance_id=4, anywhere=False)
    catalog.remove("long")
    cosine = usual @ usual[4] / np.linalg.norm(usual, axis=1) / np.linalg.norm(usual[4])
    assert [m.score for m in found] == pytest.approx([cosine[m.id] for m in found], abs=2e-3)


@pytest.mark.parametrize(
    ("vector", "space", "said"),
    [
        (np.ones(3), SPACE, "3 numbers does not belong to test@1/16, which has 16"),
        (np.ones(16), "none@1/16", "no vectors of none@1/16; it has: .*test@1/16"),
        ([*np.ones(15), np.inf], SPACE, "finite numbers"),
        ([10**400] * 16, SPACE, "finite numbers"),
        (["a"] * 16, SPACE, "finite numbers"),
    ],
)
def test_vectors_that_cannot_be_compared_are_refused(catalog: Catalog, vector: Any, space: str, said: str) -> None:
    skip_without_vectors(catalog)
    with pytest.raises((OptionError, SpaceMismatchError), match=said):
        catalog.similar(vector=vector, space=space)


def test_a_space_has_vectors_of_one_dimension(catalog: Catalog) -> None:
    skip_without_vectors(catalog)
    held = content("short")
    short = SpaceVectors(SPACE, np.arange(2), np.ones((2, 3), np.float32))
    with pytest.raises(CatalogError, match="3 numbers do not belong to test@1/16, which has 16"):
        catalog._backend.put(replace(held, spaces=[short]))


def skip_without_vectors(catalog: Catalog) -> None:
    if not getattr(catalog._backend, "has_vectors", True):
        pytest.skip("the server has no pgvector")


@pytest.fixture
def vectors(server: PostgresServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[Catalog]:
    """A catalogue in which few vectors get an index already; the test is skipped where the server has no pgvector."""
    from list3r.catalog import postgres_schema

    monkeypatch.setattr(postgres_schema, "FEWEST_INDEXED", 500)
    monkeypatch.setattr(postgres_schema, "_A_LIST", 20)
    with Catalog.open(server.url) as catalog:
        if not catalog._backend.has_vectors:  # type: ignore[attr-defined]
            pytest.skip("the server has no pgvector")
        yield catalog


def lists(server: PostgresServer, space: str) -> str | None:
    """The options of the index of a space, None where it has none."""
    psycopg = pytest.importorskip("psycopg")
    query = (
        "SELECT array_to_string(reloptions, ',') FROM pg_class JOIN list3r.space ON relname = "
        "format('vector_%s_alike', space_id) WHERE name = %s"
    )
    with psycopg.connect(server.url) as connection:
        found = connection.execute(query.replace("%s_", "%%s_"), (space,)).fetchone()
    return found[0] if found else None


def looking(name: str, count: int, seed: int, space: str = "many@1/16") -> MemoryContent:
    held = content(name, count, seed)
    return replace(held, spaces=[replace(held.spaces[0], space=space)])


def test_the_index_of_vectors_grows_with_them(vectors: Catalog, server: PostgresServer) -> None:
    backend, space = vectors._backend, "many@1/16"
    held = {name: looking(name, 300, seed) for seed, name in enumerate(("m1", "m2", "m3", "m4", "m5"), 10)}
    found = []
    for one in held.values():
        with backend.loading(many=False):
            backend.put(one)
        found.append(lists(server, space))
    assert found == [None, "lists=30", "lists=30", "lists=60", "lists=60"]
    shown = {
        n: one.spaces[0].vectors / np.linalg.norm(one.spaces[0].vectors, axis=1)[:, None] for n, one in held.items()
    }
    filters = CatalogFilters(structure=True, state="any")
    query = shown["m2"][7]
    cosine = sorted(((n, i) for n, v in shown.items() for i in range(300)), key=lambda p: -shown[p[0]][p[1]] @ query)

    def answer(k: int) -> list[tuple[str, int]]:
        return [(m.memory, m.id) for m in vectors.similar(vector=query, space=space, k=k, filters=filters)]

    before = answer(20)
    assert len(set(before) & set(cosine[:20])) >= 19
    with backend.loading(many=False):
        for name in ("m4", "m2"):
            assert backend.put(held[name], again=True).revision == 1
    assert answer(20) == before
    assert len(answer(900)) == 900  # more than the lists that are looked at first hold
    with backend.loading(many=True):
        assert lists(server, space) is None
        assert answer(5) == cosine[:5]
    assert lists(server, space) == "lists=75"
    for name in held:
        backend.drop(name)


def test_of_wide_vectors_fewer_lists_are_looked_at(vectors: Catalog) -> None:
    backend, space, wide = vectors._backend, "wide@1/200", np.random.default_rng(5).normal(size=(600, 200))
    with backend.loading(many=False):
        held = SpaceVectors(space, np.arange(600), wide.astype(np.float32))
        backend.put(replace(content("wide", 600), spaces=[held]))
    found = vectors.similar("wide", instance_id=4, k=400)  # more than the first lists hold
    assert len(found) == 400
    cosine = wide @ wide[4] / np.linalg.norm(wide, axis=1) / np.linalg.norm(wide[4])
    assert [m.score for m in found] == pytest.approx([cosine[m.id] for m in found], abs=2e-3)
    assert backend._rows_in_fewer_lists("SHOW ivfflat.probes", ()) == [("20",)]  # type: ignore[attr-defined]
    assert backend._rows("SHOW ivfflat.probes", ()) == [("40",)]  # type: ignore[attr-defined]
    backend.drop("wide")


def test_what_is_equally_alike_comes_by_name(vectors: Catalog) -> None:
    backend, space = vectors._backend, "ties@1/16"
    names = ("b", "c", "a")
    for name in names:
        backend.put(looking(name, 50, 3, space))
    query = looking("a", 50, 3).spaces[0].vectors[5]
    assert [m.memory for m in vectors.similar(vector=query, space=space, k=2)] == ["a", "b"]
    for name in names:
        backend.drop(name)


def test_an_index_of_an_earlier_version_is_dropped(vectors: Catalog, server: PostgresServer) -> None:
    psycopg = pytest.importorskip("psycopg")
    vectors._backend.put(looking("kept", 50, 3, "older@1/16"))
    with psycopg.connect(server.url) as owner:
        number = owner.execute("SELECT space_id FROM list3r.space WHERE name = 'older@1/16'").fetchone()[0]
        kind = "USING hnsw (v public.halfvec_cosine_ops) WITH (m = 12)"
        owner.execute(f"CREATE INDEX vector_{number}_alike ON list3r.vector_{number} {kind}")
        owner.execute("DELETE FROM list3r.version WHERE number = 2")
    assert lists(server, "older@1/16") == "m=12"
    with Catalog.open(server.url) as again:
        assert lists(server, "older@1/16") is None
        assert again.similar("kept", instance_id=3)
        again.remove("kept")


@pytest.mark.parametrize("text", STRANGE)
def test_what_is_asked_is_never_part_of_a_statement(catalog: Catalog, text: str) -> None:
    before = catalog.memories()
    asked: list[Callable[[], Any]] = [
        lambda: catalog.nearest(text, point=(0, 0, 0)),
        lambda: catalog.find(text),
        lambda: catalog.find("mug", text),
        lambda: catalog.relations(subject=text, predicate="on"),
        lambda: catalog.similar(text, instance_id=1),
        lambda: catalog.similar(vector=np.ones(16), space=text),
        lambda: catalog.remove(text),
        lambda: catalog.nearest("random", instance_id=2**63),
    ]
    for ask in asked:
        try:
            assert list(ask()) == []
        except List3rError as error:
            assert "\n" not in str(error)
    assert catalog.memories() == before


def test_names_of_things_are_kept_as_they_are(url: str, catalog: Catalog) -> None:
    """Labels, descriptions and names of memories of all kinds go in and come out."""
    held, labels = content("strange", count=len(STRANGE)), [text.replace("\x00", "\ufffd") for text in STRANGE]
    instances = [replace(t, label=label, structure=None) for t, label in zip(held.instances, labels, strict=True)]
    backend = open_backend(url)
    name = "m'); DELETE FROM memory; --"
    backend.put(replace(held, entry=replace(held.entry, name=name), instances=instances))
    found = catalog.nearest(name, point=(0, 0, 0), k=9, filters=CatalogFilters(state="any"))
    assert {m.label for m in found} == {t.label for t in instances}
    assert {e.name for e in catalog.memories()} >= {name, "random", "other"}
    assert backend.drop(name)
    backend.close()


def test_a_memory_that_cannot_be_written_whole_is_not_written(url: str, catalog: Catalog) -> None:
    broken = content("random", seed=5)
    broken = replace(broken, relations=[*broken.relations, broken.relations[0]])
    before, answers = catalog.memory("random"), catalog.find("mug", "random", k=50)
    backend = open_backend(url)
    with pytest.raises(CatalogError, match="nothing was changed"):
        backend.put(broken)
    backend.close()
    assert catalog.memory("random") == before
    assert catalog.find("mug", "random", k=50) == answers


@pytest.fixture
def room(tmp_path: Path) -> Path:
    path = tmp_path / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    return path


def test_files_are_read_and_changes_of_them_noticed(catalog: Catalog, room: Path, tmp_path: Path) -> None:
    first = catalog.add(room)
    assert (first.revision, first.instances, first.sessions) == (1, 4, 1)
    assert catalog.add(room) == first
    mugs = catalog.find("mug on table", "room")
    assert ([m.id for m in mugs], {m.stale for m in mugs}, {m.path for m in mugs}) == ([3, 4], {False}, {str(room)})
    with Store.open(room, writable=True) as store, store.transaction():
        store.instances.set_labels({3: "vase"})
    mugs = catalog.find("mug", "room")
    assert {m.stale for m in mugs} == {True}
    assert "catalog add" in mugs.notes[0]
    assert catalog.add(room).revision == 2
    assert [m.id for m in catalog.find("vase", "room")] == [3]
    kept = catalog.add(room, store=str(tmp_path / "kept"))
    assert (kept.revision, Path(kept.path).parent) == (2, tmp_path / "kept")
    room.write_bytes(b"")
    assert {m.stale for m in catalog.find("vase", "room")} == {False}
    Path(kept.path).unlink()
    assert {m.stale for m in catalog.find("vase", "room")} == {True}
    catalog.remove("room")
    with pytest.raises(CatalogError, match="no memory 'room'"):
        catalog.find("vase", "room")
    with pytest.raises(UnknownIdError):
        catalog.nearest("random", instance_id=4000)


@pytest.mark.parametrize("name", ["../../x", "/x", "a/b", "..", "", "a\\b", "a\nb", "x" * 101])
def test_a_name_that_could_lead_elsewhere_is_refused(catalog: Catalog, room: Path, tmp_path: Path, name: str) -> None:
    def held() -> tuple[list[MemoryEntry], list[Path]]:
        return catalog.memories(), sorted(tmp_path.rglob("*"))

    before, kept = held(), str(tmp_path / "a" / "b" / "kept")
    for take in (lambda: catalog.add(room, name, kept), lambda: catalog.again(str(room), name)):
        with pytest.raises(OptionError, match="cannot be the name of a memory"):
            take()
    assert held() == before


def test_a_name_of_another_catalogue_is_asked_and_forgotten_but_not_written_again(
    url: str, catalog: Catalog, room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a catalogue that somebody else has made may hold it."""
    held = content("../../x")
    backend = open_backend(url)
    backend.put(replace(held, entry=replace(held.entry, path=str(room))))
    backend.close()
    assert catalog.find("mug", "../../x")
    assert list3r(["catalog", "rebuild", "--catalog", url]) == 2
    assert "'../../x' cannot be the name of a memory" in capsys.readouterr().err
    assert list3r(["catalog", "remove", "../../x", "--catalog", url]) == 0


def test_the_command_refuses_names_that_could_lead_elsewhere(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url, before = str(tmp_path / "c.sqlite"), list(tmp_path.parent.rglob("*"))
    add = ["catalog", "add", "--catalog", url, "--store", str(tmp_path / "kept")]
    assert list3r([*add, str(room), "--name", "../../x"]) == 2
    room.rename(strange := room.with_name("a room.l3r"))
    assert list3r([*add, str(strange)]) == 2
    assert "rename the file" in capsys.readouterr().err
    assert {p.name for p in set(tmp_path.parent.rglob("*")) - set(before)} == {"a room.l3r", "c.sqlite"}
    assert list3r([*add, str(strange), "--name", "room"]) == 0


def test_a_memory_that_is_being_written_is_not_catalogued(room: Path) -> None:
    with Store.open(room, writable=True) as store:
        with store.transaction():
            store.instances.set_labels({3: "vase"})
        with pytest.raises(CatalogError, match="being written"):
            read_content(str(room))


def test_a_catalogue_written_anew_answers_the_same(room: Path, tmp_path: Path) -> None:
    shutil.copy(room, tmp_path / "second.l3r")
    with Catalog.open(str(tmp_path / "a.sqlite")) as one, Catalog.open(f"sqlite:///{tmp_path}/b.sqlite") as other:
        for path in (room, tmp_path / "second.l3r"):
            one.add(path)
            other.again(str(path))
            one.again(str(path))
        assert one.memories() == other.memories()
        assert list(one.find("mug", k=9)) == list(other.find("mug", k=9))


def test_files_that_are_no_catalogue_are_refused(tmp_path: Path, room: Path) -> None:
    with pytest.raises(CatalogError, match="is not a catalogue"):
        Catalog.open(str(room))
    (tmp_path / "text").write_text("no database at all, but long enough to be taken for the head of one" * 20)
    with pytest.raises(CatalogError, match="cannot be opened"):
        Catalog.open(str(tmp_path / "text"))
    with pytest.raises(CatalogError, match="mysql:// is not a catalogue"):
        Catalog.open("mysql://here/a")


def test_the_commands_keep_and_ask_a_catalogue(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIST3R_CATALOG", str(tmp_path / "c.sqlite"))
    url = str(tmp_path / "c.sqlite")

    def answer(*words: str, status: int = 0) -> dict[str, Any]:
        assert list3r([*words, "--json"]) == status
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        assert found["schema"] == "list3r/answer/1"
        return found

    for words in (("catalog", "list"), ("find", "@all", "mug", "--catalog", url), ("catalog", "rebuild")):
        assert "does not exist" in answer(*words, status=2)["error"]["message"]
    assert [e["name"] for e in answer("catalog", "add", str(tmp_path))["matches"]] == ["room"]
    ask = ("--catalog", url)
    assert [m["id"] for m in answer("find", "@all", "mug on table", *ask)["matches"]] == [3, 4]
    assert answer("nearest", "room", "3", "-k", "1", *ask)["matches"][0]["path"] == str(room)
    assert [m["id"] for m in answer("within", "room", "--point", "2,1,0.4", "--radius", "0.3", *ask)["matches"]] == [5]
    assert answer("similar", "room", "3", "--everywhere", *ask)["matches"][0]["memory"] == "room"
    assert len(answer("relations", "room", "--predicate", "on", *ask)["matches"]) == 3
    assert answer("nearest", "room", "3", "--color", "red", *ask, status=2)["error"]
    assert answer("within", "@all", "--point", "0,0,0", "--radius", "1", *ask, status=2)["error"]
    assert answer("catalog", "check")["total"] == 0
    os.utime(room, (1, 1))
    assert answer("catalog", "check", status=1)["matches"][0]["name"] == "room"
    assert answer("catalog", "rebuild")["matches"][0]["revision"] == 1
    assert answer("catalog", "list")["total"] == 1
    assert answer("catalog", "remove", "room")["matches"] == [{"name": "room"}]


def test_passwords_and_wrong_servers_are_told_in_one_line(server: PostgresServer, tmp_path: Path) -> None:
    with pytest.raises(CatalogError, match="PGPASSWORD") as refused:
        Catalog.open("postgresql://me:secret@db.example/list3r")
    assert "secret" not in str(refused.value)
    with pytest.raises(CatalogError, match="cannot be opened") as absent:
        Catalog.open(f"postgresql:///none?host={tmp_path}")
    assert "\n" not in str(absent.value)


def test_a_role_that_may_only_read_asks_and_writes_nothing(server: PostgresServer) -> None:
    psycopg = pytest.importorskip("psycopg")
    backend = open_backend(server.url)
    backend.put(content("shown"))
    backend.close()
    with psycopg.connect(server.url) as owner:
        owner.execute("CREATE ROLE reader LOGIN; GRANT USAGE ON SCHEMA list3r TO reader")
        owner.execute("GRANT SELECT ON ALL TABLES IN SCHEMA list3r TO reader")
    with Catalog.open(server.url.replace("//postgres@", "//reader@")) as reader:
        assert reader.find("mug", "shown")
        with pytest.raises(CatalogError, match="permission denied"):
            reader.remove("shown")


@pytest.mark.slow
def test_a_server_that_dies_is_told_and_asked_again_when_it_is_back(server: PostgresServer) -> None:
    with Catalog.open(server.url) as catalog:
        backend = open_backend(server.url)
        backend.put(content("kept"))
        backend.close()
        before = catalog.find("mug", "kept", k=50)
        assert before
        server.kill()
        with pytest.raises(CatalogError, match="cannot be asked") as told:
            catalog.find("mug", "kept")
        assert "\n" not in str(told.value)
        assert not catalog.alive()
        server.start()
        assert catalog.find("mug", "kept", k=50) == before


def test_a_lost_network_is_told_and_nothing_is_half_written(server: PostgresServer) -> None:
    network = Network(server)
    with Catalog.open(network.url) as catalog:
        backend = open_backend(network.url)
        backend.put(content("far"))
        before = catalog.find("mug", "far", k=50), catalog.memories()
        held = content("half")

        def instances() -> Iterator[CatalogInstance]:
            yield from held.instances[:60]
            network.cut()
            yield from held.instances[60:]

        with pytest.raises(CatalogError, match="cannot be written; running the same command again is safe") as told:
            backend.put(replace(held, instances=instances()))  # type: ignore[arg-type]
        assert "\n" not in str(told.value)
        with pytest.raises(CatalogError, match="cannot be asked") as told:
            catalog.find("mug", "far")
        assert "\n" not in str(told.value)
        network.mend()
        assert (catalog.find("mug", "far", k=50), catalog.memories()) == before
        assert backend.put(held).revision == 1
        backend.close()
    network.cut()


@pytest.mark.slow
def test_a_full_disk_of_the_server_is_told_and_changes_nothing() -> None:
    psycopg = pytest.importorskip("psycopg")
    with running_postgres() as own, small_disk(own.folder / "small") as disk:
        with psycopg.connect(own.url, autocommit=True) as owner:
            owner.execute(f"CREATE TABLESPACE small LOCATION '{disk}'")
            owner.execute("ALTER DATABASE postgres SET default_tablespace = small")
        with Catalog.open(own.url) as catalog:
            backend = open_backend(own.url)
            backend.put(content("kept"))
            before = catalog.find("mug", "kept", k=50), catalog.memories()
            with pytest.raises(CatalogError, match="No space left on device") as told:
                backend.put(content("more", count=30_000))
            assert "nothing was changed" in str(told.value) and "\n" not in str(told.value)
            assert (catalog.find("mug", "kept", k=50), catalog.memories()) == before
            subprocess.run(["mount", "-o", "remount,size=96m", str(disk)], check=True)
            assert backend.put(content("little")).revision == 1
            backend.close()


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A disk of 12 MB for the server; the test is skipped where none may be made."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(folder)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("a small disk can be made by root alone, outside a container")
    try:
        shutil.chown(folder, "postgres")
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_is_told_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "full.sqlite"
    backend = open_backend(str(path))
    backend.put(content("kept"))
    backend._database.execute("PRAGMA max_page_count = 60")  # type: ignore[attr-defined]
    with pytest.raises(CatalogError, match="full; nothing was changed"):
        backend.put(content("more", count=2000))
    assert [e.name for e in backend.memories()] == ["kept"]
    backend.close()
    with sqlite3.connect(path) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
