"""A library of several sessions that grows is the one derived as a whole, and its changes are told when one ends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.change.ledger import ChangeLedger
from list3r.memory.change.matching import ChangeMatching
from list3r.memory.geometry import Sim3
from list3r.memory.library import consolidation
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.rules import ConsolidationSettings
from list3r.memory.maintenance import edits
from list3r.memory.store.store import Store
from tests.session_scenes import FRAMES, Box, cameras, metric_store, simulated_chunk
from tests.test_growth import tables

GROW = ConsolidationSettings(whole_chunks=0, whole_share=1.0)
APART_M, TABLES = 9.0, 3
COLORS = [(200, 30, 30), (30, 40, 200), (30, 170, 40)]


def house(changes: Mapping[str, Box | None] | None = None) -> dict[str, Box]:
    """Tables in a row, too far apart to be seen from one another, each with three things on it, and what is other."""
    room = {}
    for n in range(TABLES):
        x = APART_M * n
        room[f"table {n}"] = Box((x, 0.0, 0.72), (1.6, 0.9, 0.04), (150, 110, 70))
        for m, dx in enumerate((-0.5, 0.0, 0.5)):
            at = (x + dx, 0.15 - 0.15 * m, 0.81)
            room[f"thing {n}{m}"] = Box(at, (0.12, 0.12 + 0.02 * m, 0.14), COLORS[m])
    for name, box in (changes or {}).items():
        room[name] = box if box is not None else Box((0.0, 0.0, -50.0), (0.1, 0.1, 0.1), (0, 0, 0))
    return room


def moved(name: str, dx: float, dy: float) -> Box:
    """A thing somewhere else on its table."""
    box = house()[name]
    return replace(box, center=(box.center[0] + dx, box.center[1] + dy, box.center[2]))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with metric_store(tmp_path / "house.l3r") as opened:
        yield opened


def film(store: Store, room: Mapping[str, Box], visits: list[tuple[int, float]], *, checked: bool = False) -> None:
    """One session: a chunk for each (table, angle), each taken in by itself, then its end."""
    with store.transaction():
        session = store.sessions.add("simulated", f"{len(store.sessions.all())}", {}, FRAMES * len(visits))
    for index, (table, angle) in enumerate(visits):
        poses = cameras((APART_M * table, 0.0, 0.75), angle)
        with store.transaction():
            chunk_id = store.chunks.add(session, simulated_chunk(room, poses, index))
            store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
            consolidate(store, chunk_id, GROW)
        if checked:
            check(store, chunk_id)
    with store.transaction():
        consolidate(store, settings=GROW)
        store.sessions.complete(session)
    check(store, None)


def everything(store: Store) -> dict[str, object]:
    """All that consolidation writes, and what has changed between sessions."""
    events = store.connection.rows("SELECT * FROM events ORDER BY session_id, instance")
    return {
        **tables(store),
        "events": events,
        "tale": store.connection.rows("SELECT json_remove(value, '$.stands') FROM memory WHERE key = 'change_ledger'"),
    }


class _Undone(Exception):
    """What was derived as a whole is only looked at."""


def check(store: Store, chunk_id: int | None) -> None:
    """What has grown is what is derived as a whole, while a session comes in or after its end."""
    grown, boxes = everything(store), [i.aabb for i in store.instances.all()]
    with pytest.raises(_Undone), store.transaction():
        store.library.forget()
        consolidate(store, chunk_id, GROW)
        whole, others = everything(store), [i.aabb for i in store.instances.all()]
        raise _Undone
    for name, rows in whole.items():
        assert grown[name] == rows, name
    assert np.allclose(boxes, others, atol=1e-9)
    assert store.verify() == []


@pytest.fixture
def whole_runs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many chunks the memory had each time it was derived as a whole."""
    runs: list[int] = []
    derive = consolidation._derive

    def watched(region, dirty, *arguments, **options):  # type: ignore[no-untyped-def]
        if dirty.whole:
            runs.append(len(region.rows))
        return derive(region, dirty, *arguments, **options)

    monkeypatch.setattr(consolidation, "_derive", watched)
    return runs


FIRST = [(n, angle) for n in range(TABLES) for angle in (0.4, 1.5)]
LATER = {
    "thing 10": moved("thing 10", 0.25, -0.35),
    "thing 11": None,
    "new": Box((9.25, 0.3, 0.83), (0.13, 0.13, 0.18), (140, 20, 160)),
}


def test_three_sessions_grow_to_what_is_derived_as_a_whole(store: Store) -> None:
    film(store, house(), FIRST)
    film(store, house(LATER), [(1, 0.9), (1, 2.2), (2, 0.8)], checked=True)
    kinds = [e.kind for e in store.events.all(2)]
    assert {"seen_again", "moved", "removed", "added"} == set(kinds)
    states = {i.state for i in store.instances.all()}
    assert states == {"present", "moved", "removed", "added", "unseen"}
    film(store, house({"thing 22": None}), [(1, 1.4), (1, 0.2), (2, 0.7), (2, 2.1)], checked=True)
    assert {"seen_again", "moved", "removed", "added"} == {e.kind for e in store.events.all(3)}


def test_a_chunk_of_a_later_session_is_not_derived_as_a_whole(store: Store, whole_runs: list[int]) -> None:
    film(store, house(), FIRST)
    del whole_runs[:]
    with store.transaction():
        session = store.sessions.add("simulated", "later", {}, 1)
        chunk_id = store.chunks.add(session, simulated_chunk(house(LATER), cameras((APART_M, 0.0, 0.75), 0.9), 0))
        store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
        consolidate(store, chunk_id, GROW)
        assert store.events.all() == []
        consolidate(store, settings=GROW)
    assert {"moved", "removed", "added"} < {e.kind for e in store.events.all(session)}
    assert whole_runs == []


def told_until(store: Store, session: int) -> list[object]:
    """The rows of the events of sessions up to one."""
    return store.connection.rows("SELECT * FROM events WHERE session_id <= ? ORDER BY 1, 2", (session,))


@pytest.fixture
def stood(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The last session of which what was told stood, each time that changes were looked for: at the end of a session,
    and when that is checked, which is as a whole.
    """
    sessions: list[int] = []
    go_on = ChangeMatching.go_on

    def watched(matching: ChangeMatching, told: ChangeLedger) -> None:
        sessions.append(told.session)
        go_on(matching, told)

    monkeypatch.setattr(ChangeMatching, "go_on", watched)
    return sessions


def test_the_end_of_a_session_matches_that_session_alone(store: Store, stood: list[int]) -> None:
    film(store, house(), FIRST)
    film(store, house(LATER), [(1, 0.9), (1, 2.2)])
    film(store, house(LATER), [(1, 1.4), (0, 0.7)])
    before = told_until(store, 3)
    film(store, house({**LATER, "thing 00": None}), [(0, 0.2), (0, 2.1)])
    assert stood == [1, 1, 2, 1, 3, 1]
    assert told_until(store, 3) == before != []
    assert [e.kind for e in store.events.all(4) if e.kind != "seen_again"] == ["removed"]


def test_sessions_are_matched_again_where_chunks_of_theirs_have_moved(store: Store, stood: list[int]) -> None:
    film(store, house(), FIRST)
    film(store, house(LATER), [(1, 0.9), (1, 2.2)])
    with store.transaction():
        off = Sim3(np.asarray(1.0), np.eye(3), np.array([0.0, 0.0, 0.015]))
        store.chunks.place({store.chunks.all(2)[0].chunk_id: off}, {store.chunks.all(2)[0].chunk_id: 1})
    film(store, house(LATER), [(1, 1.4)])
    assert stood == [1, 1, 1, 1]


def test_an_edit_while_a_session_comes_in_matches_all_sessions_again(store: Store, stood: list[int]) -> None:
    film(store, house(), FIRST)
    film(store, house(LATER), [(1, 0.9), (1, 2.2)])
    with store.transaction():
        session = store.sessions.add("simulated", "later", {}, 1)
        chunk_id = store.chunks.add(session, simulated_chunk(house(LATER), cameras((APART_M, 0.0, 0.75), 1.4), 0))
        store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
        consolidate(store, chunk_id, GROW)
    del stood[:]
    gone = next(e.instance_id for e in store.events.all(2) if e.kind == "moved")
    edits.split(store, gone, author="somebody")
    assert stood == [1] and gone not in [e.instance_id for e in store.events.all(2) if e.kind == "moved"]


@pytest.mark.parametrize("seed", range(3))
def test_whatever_happens_in_sessions_they_grow_to_what_is_derived_as_a_whole(
    store: Store, stood: list[int], seed: int
) -> None:
    rng = np.random.default_rng([9, seed])
    film(store, house(), FIRST)
    for _ in range(4):
        names = rng.choice([name for name in house() if name.startswith("thing")], 3, replace=False)
        ways = rng.uniform(-0.25, 0.25, (2, 2))
        changes = {names[0]: None, **{n: moved(n, *way) for n, way in zip(names[1:], ways.tolist(), strict=True)}}
        visits = [(int(rng.integers(2)), float(rng.uniform(0.0, 2.2))) for _ in range(2)]
        film(store, house(changes), visits)  # which checks it
    assert max(stood) > 1, "no session was matched alone"


def test_an_edit_in_a_memory_of_two_sessions_tells_the_changes_again(store: Store, whole_runs: list[int]) -> None:
    film(store, house(), FIRST)
    film(store, house(LATER), [(1, 0.9), (1, 2.2)])
    with store.transaction():
        consolidate(store)
    gone = next(e.instance_id for e in store.events.all(2) if e.kind == "moved")
    before = everything(store)
    del whole_runs[:]
    entry = edits.split(store, gone, author="somebody").entry
    assert gone not in [e.instance_id for e in store.events.all(2) if e.kind == "moved"]
    edits.undo(store, entry, "somebody")
    assert everything(store)["events"] == before["events"]
    edits.delete(store, gone, "somebody")
    assert not [e for e in store.events.all() if e.instance_id == gone]
    assert whole_runs == []
    check(store, None)
