"""Settled poses: a chunk that trembles stays where it was, one that moves is followed, boxes lie where chunks lie."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.geometry import Sim3
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.settled_poses import settle
from list3r.memory.overlap.summaries import chunk_summaries, is_known, world_unit
from list3r.memory.store.store import Store
from tests.test_consolidation import add, chunk, create


def shift(x: float, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Sim3:
    return Sim3.exp(np.array([x, y, z, 0.0, 0.0, yaw, 0.0]))


def place(store: Store, poses: dict[int, Sim3], T_world_graph: Sim3 | None = None) -> None:
    with store.transaction():
        if T_world_graph is not None:
            store.facts.S_world_graph = T_world_graph
        store.chunks.place(poses, {k: 1 for k in poses})
        consolidate(store)


def settled(store: Store) -> dict[int, Sim3]:
    with store.transaction():
        settle(store, chunk_summaries(store))
        return {k: row.S_graph_chunk for k, row in store.library.settled.all().items()}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = create(tmp_path / "a.l3r")
    for k in range(2):
        add(store, chunk(k))
    return store


def test_a_small_move_settles_nothing_anew_and_a_large_one_does(store: Store) -> None:
    place(store, {1: Sim3.identity(), 2: shift(0.002, yaw=0.001)})
    assert np.array_equal(settled(store)[2].as_matrix(), np.eye(4))
    place(store, {1: Sim3.identity(), 2: shift(0.02)})
    assert np.allclose(settled(store)[2].as_matrix(), shift(0.02).as_matrix())


def test_many_small_moves_do_not_add_up(store: Store) -> None:
    for n in range(1, 12):
        place(store, {1: Sim3.identity(), 2: shift(0.001 * n)})
        off = np.linalg.norm(settled(store)[2].translation - [0.001 * n, 0, 0])
        assert off <= 0.004 + 1e-9


def test_boxes_follow_the_chunks_to_the_last_digit(store: Store) -> None:
    before = {i.id: i for i in store.instances.all()}
    place(store, {1: shift(0.002, 0.001), 2: shift(0.002, 0.001)})
    assert {i.id for i in store.instances.all()} == set(before)
    for i in store.instances.all():
        for now, then in ((i.center, before[i.id].center), (i.box.center, before[i.id].box.center)):
            assert np.allclose(now - then, [0.002, 0.001, 0.0], atol=1e-9)
        assert np.allclose(i.aabb - before[i.id].aabb, [0.002, 0.001, 0.0], atol=1e-9)
        assert np.allclose(i.box.size, before[i.id].box.size)


def test_turning_the_world_moves_no_chunk_in_the_graph(store: Store) -> None:
    poses = settled(store)
    T_world_graph = shift(0.3, 0.0, 0.1, yaw=0.5)
    place(store, {k: T_world_graph @ S for k, S in poses.items()}, T_world_graph)
    for k, S in settled(store).items():
        assert np.array_equal(S.as_matrix(), poses[k].as_matrix())


def test_settled_poses_are_kept_in_the_memory(store: Store) -> None:
    place(store, {1: Sim3.identity(), 2: shift(0.003)})
    before = settled(store)[2].as_matrix()
    path = store.path
    store.close()
    with Store.open(path, writable=True) as again:
        assert np.array_equal(settled(again)[2].as_matrix(), before)


def test_a_metric_memory_knows_its_metre_however_scales_are_rounded(store: Store) -> None:
    rounded = Sim3(np.nextafter(1.0, 0.0), np.eye(3), np.zeros(3))
    chunks = [dataclasses.replace(c, S_world_chunk=rounded) for c in store.chunks.all()]
    assert is_known(chunks, {}) and world_unit(chunks, {}) == 1.0
    shrunk = [dataclasses.replace(c, S_world_chunk=Sim3(np.asarray(0.98), np.eye(3), np.zeros(3))) for c in chunks]
    assert not is_known(shrunk, {})
