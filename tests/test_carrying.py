"""A walk that bends as a whole carries its library along, and what is derived anew is what lies otherwise."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from list3r.memory.geometry import Sim3
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.settled_poses import carried_boxes
from list3r.memory.relations.instance_geometry import InstanceGeometry
from list3r.memory.store.store import Store
from list3r.memory.world.floor import floor_near
from list3r.memory.world.gravity import GravitySettings
from tests.test_growth import GROW, _Undone, add, begin, visit, walks
from tests.test_structure import level

__all__ = ["walks"]

CHUNKS = 12
SETTINGS = GravitySettings()


@pytest.fixture(scope="module")
def made(walks: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A memory of a walk on into new rooms."""
    path = tmp_path_factory.mktemp("made") / "walk.l3r"
    with Store.create(path) as opened:
        begin(opened)
        for index in range(CHUNKS):
            add(opened, visit(walks, index, index))
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Iterator[Store]:
    with Store.open(Path(shutil.copy(made, tmp_path)), writable=True) as opened:
        yield opened


def bent(k: int, by: float = 1.0) -> Sim3:
    """Where chunk k lies when each turns by 0.01 degrees about up against the one before, and the walk climbs."""
    angle, along = np.radians(0.01 * by * k), 5.4 * k
    return Sim3.exp(np.array([0.0, -0.5 * along * angle, 0.0005 * by * k, 0.0, 0.0, angle, 0.0]))


def end(store: Store, poses: dict[int, Sim3]) -> frozenset[int] | None:
    """Place chunks and end the session; the instances that were written anew, None for all."""
    with store.transaction():
        store.chunks.place(poses, dict.fromkeys(poses, 1))
        return consolidate(store, settings=GROW).written


def found(store: Store) -> dict[str, Any]:
    """What does not depend on millimetres."""
    columns = "id, label, confidence, observations, first_seen_s, last_seen_s, state, structure, component, view_frame"
    return {
        "instances": store.connection.rows(f"SELECT {columns} FROM instances ORDER BY id"),
        "members": store.connection.rows("SELECT * FROM members ORDER BY chunk_id, local_id"),
        "observations": store.connection.rows("SELECT * FROM observations ORDER BY chunk_id, local_id"),
        "relations": {(r.subject, r.predicate, r.object) for r in store.relations.all()},
        "pairs": store.connection.rows("SELECT u, v FROM overlaps ORDER BY u, v"),
        "anchors": store.connection.rows("SELECT instance, chunk_id FROM anchors ORDER BY instance"),
    }


def check(store: Store, most_m: float = 0.01) -> None:
    """What was carried is what is derived as a whole where the chunks lie, but for millimetres."""
    carried, boxes = found(store), {i.id: i for i in store.instances.all()}
    with pytest.raises(_Undone), store.transaction():
        store.library.forget()
        consolidate(store, settings=GROW)
        whole, others = found(store), {i.id: i for i in store.instances.all()}
        raise _Undone
    for name, rows in whole.items():
        assert carried[name] == rows or (name == "relations" and len(carried[name] ^ rows) <= 0.01 * len(rows)), name
    for n, i in boxes.items():
        assert np.allclose(i.center, others[n].center, atol=most_m)
        assert np.allclose(i.aabb, others[n].aabb, atol=4.0 * most_m)
        assert np.allclose(i.box.rotation[2], (0.0, 0.0, 1.0))
    assert store.verify() == []


def test_a_walk_that_bends_carries_its_library_along(store: Store) -> None:
    before = {i.id: i for i in store.instances.all()}
    assert end(store, {k: bent(k) for k in range(1, CHUNKS + 1)}) == frozenset()
    last = max(before)
    assert np.linalg.norm(store.instances.get(last).center - before[last].center) > 0.02
    check(store)


def test_the_whole_world_moves_without_anything_being_derived(store: Store) -> None:
    turn = Sim3.exp(np.array([3.0, -1.0, 0.3, 0.0, 0.0, 0.005, 0.0]))
    with store.transaction():
        store.facts.S_world_graph = turn
    assert end(store, dict.fromkeys(range(1, CHUNKS + 1), turn)) == frozenset()
    check(store)


def test_what_lies_otherwise_to_its_neighbours_is_derived_anew_and_nothing_else(
    walks: ModuleType, store: Store
) -> None:
    poses = {k: bent(k) for k in range(1, CHUNKS + 1)}
    poses[6] = Sim3.exp(np.array([0.0, 0.02, 0.0, 0, 0, 0, 0])) @ poses[6]
    assert end(store, poses) is None
    check(store)


def test_boxes_along_the_axes_are_derived_anew_where_the_world_turns(store: Store) -> None:
    turn = Sim3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0]))
    with store.transaction():
        store.facts.S_world_graph = turn
    assert end(store, dict.fromkeys(range(1, CHUNKS + 1), turn)) is None
    check(store)


def test_a_late_chunk_that_lies_otherwise_leaves_the_rest_of_the_walk_as_it_is(walks: ModuleType, store: Store) -> None:
    for index in range(CHUNKS, 2 * CHUNKS):
        add(store, visit(walks, index, index))
    poses = {k: bent(k) for k in range(1, 2 * CHUNKS + 1)}
    poses[2 * CHUNKS] = Sim3.exp(np.array([0.0, 0.02, 0.0, 0, 0, 0, 0])) @ poses[2 * CHUNKS]
    written = end(store, poses)
    assert written is not None and 12 <= len(written) < 60
    near = {o.chunk_id for n in written for o in store.observations.of(n)}
    assert min(near) > CHUNKS
    check(store)


def test_small_shifts_add_up_over_several_ends(store: Store) -> None:
    def turned(by: float) -> dict[int, Sim3]:
        return {k: bent(k, by) for k in range(1, CHUNKS + 1)}

    for by in (0.8, 1.6):
        assert end(store, turned(by)) == frozenset()
    shifted = max(float(row.carried[0]) for row in store.library.settled.all().values())
    assert 0.002 < shifted < GROW.hysteresis.move_m
    assert end(store, turned(2.8)) is None
    assert not any(row.carried.any() for row in store.library.settled.all().values())
    check(store)


def test_a_chunk_that_was_measured_anew_is_derived_among_those_that_are_carried(store: Store) -> None:
    with store.transaction():
        store.library.unsettle(CHUNKS)
    written = end(store, {k: bent(k) for k in range(1, CHUNKS + 1)})
    assert written
    assert {o.chunk_id for n in written for o in store.observations.of(n)} <= set(range(CHUNKS - 4, CHUNKS + 1))
    check(store)


def test_a_walk_goes_on_from_where_it_was_carried(walks: ModuleType, store: Store) -> None:
    assert end(store, {k: bent(k) for k in range(1, CHUNKS + 1)}) == frozenset()
    add(store, visit(walks, CHUNKS, CHUNKS), bent(CHUNKS))
    assert end(store, {}) == frozenset()
    check(store)


def test_boxes_that_are_carried_hold_what_they_held() -> None:
    rng = np.random.default_rng(1)
    boxes = np.sort(rng.normal(size=(20, 2, 3)), axis=1)
    S = Sim3.exp(rng.normal(size=(20, 7)) * 0.3)
    inside = boxes[:, :1] + rng.random((20, 50, 3)) * np.ptp(boxes, axis=1)[:, None]
    there, held = S.apply(inside), carried_boxes(S, boxes)
    assert (there >= held[:, :1] - 1e-12).all() and (there <= held[:, 1:] + 1e-12).all()
    empty = np.array([[[np.inf] * 3, [-np.inf] * 3]])
    assert np.array_equal(carried_boxes(Sim3.exp(np.zeros((1, 7))), empty), empty)


def seen_from(height: float) -> np.ndarray:
    """Cameras at about a height. Shape (F, 3)."""
    return np.random.default_rng(2).normal((0.0, 0.0, height), (1.0, 1.0, 0.1), (50, 3))


def numbered(*surfaces: InstanceGeometry) -> list[InstanceGeometry]:
    return [replace(b, id=n) for n, b in enumerate(surfaces, start=1)]


@pytest.mark.parametrize("storey", [0.0, -7.3, 31.0])
def test_the_floor_of_a_storey_is_told_there(storey: float) -> None:
    near = numbered(level(storey, 0.02), level(storey + 0.75, 0.02, 1.2))
    assert floor_near(near, seen_from(storey + 1.5), 1.0, SETTINGS) == pytest.approx(storey, abs=0.01)


def test_a_table_whose_floor_nobody_saw_is_no_floor() -> None:
    assert floor_near(numbered(level(0.75, 0.02)), seen_from(1.4), 1.0, SETTINGS) is None
    assert floor_near(numbered(level(0.75, 0.02), level(0.3, 0.02, 0.3)), seen_from(1.6), 1.0, SETTINGS) is None


def test_without_cameras_or_surfaces_no_floor_is_told() -> None:
    assert floor_near([], seen_from(1.5), 1.0, SETTINGS) is None
    assert floor_near(numbered(level(0.0, 0.02)), np.zeros((0, 3)), 1.0, SETTINGS) is None
