"""A library that grows is the library that is derived as a whole, and a chunk touches nothing that is far away."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from list3r.memory.description.colors import Reference
from list3r.memory.geometry import Sim3
from list3r.memory.library import instances as library_things
from list3r.memory.library import writing as library_writing
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import apply_labels, put_votes
from list3r.memory.library.rules import WORLD, ConsolidationSettings
from list3r.memory.maintenance import edits
from list3r.memory.overlap import summaries
from list3r.memory.records import ChunkResult, FrameSamples, LocalLibrary, Votes
from list3r.memory.store.store import Store

GROW = ConsolidationSettings(whole_chunks=0)
ORDERS = {
    "rooms": [0, 1, 2, 3, 4, 5, 6, 7],
    "there and back": [0, 1, 2, 3, 2, 1, 0, 1],
    "one room": [0, 1, 0, 1, 0, 1, 0],
    "jumps": [0, 5, 1, 4, 2, 3],
}


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
    store: Store, result: ChunkResult, pose: Sim3 | None = None, component: int = 1, *, derived: bool = True
) -> int:
    with store.transaction():
        chunk_id = store.chunks.add(1, result)
        store.chunks.place({chunk_id: pose or Sim3.identity()}, {chunk_id: component})
        if derived:
            consolidate(store, chunk_id, GROW)
    return chunk_id


@pytest.mark.parametrize("order", [[*range(10)], [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]], ids=["rooms", "there and back"])
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
            report = consolidate(store, chunk_id, GROW)
            local += report.written is not None
            apply_labels(store, written=report.written)
        grown = {i.id: i.label for i in store.instances.all()}, store.detected_labels.all()
        with store.transaction():
            assert apply_labels(store).keys() == grown[1].keys()
        assert ({i.id: i.label for i in store.instances.all()}, store.detected_labels.all()) == grown
    assert local >= 3 and set(grown[0].values()) == {None, "book", "chair"}


def tables(store: Store) -> dict[str, list[tuple[object, ...]]]:
    """All that consolidation writes, but for words on colours, whose light may lag behind a little."""
    columns = "id, label, confidence, observations, first_seen_s, last_seen_s, state, structure, component, view_frame"
    return {
        "instances": store.connection.rows(f"SELECT {columns} FROM instances ORDER BY id"),
        "members": store.connection.rows("SELECT * FROM members ORDER BY chunk_id, local_id"),
        "observations": store.connection.rows("SELECT * FROM observations ORDER BY chunk_id, local_id"),
        "relations": store.connection.rows("SELECT * FROM relations ORDER BY subject, predicate, object"),
        "embeddings": store.connection.rows("SELECT instance, space, vector FROM embeddings ORDER BY instance"),
        "dropped": store.connection.rows("SELECT chunk_id, dropped FROM settled ORDER BY chunk_id"),
        "overlaps": store.connection.rows("SELECT * FROM overlaps ORDER BY u, v"),
        "aliases": store.connection.rows("SELECT * FROM aliases ORDER BY id"),
    }


class _Undone(Exception):
    """What was derived as a whole is only looked at."""


def check(store: Store, *names: str) -> None:
    """What has grown is what is derived as a whole, ids and all; only some tables where they are named."""
    grown, boxes = tables(store), [i.aabb for i in store.instances.all()]
    with pytest.raises(_Undone), store.transaction():
        store.library.forget()
        report = consolidate(store, settings=GROW)
        whole, others = tables(store), [i.aabb for i in store.instances.all()]
        raise _Undone
    assert report.new == () and report.merged == ()
    for name, rows in whole.items():
        assert grown[name] == rows or (names and name not in names), name
    assert names or np.allclose(boxes, others, atol=1e-9)
    assert store.verify() == []


@pytest.mark.parametrize("order", ORDERS)
def test_a_grown_library_is_the_one_derived_as_a_whole(walks: ModuleType, store: Store, order: str) -> None:
    for index, place in enumerate(ORDERS[order]):
        add(store, visit(walks, index, place))
    check(store)


def test_chunks_that_are_derived_together_are_derived_as_a_whole(walks: ModuleType, store: Store) -> None:
    for index, place in enumerate(ORDERS["there and back"]):
        add(store, visit(walks, index, place), derived=index % 3 == 1)
    check(store)


def test_what_neighbours_of_computed_depth_miss_grows_alike(walks: ModuleType, store: Store) -> None:
    with store.transaction():
        store.facts.scale_kind = "relative"
    hidden = 0
    for index in range(7):
        made = visit(walks, index, index % 2)
        first = made.frame_indices[0]
        frames = np.arange(walks.FRAMES) + index * (walks.FRAMES - 20)
        move = frames[0] - first
        kept = tuple(
            dataclasses.replace(i, track=dataclasses.replace(i.track, frames=i.track.frames + move))
            for n, i in enumerate(made.library.instances)
            if (n + index) % 3
        )
        renumbered = tuple(dataclasses.replace(i, local_id=n) for n, i in enumerate(kept))
        library = dataclasses.replace(made.library, instances=renumbered, cannot_link=np.zeros((0, 2), np.int32))
        things = len(made.library.instances)
        owner = np.full(things, -1, np.int32)
        owner[[n for n in range(things) if (n + index) % 3]] = np.arange(len(kept))
        samples = FrameSamples(
            frame=np.repeat(frames, things),
            pixel=np.tile(np.arange(things, dtype=np.int32), len(frames)),
            points=np.zeros((len(frames) * things, 3), np.float32),
            confidence=np.ones(len(frames) * things, np.float32),
            instance=np.tile(owner, len(frames)),
            camera_frames=frames,
            T_chunk_cam=made.T_chunk_cam,
        )
        keyframes = tuple(dataclasses.replace(k, frame_index=int(k.frame_index + move)) for k in made.keyframes)
        made = dataclasses.replace(made, frame_indices=frames, library=library, samples=samples, keyframes=keyframes)
        add(store, dataclasses.replace(made, scale_kind="relative"))
        check(store, "instances", "members", "observations")
        hidden = max(hidden, store.library.members.hidden_groups())
    assert hidden > 0


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
        told.append(store.instances.get(2).confidence)
        check(store)
    with store.transaction():
        store.chunks.place({beside: Sim3(1.0, np.eye(3), np.array([0.0, 0.0, 5.0]))}, {beside: 1})
        consolidate(store, beside, GROW)
    told.append(store.instances.get(2).confidence)
    check(store)
    assert told[0] > told[1] > told[2] and told[3] == told[1]


def test_one_floor_goes_on_under_another_id_after_a_while(walks: ModuleType, store: Store) -> None:
    for index in range(8):
        add(store, visit(walks, index, index, "corridor"))
    check(store)
    floors = store.instances.all(structure=True)
    assert len(floors) > 1
    assert all(np.ptp(i.aabb, axis=0).max() <= 20.0 for i in floors)


def test_relations_found_place_by_place_are_those_found_at_once(
    walks: ModuleType, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index, place in enumerate(ORDERS["there and back"]):
        add(store, visit(walks, index, place))
    found = tables(store)["relations"]
    for most in (1, 5):
        monkeypatch.setattr(library_writing, "_TOGETHER", most)
        with pytest.raises(_Undone), store.transaction():
            store.library.forget()
            consolidate(store, settings=GROW)
            assert tables(store)["relations"] == found
            raise _Undone
    assert len(found) > 20


def test_chunks_that_a_loop_closure_moves_are_followed(walks: ModuleType, store: Store) -> None:
    for index, place in enumerate(ORDERS["there and back"]):
        add(store, visit(walks, index, place))
    for off in (0.03, 0.4, 0.0):
        with store.transaction():
            store.chunks.place({4: Sim3.exp(np.array([off, off, 0, 0, 0, 0.1 * off, 0]))}, {4: 1})
            consolidate(store, settings=GROW)
        check(store)


def test_overlaps_are_measured_anew_when_most_chunks_move(walks: ModuleType, store: Store) -> None:
    for index, place in enumerate(ORDERS["there and back"]):
        add(store, visit(walks, index, place))
    with store.transaction():
        for k in range(2, 8):
            store.chunks.place({k: Sim3.exp(np.array([0.01 * k, 0.0, 0.02, 0, 0, 0.002 * k, 0]))}, {k: 1})
        assert consolidate(store, settings=GROW).written is None
    check(store)


def test_things_of_chunks_that_trembled_lie_where_the_chunks_lie_when_a_session_ends(
    walks: ModuleType, store: Store
) -> None:
    for index in range(5):
        add(store, visit(walks, index, index))
    before = {i.id: i.aabb for i in store.instances.all()}
    own = {n for some in store.library.anchors.all() for n, a in some.items() if a.chunk_id == 2}
    off = np.array([0.001, 0.0015, 0.0])
    with store.transaction():
        store.chunks.place({2: Sim3.exp(np.array([*off, 0, 0, 0, 0]))}, {2: 1})
        consolidate(store, 2, GROW)
        assert consolidate(store, settings=GROW).new == ()
    for i in store.instances.all():
        assert np.allclose(i.aabb, before[i.id] + (off if i.id in own else 0.0), atol=1e-9)
    assert own and store.verify() == []


def test_in_another_light_only_the_words_are_others(walks: ModuleType, store: Store) -> None:
    for index, place in enumerate(ORDERS["there and back"]):
        add(store, visit(walks, index, place))
    words = [(i.description, i.color_name, i.color_rgb) for i in store.instances.all()]
    with store.transaction():
        world = store.facts[WORLD]
        assert world is not None
        store.facts[WORLD] = dataclasses.replace(world, chunks=4, light=Reference(40.0, (6.0, 6.0)))
        store.instances.put(dataclasses.replace(i, description="lit otherwise") for i in store.instances.all())
        assert consolidate(store, settings=GROW).written == frozenset()
    assert [(i.description, i.color_name, i.color_rgb) for i in store.instances.all()] == words
    check(store)


def test_a_part_that_is_joined_to_another_is_merged_with_it(walks: ModuleType, store: Store) -> None:
    far = Sim3.exp(np.array([3.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    for index, place in enumerate((0, 1, 2, 3)):
        add(store, visit(walks, index, place))
    add(store, visit(walks, 4, 1), far, component=5)
    check(store)
    assert {i.component for i in store.instances.all()} == {1, 5}
    with store.transaction():
        store.chunks.place({5: Sim3.identity()}, {5: 1})
        consolidate(store, settings=GROW)
    check(store)
    assert {i.component for i in store.instances.all()} == {1} and len(store.ids.aliases()) >= 12


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


def test_little_is_kept_between_chunks_and_what_is_not_is_read_again(
    walks: ModuleType, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(summaries, "_KEPT_BYTES", 1)
    monkeypatch.setattr(library_things, "_KEPT_BYTES", 20 * 4096)
    for index, place in enumerate((0, 1, 2, 3, 1)):
        add(store, visit(walks, index, place))
        assert len(store.derived.of(summaries.SummaryCache)) == 1
        assert len(store.derived.of(library_things.InstanceCache)) <= 20
    check(store)


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


def test_a_chunk_that_was_taken_back_leaves_no_trace(walks: ModuleType, store: Store) -> None:
    for index in range(4):
        add(store, visit(walks, index, index))
    before = tables(store)
    with pytest.raises(_Undone), store.transaction():
        chunk_id = store.chunks.add(1, visit(walks, 4, 1))
        store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
        consolidate(store, chunk_id, GROW)
        raise _Undone
    assert tables(store) == before
    add(store, visit(walks, 4, 4))
    check(store)


def rows_of(store: Store, keep: Callable[[int], bool]) -> dict[str, list[tuple[object, ...]]]:
    """Whole rows of some instances and of what hangs on them."""
    return {
        "instances": [r for r in store.connection.rows("SELECT * FROM instances ORDER BY id") if keep(r[0])],
        "boxes": [r for r in store.connection.rows("SELECT * FROM instance_boxes ORDER BY id") if keep(r[0])],
        "relations": [
            r for r in store.connection.rows("SELECT * FROM relations ORDER BY 1, 2, 3") if keep(r[0]) and keep(r[2])
        ],
        "embeddings": [
            r
            for r in store.connection.rows("SELECT instance, space, vector FROM embeddings ORDER BY instance")
            if keep(r[0])
        ],
    }


def test_a_chunk_changes_no_row_of_what_is_far_away(walks: ModuleType, store: Store) -> None:
    for index in range(9):
        add(store, visit(walks, index, index))
    reach = float(
        min(i.aabb[0, 0] for i in store.instances.all() if {o.chunk_id for o in store.observations.of(i.id)} & {9})
    )
    far = {i.id for i in store.instances.all() if i.aabb[1, 0] < reach - 6.0}
    assert len(far) > 20
    before = rows_of(store, far.__contains__)
    rows = {row[0]: row for row in store.connection.rows("SELECT * FROM instances")}
    add(store, visit(walks, 9, 9))
    assert rows_of(store, far.__contains__) == before
    now = {row[0]: row for row in store.connection.rows("SELECT * FROM instances")}
    assert all(now[n] == row for n, row in rows.items() if n in far)


def test_as_much_is_written_for_a_late_chunk_as_for_an_early_one(walks: ModuleType, store: Store) -> None:
    counts = []
    for index in range(16):
        before, rows = store.embeddings.changes(), store.connection._database.total_changes()
        add(store, visit(walks, index, index))
        written = sum(len(store.embeddings.changed(space, before)[0]) for space in store.embeddings.spaces())
        counts.append((written, store.connection._database.total_changes() - rows))
    assert {c for c, _ in counts[6:]} <= {counts[6][0], counts[7][0]}
    assert max(r for _, r in counts[12:]) <= 1.3 * max(r for _, r in counts[6:8])


def test_a_chunk_with_another_feature_space_makes_all_be_derived_anew(walks: ModuleType, store: Store) -> None:
    for index in range(3):
        add(store, visit(walks, index, index))
    other = visit(walks, 3, 1)
    add(store, dataclasses.replace(other, library=dataclasses.replace(other.library, feature_space="other@1/64")))
    assert store.facts[WORLD].space == ""
    add(store, visit(walks, 4, 2))
    check(store)


def test_what_moves_is_followed_while_the_library_grows(tmp_path: Path) -> None:
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
            consolidate(store, chunk_id, GROW)
        check(store)
        assert any(i.dynamic for i in store.instances.all()) and FRAMES > 0, k
    with store.transaction():
        store.local_instances.flag_dynamic(3, {0: None})
        consolidate(store, settings=GROW)
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
