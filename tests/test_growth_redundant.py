"""What was seen often enough: what is derived without it is what is derived with them, and costs no more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from list3r.memory.geometry import Sim3
from list3r.memory.library.consolidation import ConsolidationReport, consolidate
from list3r.memory.library.labels import apply_labels, put_votes
from list3r.memory.library.rules import ConsolidationSettings, RedundancySettings
from list3r.memory.maintenance import edits
from list3r.memory.overlap.summaries import chunk_summaries
from list3r.memory.overlap.voxels import coverage, lies_on
from list3r.memory.records import ChunkResult, Votes
from list3r.memory.runs import runs_seen, seen_together
from list3r.memory.store.store import Store
from tests.test_growth import _Undone, begin, tables, visit, walks

__all__ = ["walks"]

CULL = ConsolidationSettings(whole_chunks=0, redundancy=RedundancySettings(chunks=2))
KEEP = ConsolidationSettings(whole_chunks=0, redundancy=RedundancySettings(chunks=0))
STAY = [0, 1, 0, 1, 0, 1, 0, 1, 2, 1]


def add(store: Store, result: ChunkResult, settings: ConsolidationSettings = CULL) -> ConsolidationReport:
    with store.transaction():
        chunk_id = store.chunks.add(1, result)
        store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
        return consolidate(store, chunk_id, settings)


def whole(store: Store) -> dict[str, list[tuple[object, ...]]]:
    """What is derived as a whole, which is only looked at."""
    with pytest.raises(_Undone), store.transaction():
        store.library.forget()
        consolidate(store, settings=CULL)
        found = tables(store) | {"redundant": store.connection.rows("SELECT * FROM redundant ORDER BY 1, 2")}
        raise _Undone
    return found


def test_what_redundant_chunks_saw_belongs_to_the_instances_that_grow_without_them(
    walks: ModuleType, tmp_path: Path
) -> None:
    with Store.create(tmp_path / "cull.l3r") as store, Store.create(tmp_path / "keep.l3r") as every:
        for one in (store, every):
            begin(one)
        for index, place in enumerate(STAY):
            made = visit(walks, index, place, "corridor")
            report = add(store, made)
            add(every, made, KEEP)
            if index == 7:
                assert 8 in store.library.redundant.chunks() and len(report.written or ()) >= 12
        assert store.library.redundant.chunks() == {5, 6, 7, 8, 10}
        grown = tables(store) | {"redundant": store.connection.rows("SELECT * FROM redundant ORDER BY 1, 2")}
        assert whole(store) == grown
        assert store.library.overlaps.all().keys() < every.library.overlaps.all().keys()
        things, others = store.instances.all(structure=False), every.instances.all(structure=False)
        for a, b in zip(things, others, strict=True):
            assert store.observations.of(a.id) == every.observations.of(b.id)
            assert (a.id, a.observations, a.last_seen_s) == (b.id, b.observations, b.last_seen_s)
            assert np.allclose(a.aabb, b.aabb, atol=0.05)
        assert store.verify() == []


def test_redundant_chunks_follow_edits_and_moves(walks: ModuleType, tmp_path: Path) -> None:
    with Store.create(tmp_path / "cull.l3r") as store:
        begin(store)
        for index, place in enumerate([0, 1, 0, 1, 0, 1]):
            add(store, visit(walks, index, place, "corridor"))
        assert store.library.redundant.chunks() == {5, 6}
        things = [i.id for i in store.instances.all(structure=False) if len(store.observations.of(i.id)) == 6]
        both = {n for i in things[:2] for n in store.observations.of(i)}
        edits.merge(store, things[0], things[1], "somebody")
        assert {(o.chunk_id, o.local_id) for o in store.observations.of(things[0])} == {
            (o.chunk_id, o.local_id) for o in both
        }
        leaving = next(o for o in store.observations.of(things[2]) if o.chunk_id == 5)
        edits.split(store, things[2], [(5, leaving.local_id)], "somebody")
        assert 5 not in store.library.redundant.chunks()
        assert {o.chunk_id for o in store.observations.of(things[2])} == {1, 2, 3, 4, 6}
        with store.transaction():
            store.chunks.place({6: Sim3.exp(np.array([0.0, 40.0, 0.0, 0, 0, 0, 0]))}, {6: 1})
            consolidate(store, settings=CULL)
        assert store.library.redundant.chunks() == set()
        owners = {k: {o.instance_id for o in store.observations.all() if o.chunk_id == k} for k in (1, 6)}
        assert len(owners[6]) >= 12 and owners[6] & owners[1] == {things[0], things[2]}
        assert store.verify() == []


def test_redundant_chunks_are_carried_as_long_as_they_may_be_like_the_same(walks: ModuleType, tmp_path: Path) -> None:
    with Store.create(tmp_path / "cull.l3r") as store:
        begin(store)
        for index, place in enumerate(STAY):
            add(store, visit(walks, index, place, "corridor"))
        things = {i.id: i.observations for i in store.instances.all()}

        def end(*chunks: int, by: float) -> frozenset[int] | None:
            there = Sim3.exp(np.array([0.0, by, 0.0, 0, 0, 0, 0]))
            with store.transaction():
                store.chunks.place(dict.fromkeys(chunks, there), dict.fromkeys(chunks, 1))
                written = consolidate(store, settings=CULL).written
            assert store.library.redundant.chunks() == {5, 6, 7, 8, 10}
            assert {i.id: i.observations for i in store.instances.all()} == things
            return written

        assert end(5, 6, 7, by=0.008) == frozenset()
        assert {k for k, row in store.library.settled.all().items() if row.carried[0] > 0.004} == {5, 6, 7}
        assert end(5, 6, 7, by=0.016) is not None
        assert not any(store.library.settled.all()[k].carried.any() for k in (5, 6, 7))
        assert end(1, 2, 3, 4, 9, by=0.009) == frozenset()
        assert store.verify() == []


def with_thing(walks: ModuleType, made: ChunkResult, number: int) -> ChunkResult:
    """A chunk in which one more thing has come to stand."""
    frames, count = made.frame_indices, len(made.library.instances)
    rng = np.random.default_rng([3, made.index])
    thing = walks.thing(count, number, 1, np.zeros(3), frames, rng)
    return replace(made, library=replace(made.library, instances=(*made.library.instances, thing)))


def test_what_is_new_in_a_place_that_was_seen_often_is_found(walks: ModuleType, tmp_path: Path) -> None:
    with Store.create(tmp_path / "cull.l3r") as store:
        begin(store)
        for index in range(8):
            made = visit(walks, index, 0, "corridor")
            add(store, with_thing(walks, made, 14) if index >= 4 else made)
        redundant = store.library.redundant
        assert (redundant.chunks(), redundant.partly()) == ({3, 4, 7, 8}, {5, 6})
        assert {row.key[1] for row in redundant.of([5, 6])} == set(range(13))
        fresh = store.observations.owners([(5, 13)])[5, 13]
        assert [(o.chunk_id, o.local_id) for o in store.observations.of(fresh)] == [(k, 13) for k in (5, 6, 7, 8)]
        assert store.instances.get(fresh).observations == len({f for k in range(4, 8) for f in frames_of(walks, k)})
        grown = tables(store) | {"redundant": store.connection.rows("SELECT * FROM redundant ORDER BY 1, 2")}
        assert whole(store) == grown
        known = store.observations.owners([(6, 2)])[6, 2]
        edits.split(store, known, [(6, 2)], "somebody")
        assert 2 not in {row.key[1] for row in redundant.of([6])}
        assert store.observations.owners([(6, 2)]).get((6, 2)) != known
        assert store.verify() == []


def frames_of(walks: ModuleType, index: int) -> range:
    return range(walks.HOP * index, walks.HOP * index + walks.FRAMES)


@given(st.lists(st.sets(st.integers(0, 40)), max_size=4))
def test_runs_hold_the_frames_that_they_were_made_of(seen: list[set[int]]) -> None:
    runs = seen_together([runs_seen(k, np.array(sorted(s), np.int32)) for k, s in enumerate(seen, start=1)])
    frames = [f for a, b in runs.runs.tolist() for f in range(a, b)]
    assert frames == sorted(set().union(*seen))
    assert not frames or (frames[0] in seen[runs.first - 1] and frames[-1] in seen[runs.last - 1])


def test_some_instances_of_a_chunk_meet_others_as_all_of_them_do(walks: ModuleType, tmp_path: Path) -> None:
    with Store.create(tmp_path / "two.l3r") as store:
        begin(store)
        for index in range(2):
            add(store, visit(walks, index, index, "corridor"))
        a, b = (chunk_summaries(store)[k].shapes for k in (1, 2))
    every = coverage(a, b, Sim3.identity())
    kept = np.arange(len(a.local_id)) % 3 > 0
    assert np.array_equal(coverage(a.only(kept), b, Sim3.identity()), every[kept])
    assert np.array_equal(coverage(b, a.only(kept), Sim3.identity()), coverage(b, a, Sim3.identity())[:, kept])
    for n in range(len(kept)):
        one = np.arange(len(kept)) == n
        assert np.array_equal(coverage(a.only(one), b, Sim3.identity()), every[one])
    for n in np.flatnonzero(np.isnan(b.plane).any(axis=1)).tolist():
        on = lies_on(a.points, b.only(np.arange(len(b.local_id)) == n))
        assert np.allclose(np.bincount(a.owner, on) / np.bincount(a.owner), every[:, n])


def test_some_of_some_instances_keep_their_samples(walks: ModuleType, tmp_path: Path) -> None:
    with Store.create(tmp_path / "one.l3r") as store:
        begin(store)
        add(store, visit(walks, 0, 0, "corridor"))
        shapes = chunk_summaries(store)[1].shapes
    count = len(shapes.local_id)
    shapes = replace(shapes, samples=np.arange(count + 1), sample_owner=np.arange(-1, count, dtype=np.int32))
    one, two = np.arange(count) % 3 > 0, np.arange(count) % 4 > 0
    twice, once = shapes.only(one).only(two[one]), shapes.only(one & two)
    mine = once.sample_owner < len(once.local_id)
    assert np.array_equal(twice.sample_owner[mine], once.sample_owner[mine]) and mine.sum() == 1 + len(once.local_id)
    assert (twice.sample_owner[~mine] >= len(once.local_id)).all()
    assert len(set(twice.sample_owner.tolist())) == count + 1


def test_votes_for_what_is_redundant_count_as_they_come_and_all_at_once(walks: ModuleType, tmp_path: Path) -> None:
    with Store.create(tmp_path / "cull.l3r") as store:
        begin(store)
        for index in range(7):
            made = visit(walks, index, 0, "corridor")
            with store.transaction():
                chunk_id = store.chunks.add(1, made)
                store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
                told = Votes(1.0, {"cup" if index > 2 else "book": (4.0 + index, 20.0)}, 4.0)
                put_votes(store, chunk_id, "net", {n: told for n in range(0, 12, 2)}, fresh=True)
                apply_labels(store, written=consolidate(store, chunk_id, CULL).written)
        assert store.library.redundant.chunks() == {3, 4, 5, 6, 7}
        grown = store.detected_labels.all()
        assert {label.label for label in grown.values()} == {"cup"}
        with store.transaction():
            assert apply_labels(store).keys() == grown.keys() and store.detected_labels.all() == grown
            for chunk_id in (5, 6, 7):
                put_votes(store, chunk_id, "net", {})
            apply_labels(store)
        assert {label.label for label in store.detected_labels.all().values()} == {"book"}
