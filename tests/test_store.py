"""One test for each verb of the store."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.errors import MemoryFileError, UnknownIdError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, MergeDecision, Observation
from list3r.memory.store.store import Store
from tests.conftest import SMALL_ROOM, chunk_result, local_instance

Make = Callable[..., Path]


def test_a_memory_reads_back_what_was_written(make_memory: Make) -> None:
    with Store.open(make_memory()) as store:
        assert [i.description for i in store.instances.all()] == [row[0] for row in SMALL_ROOM]
        assert [i.id for i in store.instances.all(structure=False)] == [2, 3, 4, 5]
        mug = store.instances.get(3)
        assert np.allclose(mug.center, SMALL_ROOM[2][1])
        assert mug.color_rgb == (240, 240, 240)
        assert mug.best_view is not None and mug.best_view.box_xyxy == (10, 20, 30, 30)
        assert store.sessions.all()[0].state == "complete"
        assert store.facts.gravity == "estimated"
        assert [(r.subject, r.object) for r in store.relations.all(predicate="on")] == [(2, 1), (3, 2), (4, 2)]


def test_one_file_is_left_after_closing(make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_supports_come_back_to_half_a_quantisation_step_and_move_with_their_chunk(make_memory: Make) -> None:
    with Store.open(make_memory(), writable=True) as store:
        before = store.surfaces.of(2)
        lower, upper = before.points.min(axis=0), before.points.max(axis=0)
        assert np.allclose((lower + upper) / 2, SMALL_ROOM[1][1], atol=0.02)
        chunk = store.chunks.all()[0].chunk_id
        moved = Sim3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.0])
        with store.transaction():
            store.chunks.place({chunk: moved}, {chunk: chunk})
        assert np.allclose(store.surfaces.of(2).points, moved.apply(before.points), atol=1e-5)


def test_a_broken_transaction_leaves_nothing(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store:
        with pytest.raises(RuntimeError), store.transaction():
            store.instances.drop(3, None)
            raise RuntimeError
        assert len(store.instances.all()) == len(SMALL_ROOM)


def test_an_alias_resolves_for_ever(make_memory: Make) -> None:
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.instances.drop(4, alias_of=3)
            store.instances.drop(3, alias_of=2)
        assert store.ids.resolve(4) == 2
        assert store.instances.get(4).id == 2
        with pytest.raises(UnknownIdError, match="no instance 99"):
            store.ids.resolve(99)
        assert store.ids.next() == len(SMALL_ROOM) + 1


def test_the_later_chunk_places_the_second_half_of_the_shared_frames(make_memory: Make) -> None:
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            second = store.chunks.add(1, chunk_result(1, 10, 20, ()))
        owners = {f.frame_index: f.chunk_id for f in store.frames.all()}
        assert [k for k, v in owners.items() if v == second] == list(range(15, 30))


def test_frames_that_one_chunk_lost_are_placed_by_the_other(make_memory: Make) -> None:
    result = chunk_result(1, 10, 20, ())
    result.posed[:8] = False
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.chunks.add(1, result)
        frames = store.frames.all()
        assert all(f.state == "posed" for f in frames)
        assert frames[17].chunk_id == 1


def test_edges_decisions_links_and_vectors_round_trip(make_memory: Make) -> None:
    edge = Edge(
        1, 2, "loop", Sim3.exp(np.arange(7) / 10), 0.7, 1.0, 40, 0.004, True, "40 inliers", {"cosine": 0.8}, (3, 90)
    )
    with Store.open(make_memory(), writable=True) as store:
        with store.transaction():
            store.chunks.add(
                1, chunk_result(1, 10, 20, (local_instance(0, np.ones((5, 3), np.float32), (1, 2, 3), np.arange(3)),))
            )
            store.edges.add([edge])
            store.merges.add_all(2, [MergeDecision("merge", "1:0", "2:0", {"iou": 0.5}, "overlap")])
            store.observations.set([Observation(2, 2, 0)])
        back = store.edges.all()[0]
        assert np.array_equal(back.S_v_u.as_matrix(), edge.S_v_u.as_matrix())
        assert (back.reason, back.scores, back.frames, back.accepted) == (edge.reason, edge.scores, edge.frames, True)
        assert store.merges.decisions()[0].scores == {"iou": 0.5}
        assert [(o.chunk_id, o.local_id) for o in store.observations.of(2)] == [(1, 1), (2, 0)]
        keys, descriptors = store.keyframes.descriptors()
        assert keys.tolist() == [[1, 0], [2, 10]]
        assert descriptors.shape == (2, 8)
        assert store.keyframes.of(1)[0].camera_small == (8.0, 8.0, 4.0, 3.0)
        ids, vectors = store.embeddings.all("test@1/16")
        assert len(ids) == len(vectors) == len(SMALL_ROOM)
        assert store.local_instances.mask_track(1, 0).image_size == (48, 64)
        assert [n.local_id for n in store.local_instances.nodes([1])] == list(range(len(SMALL_ROOM)))


def test_the_rtree_finds_boxes(make_memory: Make) -> None:
    with Store.open(make_memory()) as store:
        assert store.instances.ids_in_box([1.7, 0.0, 0.7], [1.9, 0.2, 0.9]) == [2, 3]


def test_verify_finds_a_flipped_byte_and_a_dangling_row(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path) as store:
        assert store.verify() == []
    with sqlite3.connect(path) as database:
        blob = bytearray(database.execute("SELECT points FROM supports WHERE local_id = 2").fetchone()[0])
        blob[7] ^= 255
        database.execute("UPDATE supports SET points = ? WHERE local_id = 2", (bytes(blob),))
        database.execute("INSERT INTO observations VALUES (1, 77, 1234)")
    with Store.open(path) as store:
        found = "\n".join(store.verify())
    assert "supports: page" in found
    assert "observations: a row points to one of instances" in found


def test_files_that_are_not_ours_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("hello")
    with sqlite3.connect(tmp_path / "other.db") as database:
        database.execute("CREATE TABLE t (x)")
    for name, message in (
        ("text", "not a memory"),
        ("other.db", "not a LIST3R"),
        ("absent", "does not exist"),
        (".", "folder"),
    ):
        with pytest.raises(MemoryFileError, match=message):
            Store.open(tmp_path / name)


def test_a_newer_schema_is_refused_with_its_version(make_memory: Make) -> None:
    path = make_memory()
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA user_version = 99")
    with pytest.raises(MemoryFileError, match=r"newer list3r \(schema 99"):
        Store.open(path)


def test_a_second_writer_is_refused_and_a_reader_sees_whole_transactions(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as writer:
        with pytest.raises(MemoryFileError, match="by this process already"):
            Store.open(path, writable=True)
        with Store.open(path) as reader:
            with writer.transaction():
                writer.instances.drop(3, None)
                assert len(reader.instances.all()) == len(SMALL_ROOM)
            assert len(reader.instances.all()) == len(SMALL_ROOM) - 1


def test_the_index_of_words_follows_labels_and_descriptions(make_memory: Make) -> None:
    path = make_memory()

    def bearing(word: str) -> set[int]:
        return set(store.words.bearing([word], 99)[0].tolist())

    with Store.open(path, writable=True) as store:
        first = store.instances.all()[2]
        with store.transaction():
            store.instances.set_labels({first.id: "teapot"})
        assert bearing("teapot") == {first.id}
        with store.transaction():
            store.instances.put([replace(first, label="kettle", description="green sphere, 9 cm")])
        assert (bearing("teapot"), bearing("kettle"), bearing("sphere")) == (set(), {first.id}, {first.id})
        with pytest.raises(RuntimeError), store.transaction():
            store.instances.set_labels({first.id: "teapot"})
            raise RuntimeError
        with store.transaction():
            store.instances.drop(first.id, None)
        assert bearing("kettle") == bearing("sphere") == bearing("teapot") == set()
        assert not any("words" in text for text in store.verify())
