"""Changes between sessions follow from what the sessions saw, however the library came to be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.geometry import Sim3
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
from tests.session_scenes import FRAMES, Box, cameras, metric_store, simulated_chunk
from tests.test_derivation import check, tables

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


def film(store: Store, room: Mapping[str, Box], visits: list[tuple[int, float]], *, derived: bool = True) -> None:
    """One session: a chunk for each (table, angle), each taken in by itself, then its end."""
    with store.transaction():
        session = store.sessions.add("simulated", f"{len(store.sessions.all())}", {}, FRAMES * len(visits))
    for index, (table, angle) in enumerate(visits):
        poses = cameras((APART_M * table, 0.0, 0.75), angle)
        with store.transaction():
            chunk_id = store.chunks.add(session, simulated_chunk(room, poses, index))
            store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
            if derived:
                consolidate(store, chunk_id)
    with store.transaction():
        consolidate(store)
        store.sessions.complete(session)
    check(store)


def events(store: Store) -> list[tuple[object, ...]]:
    return store.connection.rows("SELECT * FROM events ORDER BY 1, 2")


FIRST = [(n, angle) for n in range(TABLES) for angle in (0.4, 1.5)]
LATER = {
    "thing 10": moved("thing 10", 0.25, -0.35),
    "thing 11": None,
    "new": Box((9.25, 0.3, 0.83), (0.13, 0.13, 0.18), (140, 20, 160)),
}


@pytest.mark.slow
@pytest.mark.parametrize("derived", [True, False], ids=["with each chunk", "at the end"])
def test_three_sessions_tell_what_they_changed(store: Store, derived: bool) -> None:
    film(store, house(), FIRST, derived=derived)
    film(store, house(LATER), [(1, 0.9), (1, 2.2), (2, 0.8)], derived=derived)
    kinds = [e.kind for e in store.events.all(2)]
    assert {"seen_again", "moved", "removed", "added"} == set(kinds)
    states = {i.state for i in store.instances.all()}
    assert states == {"present", "moved", "removed", "added", "unseen"}
    before = events(store)
    film(store, house({"thing 22": None}), [(1, 1.4), (1, 0.2), (2, 0.7), (2, 2.1)], derived=derived)
    assert {"seen_again", "moved", "removed", "added"} == {e.kind for e in store.events.all(3)}
    assert [e for e in events(store) if e[0] == 2] == before


@pytest.mark.slow
def test_a_session_that_comes_in_changes_nothing_until_it_ends(store: Store) -> None:
    film(store, house(), FIRST)
    film(store, house(LATER), [(1, 0.9), (1, 2.2)])
    before, moved_ids = events(store), [e.instance_id for e in store.events.all(2) if e.kind == "moved"]
    with store.transaction():
        session = store.sessions.add("simulated", "later", {}, 1)
        for angle in (1.4, 0.4, 2.1):
            poses = cameras((APART_M, 0.0, 0.75), angle)
            chunk_id = store.chunks.add(session, simulated_chunk(house(), poses, store.chunks.all()[-1].chunk_id))
            store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
            consolidate(store, chunk_id)
            assert events(store) == before and {i.id for i in store.instances.of(moved_ids)} == set(moved_ids)
        consolidate(store)
    assert {e.kind for e in store.events.all(session)} > {"seen_again"}


@pytest.mark.slow
def test_an_edit_in_a_memory_of_two_sessions_tells_the_changes_again(store: Store) -> None:
    film(store, house(), FIRST)
    film(store, house(LATER), [(1, 0.9), (1, 2.2)])
    gone = next(e.instance_id for e in store.events.all(2) if e.kind == "moved")
    before = events(store)
    entry = edits.split(store, gone, author="somebody").entry
    assert gone not in [e.instance_id for e in store.events.all(2) if e.kind == "moved"]
    edits.undo(store, entry, "somebody")
    assert events(store) == before
    edits.delete(store, gone, "somebody")
    assert not [e for e in store.events.all() if e.instance_id == gone]
    check(store)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_whatever_happens_in_sessions_is_told_alike_once_more(store: Store, seed: int) -> None:
    rng = np.random.default_rng([9, seed])
    film(store, house(), FIRST)
    for _ in range(4):
        names = rng.choice([name for name in house() if name.startswith("thing")], 3, replace=False)
        ways = rng.uniform(-0.25, 0.25, (2, 2))
        changes = {names[0]: None, **{n: moved(n, *way) for n, way in zip(names[1:], ways.tolist(), strict=True)}}
        visits = [(int(rng.integers(2)), float(rng.uniform(0.0, 2.2))) for _ in range(2)]
        before = [e[0] for e in events(store)]
        film(store, house(changes), visits)
        assert [e[0] for e in events(store)][: len(before)] == before
    assert len(tables(store)["instances"]) >= 12
