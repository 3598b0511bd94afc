"""The library is a function of the chunks, of where they lie, and of what operators said."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult, LocalLibrary, Votes
from list3r.memory.library import attaching, consolidation, relating
from list3r.memory.library.consolidation import ConsolidationReport, consolidate
from list3r.memory.library.labels import apply_labels, put_votes
from list3r.memory.library.maintenance import edits
from list3r.memory.library.overlap import summaries, voxels
from list3r.memory.library.overlap.summaries import is_known, world_unit
from list3r.memory.library.rules import ConsolidationSettings, RedundancySettings
from list3r.memory.library.world.world import WORLD
from list3r.memory.store.store import Store

ORDERS = {
    "rooms": [*range(14)],
    "there and back": [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 4, 3],
    "one room": [0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0],
    "jumps": [0, 5, 1, 4, 2, 3],
}
CULL = ConsolidationSettings(redundancy=RedundancySettings(chunks=2))


@pytest.fixture(scope="module")
def walks() -> Iterator[ModuleType]:
    """`benchmarks/incremental.py`, whose chunks these are."""
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "incremental.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(path.parent)
        spec = importlib.util.spec_from_file_location("incremental", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module


def visit(walks: ModuleType, index: int, place: int, name: str = "rooms") -> ChunkResult:
    """Chunk `index` of a walk, which sees what lies at a place, each time with other errors."""
    rng = np.random.default_rng([7, index])
    made: ChunkResult = walks.chunk(place, name, 1)
    frames = np.arange(walks.HOP * index, walks.HOP * index + walks.FRAMES)
    off = rng.normal(0.0, 0.004, 3)

    def seen(found):  # type: ignore[no-untyped-def]
        points = found.support.points + off + rng.normal(0.0, 0.002, found.support.points.shape)
        support = dataclasses.replace(found.support, points=points.astype(np.float32))
        return dataclasses.replace(found, support=support, track=dataclasses.replace(found.track, frames=frames))

    library = dataclasses.replace(made.library, instances=tuple(map(seen, made.library.instances)))
    later = int(frames[0] - made.frame_indices[0])
    keyframes = tuple(dataclasses.replace(k, frame_index=k.frame_index + later) for k in made.keyframes)
    return dataclasses.replace(
        made, index=index, frame_indices=frames, times_s=frames / 30.0, library=library, keyframes=keyframes
    )


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.create(tmp_path / "walk.l3r") as opened:
        begin(opened)
        yield opened


def begin(store: Store) -> None:
    with store.transaction():
        store.facts.scale_kind = "metric"
        store.facts.gravity = "estimated"
        store.sessions.add("walk", "made up", {}, 999)


def add(
    store: Store,
    result: ChunkResult,
    pose: Sim3 | None = None,
    component: int = 1,
    *,
    derived: bool = True,
    settings: ConsolidationSettings | None = None,
) -> int:
    with store.transaction():
        chunk_id = store.chunks.add(1, result)
        store.chunks.place({chunk_id: pose or Sim3.identity()}, {chunk_id: component})
        if derived:
            consolidate(store, chunk_id, settings)
    return chunk_id


def end(store: Store, settings: ConsolidationSettings | None = None) -> ConsolidationReport:
    with store.transaction():
        return consolidate(store, settings=settings)


def tables(store: Store) -> dict[str, list[tuple[object, ...]]]:
    """All that consolidation writes."""
    of = {"instances": "id", "observations": "1, 2", "relations": "1, 2, 3", "embeddings": "1, 2", "aliases": "id"}
    of |= {"events": "1, 2", "instance_boxes": "id"}
    return {name: store.connection.rows(f"SELECT * FROM {name} ORDER BY {order}") for name, order in of.items()}


def check(store: Store, settings: ConsolidationSettings | None = None) -> None:
    """Derived again, and again without what is kept of overlaps, it is the same."""
    before = tables(store)
    for cleared in (False, True):
        with store.transaction():
            if cleared:
                store.pair_scores.clear()
            report = consolidate(store, settings=settings)
            assert report.new == () and report.merged == ()
        assert tables(store) == before
    assert store.verify() == []


def said(store: Store) -> object:
    """What a memory says, whatever numbers its instances have."""
    keys = {i.id: tuple((o.chunk_id, o.local_id) for o in store.observations.of(i.id)) for i in store.instances.all()}
    told = [dataclasses.replace(i, id=0) for i in store.instances.all()]
    return (
        sorted((keys[i.id], repr(t)) for i, t in zip(store.instances.all(), told, strict=True)),
        sorted((keys[r.subject], r.predicate, keys[r.object], r.confidence, r.margin) for r in store.relations.all()),
    )


class _Undone(Exception):
    """What is only looked at."""


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_chunk_by_chunk_and_all_at_once_are_one_library(walks: ModuleType, tmp_path: Path, order: str) -> None:
    found = []
    for name, derived in (("stream", True), ("batch", False)):
        with Store.create(tmp_path / f"{name}.l3r") as store:
            begin(store)
            for index, place in enumerate(ORDERS[order]):
                add(store, visit(walks, index, place), derived=derived)
            end(store)
            check(store)
            found.append(said(store))
    assert found[0] == found[1]


@pytest.mark.slow
def test_where_chunks_have_lain_before_does_not_matter(walks: ModuleType, store: Store) -> None:
    for index, place in enumerate(ORDERS["there and back"]):
        add(store, visit(walks, index, place))
    end(store)
    before = said(store)
    for off in (0.001, 0.03, 0.4, 0.0):
        with store.transaction():
            store.chunks.place({4: Sim3.exp(np.array([off, off, 0, 0, 0, 0.1 * off, 0]))}, {4: 1})
        end(store)
        assert (said(store) == before) == (off == 0.0)
        check(store)


def test_chunks_that_tremble_keep_their_overlaps(walks: ModuleType, store: Store) -> None:
    for index in range(4):
        add(store, visit(walks, index, index))
    kept = store.connection.rows("SELECT * FROM pair_scores ORDER BY u, v")
    boxes = {i.id: i.aabb for i in store.instances.all()}
    off = np.array([0.001, 0.0015, 0.0])
    with store.transaction():
        there = Sim3.exp(np.array([*off, 0, 0, 0, 0]))
        store.chunks.place(dict.fromkeys((1, 2, 3, 4), there), dict.fromkeys((1, 2, 3, 4), 1))
    end(store)
    assert store.connection.rows("SELECT * FROM pair_scores ORDER BY u, v") == kept
    for i in store.instances.all():
        assert np.allclose(i.aabb, boxes[i.id] + off, atol=1e-9)
    with store.transaction():
        store.chunks.place({2: Sim3.exp(np.array([0.02, 0, 0, 0, 0, 0, 0]))}, {2: 1})
    end(store)
    now = {row[:2]: row[2] for row in store.connection.rows("SELECT * FROM pair_scores")}
    turned = {(u, v) for u, v, stamp, _ in kept if now[u, v] != stamp}
    assert turned == {(u, v) for u, v, _, _ in kept if (u == 2) != (v == 2)}


def test_nothing_is_written_where_nothing_is_otherwise(walks: ModuleType, store: Store) -> None:
    for index in range(10):
        add(store, visit(walks, index, index))
    end(store)
    rows, touched = store.connection._database.total_changes(), store.embeddings.changes()
    end(store)
    assert store.connection._database.total_changes() - rows <= 6 and store.embeddings.changes() == touched


@pytest.mark.slow
@pytest.mark.parametrize("order", [[*range(12)], ORDERS["there and back"]], ids=["rooms", "there and back"])
def test_labels_that_grow_are_those_of_all_votes(store: Store, walks: ModuleType, order: list[int]) -> None:
    names, local = ("cup", "chair", "book"), 0
    for index, place in enumerate(order):
        made = visit(walks, index, place)
        with store.transaction():
            chunk_id = store.chunks.add(1, made)
            store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
            told = {
                n.local_id: Votes(1.0, {names[(place + n.local_id) % 3]: (8.0, 40.0)}, 8.0)
                for n in made.library.instances
                if (index + n.local_id) % 3
            }
            put_votes(store, chunk_id, "net", told)
            report = consolidate(store, chunk_id)
            local += report.written is not None
            apply_labels(store, written=report.written)
        grown = {i.id: i.label for i in store.instances.all()}, store.detected_labels.all()
        with store.transaction():
            assert apply_labels(store).keys() == grown[1].keys()
        assert ({i.id: i.label for i in store.instances.all()}, store.detected_labels.all()) == grown
    assert local >= 2 and set(grown[0].values()) == {None, "book", "chair"}


def test_what_comes_between_is_attached_and_what_is_new_is_listed(walks: ModuleType, store: Store) -> None:
    for index in range(10):
        add(store, visit(walks, index, index))
    assert store.facts[WORLD].chunks == 10
    before, geometry = {i.id: i for i in store.instances.all()}, "SELECT id, geometry FROM instances"
    rows = dict(store.connection.rows(geometry))
    seen = add(store, visit(walks, 10, 10))
    assert store.facts[WORLD].chunks == 10
    owners = {(o.chunk_id, o.local_id): o.instance_id for o in store.observations.all()}
    of_new = {n: owner for (k, n), owner in owners.items() if k == seen}
    again, fresh = set(of_new.values()) & before.keys(), set(of_new.values()) - before.keys()
    assert len(of_new) == 13 and len(again) >= 6 and len(fresh) >= 6
    assert {i.observations for i in store.instances.of(sorted(again))} != {before[n].observations for n in again}
    now = dict(store.connection.rows(geometry))
    assert all(now[n] == there for n, there in rows.items())
    end(store)
    assert {n: o.instance_id for o in store.observations.all() if o.chunk_id == seen for n in [o.local_id]} == of_new


@pytest.mark.slow
def test_what_operators_parted_or_deleted_is_not_attached(walks: ModuleType, store: Store) -> None:
    for index in range(10):
        add(store, visit(walks, index, index % 2, "corridor"))
    thing = next(i.id for i in store.instances.all(structure=False) if len(store.observations.of(i.id)) == 10)
    edits.delete(store, thing, "somebody")
    things = {i.id for i in store.instances.all()}
    add(store, visit(walks, 10, 0, "corridor"))
    assert {i.id for i in store.instances.all()} == things and store.facts[WORLD].chunks == 10


def test_a_new_chunk_is_compared_with_few_that_saw_the_place(
    walks: ModuleType, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attaching, "_COMPARED", 2)
    for index in range(10):
        add(store, visit(walks, index, index % 2, "corridor"))
    pairs = len(store.pair_scores.pairs())
    add(store, visit(walks, 10, 0, "corridor"))
    assert len(store.pair_scores.pairs()) == pairs + 3
    assert len(store.observations.all()) == 11 * 13


@pytest.mark.slow
def test_relations_found_place_by_place_are_those_found_at_once(
    walks: ModuleType, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index, place in enumerate(ORDERS["there and back"]):
        add(store, visit(walks, index, place))
    end(store)
    found = tables(store)["relations"]
    for most in (1, 5):
        monkeypatch.setattr(relating, "_TOGETHER", most)
        end(store)
        assert tables(store)["relations"] == found
    assert len(found) > 20


@pytest.mark.slow
def test_little_is_kept_between_chunks_and_what_is_not_is_read_again(
    walks: ModuleType, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(summaries, "_KEPT_BYTES", 1)
    monkeypatch.setattr(voxels, "_KEPT_BYTES", 1)
    for index, place in enumerate((0, 1, 2, 3, 1)):
        add(store, visit(walks, index, place))
        assert len(store.derived.of(summaries.SummaryCache)) == 1
    monkeypatch.undo()
    check(store)


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 3])
def test_a_memory_that_was_closed_grows_on(walks: ModuleType, tmp_path: Path, every: int) -> None:
    found = []
    for name, again in (("one.l3r", False), ("two.l3r", True)):
        store = Store.create(tmp_path / name)
        begin(store)
        for index, place in enumerate(ORDERS["there and back"]):
            add(store, visit(walks, index, place), derived=index % every == every - 1)
            if again:
                store.close()
                store = Store.open(tmp_path / name, writable=True)
        found.append(tables(store))
        store.close()
    assert found[0] == found[1]


@pytest.mark.slow
@pytest.mark.parametrize("chunks", [4, 10])
def test_a_chunk_that_was_taken_back_leaves_no_trace(walks: ModuleType, store: Store, chunks: int) -> None:
    for index in range(chunks):
        add(store, visit(walks, index, index))
    before = tables(store)
    with pytest.raises(_Undone), store.transaction():
        chunk_id = store.chunks.add(1, visit(walks, chunks, 1))
        store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
        consolidate(store, chunk_id)
        raise _Undone
    assert tables(store) == before
    add(store, visit(walks, chunks, chunks))
    end(store)
    check(store)


# ---------------------------------------------------------------------------------------------- what adds nothing

STAY = [0, 1, 0, 1, 0, 1, 0, 1, 2, 1]


@pytest.mark.slow
def test_what_redundant_chunks_saw_belongs_to_the_instances_that_are_derived_without_them(
    walks: ModuleType, tmp_path: Path
) -> None:
    keep = ConsolidationSettings(redundancy=RedundancySettings(chunks=0))
    with Store.create(tmp_path / "cull.l3r") as store, Store.create(tmp_path / "keep.l3r") as every:
        for one, settings in ((store, CULL), (every, keep)):
            begin(one)
            for index, place in enumerate(STAY):
                add(one, visit(walks, index, place, "corridor"), settings=settings)
            end(one, settings)
        assert [k for k in range(1, 11) if (k, k) in store.pair_scores.pairs()] == [1, 2, 3, 4, 9]
        assert len(store.pair_scores.pairs()) < len(every.pair_scores.pairs())
        things, others = store.instances.all(structure=False), every.instances.all(structure=False)
        for a, b in zip(things, others, strict=True):
            assert store.observations.of(a.id) == every.observations.of(b.id)
            assert (a.id, a.observations, a.last_seen_s) == (b.id, b.observations, b.last_seen_s)
            assert np.allclose(a.aabb, b.aabb, atol=0.05)
        check(store, CULL)


def test_redundant_chunks_follow_edits_and_moves(
    walks: ModuleType, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(consolidation, "settings_of", lambda store, settings: CULL)
    for index, place in enumerate([0, 1, 0, 1, 0, 1]):
        add(store, visit(walks, index, place, "corridor"))
    things = [i.id for i in store.instances.all(structure=False) if len(store.observations.of(i.id)) == 6]
    both = {(o.chunk_id, o.local_id) for i in things[:2] for o in store.observations.of(i)}
    edits.merge(store, things[0], things[1], "somebody")
    assert {(o.chunk_id, o.local_id) for o in store.observations.of(things[0])} == both
    assert (5, 5) not in store.pair_scores.pairs()
    leaving = next(o for o in store.observations.of(things[2]) if o.chunk_id == 5)
    edits.split(store, things[2], [(5, leaving.local_id)], "somebody")
    assert {o.chunk_id for o in store.observations.of(things[2])} == {1, 2, 3, 4, 6}
    assert (5, 5) in store.pair_scores.pairs()
    with store.transaction():
        store.chunks.place({6: Sim3.exp(np.array([0.0, 40.0, 0.0, 0, 0, 0, 0]))}, {6: 1})
    end(store)
    owners = {k: {o.instance_id for o in store.observations.all() if o.chunk_id == k} for k in (1, 6)}
    assert len(owners[6]) >= 12 and owners[6] & owners[1] == {things[0], things[2]}
    check(store)


def test_what_is_new_in_a_place_that_was_seen_often_is_found(walks: ModuleType, store: Store) -> None:
    for index in range(8):
        made = visit(walks, index, 0, "corridor")
        if index >= 4:
            rng, count = np.random.default_rng([3, index]), len(made.library.instances)
            thing = walks.make_object(count, 14, 1, np.zeros(3), made.frame_indices, rng)
            library = dataclasses.replace(made.library, instances=(*made.library.instances, thing))
            made = dataclasses.replace(made, library=library)
        add(store, made, settings=CULL)
    fresh = store.observations.owners([(5, 13)])[5, 13]
    assert [(o.chunk_id, o.local_id) for o in store.observations.of(fresh)] == [(k, 13) for k in (5, 6, 7, 8)]
    frames = {f for k in range(4, 8) for f in range(walks.HOP * k, walks.HOP * k + walks.FRAMES)}
    assert store.instances.get(fresh).observations == len(frames)


# ---------------------------------------------------------------------------------------------- what is derived


def test_chunks_that_give_a_place_to_several_others_make_an_instance_less_sure(store: Store) -> None:
    from tests.test_consolidation import BOX, Piece, chunk

    plate = Piece("plate", (3.0, 0.0, 0.72), (0.4, 0.3, 0.01))
    boards = [Piece(f"board {x}", (x, 0.0, 0.72), (0.13, 1.8, 0.01), points=3000) for x in (2.865, 3.0, 3.135)]
    for index in range(8):
        add(store, chunk(index, [BOX], drift=0.0))
    add(store, chunk(8, [plate], drift=0.0))
    told = [store.instances.get(2).confidence]
    for index in (9, 10):
        beside = add(store, chunk(index, boards, drift=0.0))
        end(store)
        told.append(store.instances.get(2).confidence)
    with store.transaction():
        store.chunks.place({beside: Sim3(1.0, np.eye(3), np.array([0.0, 0.0, 5.0]))}, {beside: 1})
        consolidate(store)
    told.append(store.instances.get(2).confidence)
    assert told[0] > told[1] > told[2] and told[3] == told[1]


def test_one_floor_goes_on_under_another_id_after_a_while(walks: ModuleType, store: Store) -> None:
    for index in range(8):
        add(store, visit(walks, index, index, "corridor"))
    end(store)
    floors = store.instances.all(structure=True)
    assert len(floors) > 1
    assert all(np.ptp(i.aabb, axis=0).max() <= 20.0 for i in floors)


@pytest.mark.slow
def test_a_part_that_is_joined_to_another_is_merged_with_it(walks: ModuleType, store: Store) -> None:
    far = Sim3.exp(np.array([3.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    for index, place in enumerate((0, 1, 2, 3)):
        add(store, visit(walks, index, place))
    add(store, visit(walks, 4, 1), far, component=5)
    check(store)
    assert {i.component for i in store.instances.all()} == {1, 5}
    with store.transaction():
        store.chunks.place({5: Sim3.identity()}, {5: 1})
        consolidate(store)
    check(store)
    assert {i.component for i in store.instances.all()} == {1} and len(store.ids.aliases()) >= 12


@pytest.mark.slow
def test_the_word_of_operators_holds_while_the_library_grows(walks: ModuleType, store: Store) -> None:
    for index, place in enumerate((0, 1, 2)):
        add(store, visit(walks, index, place))
    things = [i.id for i in store.instances.all(structure=False) if len(store.observations.of(i.id)) > 1]
    edits.merge(store, things[0], things[1], "somebody")
    entry = edits.split(store, things[2], author="somebody").entry
    edits.label(store, things[3], "cup", "somebody")
    edits.delete(store, things[4], "somebody")
    edits.label(store, 1, "first", "somebody")
    for index, place in enumerate((1, 0, 3), start=3):
        add(store, visit(walks, index, place))
        check(store)
    assert store.instances.get(things[3]).label == "cup" and store.ids.resolve(things[1]) == things[0]
    edits.undo(store, entry, "somebody")
    add(store, visit(walks, 6, 1))
    check(store)


def test_features_of_several_spaces_are_not_compared(walks: ModuleType, store: Store) -> None:
    for index in range(3):
        add(store, visit(walks, index, index))
    other = visit(walks, 3, 1)
    add(store, dataclasses.replace(other, library=dataclasses.replace(other.library, feature_space="other@1/64")))
    assert store.facts[WORLD].space == ""
    add(store, visit(walks, 4, 2))
    check(store)


def test_what_moves_is_followed_as_chunks_come(tmp_path: Path) -> None:
    """A person passes, pauses and comes back among things that stay; one chunk is only later found to move."""
    from tests.test_dynamic import FRAMES, STEP, across, chunk, memory, walker

    def back(k: int) -> tuple[float, float, float]:
        return 1.2, 1.6 - 0.02 * k, 0.85

    steps = [chunk(k, [walker(2, STEP * k, across if k < 3 else back, seed=k)] if k != 4 else []) for k in range(7)]
    store = memory(tmp_path / "m.l3r", steps[:2])
    for k, result in enumerate(steps[2:], start=2):
        with store.transaction():
            chunk_id = store.chunks.add(1, result)  # type: ignore[arg-type]
            store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
            consolidate(store, chunk_id)
        check(store)
        assert any(i.dynamic for i in store.instances.all()) and FRAMES > 0, k
    with store.transaction():
        store.local_instances.flag_dynamic(3, {0: None})
        consolidate(store)
    check(store)
    store.close()


def test_a_chunk_whose_features_have_another_length_is_merged_by_its_surfaces(walks: ModuleType, store: Store) -> None:
    for index in range(3):
        add(store, visit(walks, index, index))
    before = len(store.instances.all())
    other = visit(walks, 3, 1)
    shorter = tuple(dataclasses.replace(n, feature=n.feature[:16]) for n in other.library.instances)
    add(store, dataclasses.replace(other, library=LocalLibrary(shorter, other.library.cannot_link, "other@1/16")))
    add(store, visit(walks, 4, 2))
    assert len(store.instances.all()) == before
    check(store)


def test_a_metric_memory_knows_its_metre_however_scales_are_rounded(walks: ModuleType, store: Store) -> None:
    add(store, visit(walks, 0, 0))
    rounded = Sim3(np.nextafter(1.0, 0.0), np.eye(3), np.zeros(3))
    chunks = [dataclasses.replace(c, S_world_chunk=rounded) for c in store.chunks.all()]
    assert is_known(chunks, {}) and world_unit(chunks, {}) == 1.0
    shrunk = [dataclasses.replace(c, S_world_chunk=Sim3(np.asarray(0.98), np.eye(3), np.zeros(3))) for c in chunks]
    assert not is_known(shrunk, {})
