"""What later sessions saw again is looked at no more, and still is what the memory says it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.geometry import Sim3
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import apply_labels, put_votes
from list3r.memory.library.rules import ConsolidationSettings, RedundancySettings
from list3r.memory.maintenance import edits
from list3r.memory.records import Votes
from list3r.memory.store.store import Store
from tests.session_scenes import FRAMES, Box, cameras, metric_store, simulated_chunk
from tests.test_growth_sessions import APART_M, house, moved

EVERY = ConsolidationSettings(whole_chunks=0, whole_share=1.0, redundancy=RedundancySettings(sessions=0))
LAST = ConsolidationSettings(whole_chunks=0, whole_share=1.0, redundancy=RedundancySettings(sessions=2))
VISIT = [(0, 0.4), (0, 1.5), (1, 0.9)]
ROOMS = [
    house(),
    house({"thing 01": moved("thing 01", 0.25, 0.2)}),
    house({"thing 01": moved("thing 01", 0.25, 0.2), "thing 10": None}),
    house({"thing 01": None, "thing 10": None}),
    house({"new": Box((0.25, 0.3, 0.83), (0.13, 0.13, 0.18), (140, 20, 160)), "thing 10": None}),
    house({"thing 02": moved("thing 02", -0.2, 0.25)}),
]


@pytest.fixture
def stores(tmp_path: Path) -> Iterator[tuple[Store, Store]]:
    with metric_store(tmp_path / "every.l3r") as every, metric_store(tmp_path / "last.l3r") as last:
        yield every, last


def film(store: Store, room: Mapping[str, Box], settings: ConsolidationSettings) -> None:
    with store.transaction():
        session = store.sessions.add("simulated", f"{len(store.sessions.all())}", {}, FRAMES * len(VISIT))
    for index, (table, angle) in enumerate(VISIT):
        poses = cameras((APART_M * table, 0.0, 0.75), angle + 0.1 * session)
        with store.transaction():
            chunk_id = store.chunks.add(session, simulated_chunk(room, poses, index))
            store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
            put_votes(store, chunk_id, "net", {0: Votes(1.0, {"table": (8.0, 40.0)}, 8.0)}, fresh=True)
            apply_labels(store, written=consolidate(store, chunk_id, settings).written)
    with store.transaction():
        apply_labels(store, written=consolidate(store, settings=settings).written)
        store.sessions.complete(session)
    assert store.verify() == []


def told(store: Store) -> dict[str, list[tuple[object, ...]]]:
    """What a memory says of its instances, but for where exactly they end."""
    columns = "id, label, observations, first_seen_s, last_seen_s, state, structure, component"
    relations = "SELECT subject, predicate, object FROM relations ORDER BY 1, 2, 3"
    return {
        "instances": store.connection.rows(f"SELECT {columns} FROM instances ORDER BY id"),
        "observations": store.connection.rows("SELECT * FROM observations ORDER BY chunk_id, local_id"),
        "events": store.connection.rows("SELECT session_id, instance, kind, frames FROM events ORDER BY 1, 2"),
        "relations": store.connection.rows(relations),
        "aliases": store.connection.rows("SELECT * FROM aliases ORDER BY id"),
    }


def test_a_memory_of_many_sessions_says_what_it_says_with_all_that_they_saw(stores: tuple[Store, Store]) -> None:
    every, last = stores
    for n, room in enumerate(ROOMS):
        for store, settings in ((every, EVERY), (last, LAST)):
            film(store, room, settings)
        assert told(last) == told(every), n
    assert {e.kind for e in last.events.all()} == {"seen_again", "moved", "removed", "added"}
    away = last.observations.owners([(3, 1)])[3, 1]
    assert [(e.session_id, e.kind, e.from_box is None) for e in last.events.all() if e.instance_id == away] == [
        (2, "seen_again", False),
        (3, "removed", False),
        (6, "added", True),
    ]
    old = {row.key for row in last.library.redundant.superseded()}
    assert len(old) > 30 and not every.library.redundant.superseded()
    assert len(last.library.overlaps.all()) < 0.7 * len(every.library.overlaps.all())
    assert old <= {(o.chunk_id, o.local_id) for o in last.observations.all()}
    again = told(last)
    with last.transaction():
        consolidate(last, settings=LAST)
    assert told(last) == again and {row.key for row in last.library.redundant.superseded()} == old
    with last.transaction():
        last.library.forget()
        consolidate(last, settings=LAST)
    assert told(last) == again and last.verify() == []


def test_what_an_edit_names_is_looked_at_as_long_as_the_memory_lives(stores: tuple[Store, Store]) -> None:
    every, last = stores
    for store, settings in ((every, EVERY), (last, LAST)):
        film(store, ROOMS[0], settings)
        names = store.observations.owners([(1, n) for n in range(4)])
        edits.label(store, names[1, 1], "mug", "somebody")
        edits.merge(store, names[1, 2], names[1, 3], "somebody")
        for _ in range(4):
            film(store, ROOMS[0], settings)
        assert store.instances.get(names[1, 1]).label == "mug"
        assert set(store.observations.owners([(1, 2), (1, 3), (13, 2), (13, 3)]).values()) == {names[1, 2]}
    assert {row.key[1] for row in last.library.redundant.superseded() if row.key[0] == 1} == {0}
    assert told(last) == told(every)


def test_what_is_looked_at_no_more_is_where_it_does_not_lie_there_any_more(stores: tuple[Store, Store]) -> None:
    _, last = stores
    for _ in range(4):
        film(last, ROOMS[0], LAST)
    left_out = last.library.redundant
    assert {1, 2, 3, 4, 5, 6} == set(left_out.chunks())
    home = last.observations.owners([(7, n) for n in range(4)])
    with last.transaction():
        last.chunks.place({1: Sim3.exp(np.array([0.0, 40.0, 0.0, 0, 0, 0, 0]))}, {1: 1})
        consolidate(last, settings=LAST)
    assert set(left_out.chunks()) == {2, 3, 4, 5, 6}
    alone = last.observations.owners([(1, n) for n in range(4)])
    assert last.observations.owners([(7, n) for n in range(4)]) == home and not {*alone.values()} & {*home.values()}
    with last.transaction():
        last.chunks.place({1: Sim3.identity()}, {1: 1})
        consolidate(last, settings=LAST)
    assert {(1, n): k for (_, n), k in home.items()} == last.observations.owners([(1, n) for n in range(4)])
    assert set(left_out.chunks()) == {1, 2, 3, 4, 5, 6} and last.verify() == []


def test_an_operator_parts_what_is_looked_at_no_more(stores: tuple[Store, Store]) -> None:
    _, last = stores
    for _ in range(4):
        film(last, ROOMS[0], LAST)
    owner = last.observations.owners([(1, 2)])[1, 2]
    edits.split(last, owner, [(1, 2), (2, 2)], "somebody")
    now = last.observations.owners([(1, 2), (2, 2), (4, 2), (13, 2)])
    assert now[1, 2] == now[2, 2] != owner and {now[k] for k in now if k[0] > 2} == {owner}
    assert {(1, 2), (2, 2)}.isdisjoint({row.key for row in last.library.redundant.superseded()})
    edits.undo(last, None, "somebody")
    assert set(last.observations.owners([(1, 2), (2, 2), (4, 2)]).values()) == {owner} and last.verify() == []


def test_a_chunk_that_moves_as_a_session_ends_leaves_what_that_session_supersedes(stores: tuple[Store, Store]) -> None:
    _, last = stores
    for _ in range(2):
        film(last, ROOMS[0], LAST)
    with last.transaction():
        session = last.sessions.add("simulated", "third", {}, FRAMES)
        chunk_id = last.chunks.add(session, simulated_chunk(ROOMS[0], cameras((0.0, 0.0, 0.75), 0.7), 0))
        last.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
        consolidate(last, chunk_id, LAST)
    home = last.observations.owners([(5, n) for n in range(4)])
    with last.transaction():
        last.chunks.place({4: Sim3.exp(np.array([0.0, 40.0, 0.0, 0, 0, 0, 0]))}, {4: 1})
        consolidate(last, settings=LAST)
    assert {row.key[0] for row in last.library.redundant.superseded()} == {1, 2}
    assert {(1, n): k for (_, n), k in home.items()} == last.observations.owners([(1, n) for n in range(4)])
    assert set(last.observations.owners([(4, n) for n in range(4)]).values()).isdisjoint(home.values())
    assert last.verify() == []


def test_what_is_left_out_as_soon_as_it_is_recognised_leaves_its_id(stores: tuple[Store, Store]) -> None:
    every, last = stores
    far = Sim3.exp(np.array([0.0, 40.0, 0.0, 0, 0, 0, 0]))
    for store, settings in ((every, EVERY), (last, LAST)):
        for number in range(3):
            with store.transaction():
                session = store.sessions.add("simulated", f"{number}", {}, FRAMES)
                chunk_id = store.chunks.add(session, simulated_chunk(ROOMS[0], cameras((0.0, 0.0, 0.75), 0.4), 0))
                store.chunks.place({chunk_id: Sim3.identity() if number else far}, {chunk_id: 1})
                consolidate(store, chunk_id, settings)
            with store.transaction():
                if number == 2:
                    store.chunks.place({1: Sim3.identity()}, {1: 1})
                consolidate(store, settings=settings)
                store.sessions.complete(session)
        first = store.observations.owners([(1, n) for n in range(4)])
        assert sorted(first.values()) == [1, 2, 3, 4]
        assert store.observations.owners([(3, n) for n in range(4)]) == {(3, n): k for (_, n), k in first.items()}
        assert store.verify() == []
    assert {row.key[0] for row in last.library.redundant.superseded()} == {1}
    assert told(last) == told(every)
