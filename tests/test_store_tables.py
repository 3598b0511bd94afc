"""What tables hold as records: round trips, values that are none, and the views of other programs."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import ChangeEvent, DetectedLabel, Votes
from list3r.memory.library.maintenance import edits
from list3r.memory.store.facts import Fact
from list3r.memory.store.file import connected
from list3r.memory.store.rows.json_values import array_scalar, typed
from list3r.memory.store.store import Store

Make = Callable[..., Path]
CUP = Votes(0.5, {"cup": (4.0, 16.0)}, 4.0)


def test_a_session_is_written_anew_as_it_is_said(make_memory: Make) -> None:
    with Store.open(make_memory(), writable=True) as store:
        said = replace(store.sessions.get(1), cuts=(4, 9), depth_step=3, lost_reasons=("dark", "fast"))
        with store.transaction():
            store.sessions.put(said)
        assert store.sessions.get(1) == said and store.verify() == []
        with pytest.raises(MemoryFileError, match="no session 2"):
            store.sessions.get(2)


def test_a_source_of_votes_replaces_what_it_said_itself(make_memory: Make) -> None:
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.votes.put(1, "one", {2: CUP, 3: CUP})
            store.votes.put(1, "two", {2: CUP})
            store.votes.put(1, "one", {3: replace(CUP, missed=1.0)})
        assert store.votes.of(1) == {"one": {3: replace(CUP, missed=1.0)}, "two": {2: CUP}}
        with store.transaction():
            store.sessions.drop(1)
        assert store.votes.of(1) == {}


def test_the_label_of_a_detector_goes_with_its_instance(make_memory: Make) -> None:
    label = DetectedLabel("cup", 0.9, 3.0, "net")
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.detected_labels.replace({2: label, 3: label, 4: label})
            store.detected_labels.replace({3: replace(label, label="mug")}, [2, 3])
            store.observations.forget([(1, 3)])
            store.instances.drop(4, None)
        assert store.detected_labels.all() == {3: replace(label, label="mug")}
        assert store.verify() == []


def test_a_fact_is_what_was_written_last_and_none_forgets_it(make_memory: Make) -> None:
    pairs = Fact[tuple[tuple[int, str], ...] | None]("pairs", tuple[tuple[int, str], ...], None)
    with Store.open(make_memory(), writable=True) as store:
        before = store.connection.stamp()[1]
        with store.transaction():
            store.facts.gravity = "estimated"
        assert store.connection.stamp()[1] == before, "what is known already is not written again"
        with store.transaction():
            store.facts[pairs] = ((1, "a"), (2, "b"))
        assert store.facts[pairs] == ((1, "a"), (2, "b"))
        with store.transaction():
            store.facts[pairs] = None
            store.connection.execute("UPDATE memory SET value = '3' WHERE key = 'gravity'")
        assert store.facts[pairs] is None
        with pytest.raises(MemoryFileError, match="the value gravity cannot be read"):
            _ = store.facts.gravity


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE frames SET time_s = 'soon' WHERE frame_index = 3",
        "UPDATE instances SET label = x'00' WHERE id = 4",
        "UPDATE instances SET geometry = x'00' WHERE id = 4",
        "UPDATE instances SET confidence = 7 WHERE id = 4",
        "UPDATE placements SET S_world_chunk = x'0000'",
        "UPDATE supports SET points = x'00' WHERE local_id = 2",
        "UPDATE sessions SET state = 'well'",
    ],
)
def test_what_a_table_may_not_hold_is_not_written(make_memory: Make, statement: str) -> None:
    with Store.open(make_memory(), writable=True) as store:
        with pytest.raises(MemoryFileError, match=r"none of its table .*nothing was changed"), store.transaction():
            store.connection.execute(statement)
        assert store.verify() == []


@pytest.mark.parametrize(
    ("statement", "told"),
    [
        ("UPDATE instances SET confidence = 7 WHERE id = 4", "CHECK constraint failed in instances"),
        ("UPDATE relations SET object = 77 WHERE subject = 3", "relations: a row points to one of instances"),
        ("DELETE FROM placements", "chunks: a row points to one of placements"),
    ],
)
def test_what_others_wrote_with_sums_of_their_own_is_named(make_memory: Make, statement: str, told: str) -> None:
    path = make_memory()
    with contextlib.closing(connected(path, "rw")) as database:
        for setting in ("journal_mode=WAL", "ignore_check_constraints=ON"):
            database.execute(f"PRAGMA {setting}").fetchall()
        database.begin("IMMEDIATE")
        database.execute(statement)
        database.commit()
    with Store.open(path) as store:
        assert any(told in text for text in store.verify())


@pytest.mark.parametrize(
    ("statement", "ask", "where"),
    [
        ("UPDATE sessions SET settings = '[]'", lambda s: s.sessions.all(), "sessions 1: settings .*list"),
        ("UPDATE local_instances SET track = x'0000'", lambda s: s.local_instances.nodes(), "s 1:0: track"),
    ],
)
def test_a_value_that_is_none_of_its_column_names_the_row(
    make_memory: Make, statement: str, ask: Callable[[Store], object], where: str
) -> None:
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.connection.execute(statement)
        store.connection.forget()
        with pytest.raises(MemoryFileError, match=where):
            ask(store)


def test_the_views_are_read_by_any_program(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store:
        edits.label(store, 3, "mug")
        mug, box = store.instances.get(3), store.instances.get(2).box
        with store.transaction():
            store.events.replace([ChangeEvent(1, 3, "moved", box, mug.box, (), 0.9, "it is elsewhere")])
    with contextlib.closing(sqlite3.connect(path)) as database:
        row = database.execute(
            "SELECT name, center_x, center_y, center_z, size_x, size_y, size_z, first_seen_s FROM things WHERE id = 3"
        ).fetchone()
        assert row == ("mug", *mug.center, *mug.box.size, mug.first_seen_s)
        named = database.execute("SELECT subject_name, predicate, object FROM relations_named WHERE subject = 3")
        assert ("mug", "on", 2) in named.fetchall()
        event = database.execute("SELECT name, kind, from_x, to_x, source FROM events_named").fetchall()
        assert event == [("mug", "moved", box.center[0], mug.box.center[0], "walk")]
        ids = {n for (n,) in database.execute("SELECT id FROM things")}
    with Store.open(path) as store:
        assert ids == {i.id for i in store.instances.all(structure=False)}


def test_arrays_are_known_by_their_type_in_every_numpy() -> None:
    assert array_scalar(NDArray[np.float32]) is np.float32
    assert array_scalar(np.ndarray[tuple[int], np.dtype[np.int8]]) is np.int8
    assert [array_scalar(kind) for kind in (int, list[int], tuple[int, ...])] == [None] * 3
    assert typed(NDArray[np.float32], [1, 2]).dtype == np.float32
