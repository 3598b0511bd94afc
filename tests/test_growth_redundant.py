"""Chunks that see nothing new: what is derived without them is what is derived with them, and costs no more."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from list3r.memory.geometry import Sim3
from list3r.memory.library.consolidation import ConsolidationReport, consolidate
from list3r.memory.library.rules import ConsolidationSettings, RedundancySettings
from list3r.memory.maintenance import edits
from list3r.memory.records import ChunkResult
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
        assert len({o.instance_id for o in store.observations.all() if o.chunk_id == 6}) >= 12
        assert store.verify() == []
