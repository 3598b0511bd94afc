"""The face for Python: one memory in many threads, tables, filters, read-only."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.api import SceneMemory
from list3r.exporters.tables import records_of
from list3r.memory.core.errors import MemoryFileError, OptionError, UnknownIdError
from list3r.memory.core.geometry import Sim3
from list3r.memory.store.store import Store
from list3r.pipeline.settings import BuildSettings
from list3r.queries.answers import Answers
from list3r.queries.info import info
from list3r.queries.trust import path_in_words
from tests.conftest import chunk_result, small_picture, write_small_room

FLOOR, TABLE, MUG, TWIN, CHAIR, WALL = range(1, 7)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("face") / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    return path


@pytest.fixture
def memory(room: Path) -> Iterator[SceneMemory]:
    with list3r.open(room) as opened:
        yield opened


def questions(memory: SceneMemory) -> list[Callable[[], object]]:
    """One of each kind, as plain values that can be compared."""

    def plain(matches: list[object]) -> list[tuple[object, ...]]:
        return [(m.instance.id, m.score, m.distance_m, m.reason) for m in matches]  # type: ignore[attr-defined]

    return [
        lambda: plain(memory.nearest((1.8, 0.1, 1.0), 4)),
        lambda: plain(memory.nearest(MUG, 4)),
        lambda: plain(memory.within(center=(2.0, 0.0, 0.7), radius=0.5)),
        lambda: plain(memory.visible(memory.camera(frame=4), structure=True)),
        lambda: plain(memory.find("mug on table")),
        lambda: plain(memory.similar(MUG)),
        lambda: list(memory.relations(subject=MUG, viewpoint=CHAIR)),
        lambda: list(memory.path_between(MUG, CHAIR)),
        lambda: memory.seen(TABLE),
        lambda: sorted(memory.relation_graph().edges),
        lambda: len(memory.merge_graph()),
        lambda: memory.to_dataframe("frames").to_dict("records")[4],
        lambda: memory.support(MUG).points.sum(),
    ]


def test_eight_threads_ask_one_memory_and_get_what_one_thread_gets(room: Path) -> None:
    with list3r.open(room) as alone:
        expected = [ask() for ask in questions(alone)]
    with list3r.open(room) as shared, ThreadPoolExecutor(8) as pool:

        def all_of_them(start: int) -> list[object]:
            asks = questions(shared)
            order = [(start + k) % len(asks) for k in range(len(asks))]
            answers = {n: asks[n]() for n in order}
            return [answers[n] for n in range(len(asks))]

        for found in pool.map(all_of_them, range(16)):
            assert found == expected


def test_a_memory_that_is_read_refuses_to_be_written(memory: SceneMemory) -> None:
    with pytest.raises(MemoryFileError, match=r"read-only|reading"), memory.store.transaction():
        memory.store.facts.gravity = "known"


def test_tables_are_flat_and_alike(memory: SceneMemory) -> None:
    for table, count in (("instances", 6), ("relations", 4), ("frames", 20)):
        rows = records_of(memory.store, table)  # type: ignore[arg-type]
        assert memory.to_dataframe(table).shape == (count, len(rows[0]))  # type: ignore[arg-type]
        assert len(rows) == count and len({tuple(r) for r in rows}) == 1
        assert all(v is None or type(v) in (int, float, str, bool) for r in rows for v in r.values())
    mug = next(r for r in records_of(memory.store) if r["id"] == MUG)
    assert (mug["center_x"], mug["box_size_z"], mug["structure"]) == (pytest.approx(1.8), pytest.approx(0.1), None)
    with pytest.raises(OptionError, match="instances"):
        memory.to_dataframe("things")  # type: ignore[arg-type]


def test_every_filter_filters(memory: SceneMemory) -> None:
    def ask(**filters: object) -> list[int]:
        return sorted(m.instance.id for m in memory.nearest((2.0, 0.0, 0.5), 9, **filters))  # type: ignore[arg-type]

    assert ask() == [TABLE, MUG, TWIN, CHAIR]
    assert ask(label="mug") == [MUG, TWIN]
    assert ask(max_size=0.2) == [MUG, TWIN]
    assert ask(min_size=0.8, max_size=1.0) == [CHAIR]
    assert ask(color="white") == ask() and ask(color="red") == []
    assert ask(component=2) == [] and ask(dynamic=True) == []
    assert ask(structure=True) == [FLOOR, TABLE, MUG, TWIN, CHAIR, WALL]
    assert ask(max_distance=0.05) == ask(max_distance=0.05, state="present")
    for wrong in ({"label": " "}, {"min_size": -1.0}, {"max_size": float("nan")}, {"state": "gone"}):
        with pytest.raises(OptionError):
            ask(**wrong)


def test_what_moves_is_near_where_it_was_last(tmp_path: Path) -> None:
    with Store.create(tmp_path / "moving.l3r") as store, store.transaction():
        write_small_room(store)
        mug = store.instances.get(MUG)
        gone = mug.aabb + np.array([0.0, 1.5, 0.0])
        box = dataclasses.replace(mug.box, center=mug.box.center + np.array([0.0, 1.5, 0.0]))
        store.instances.put([dataclasses.replace(mug, dynamic=True, aabb=gone, box=box, center=gone.mean(axis=0))])
        memory = SceneMemory(store)
        found = memory.nearest((1.8, 1.6, 0.77), k=1, dynamic=True)
        assert [m.instance.id for m in found] == [MUG] and (found[0].distance_m or 0.0) < 0.1


def test_numbers_that_no_id_can_be_are_unknown(memory: SceneMemory) -> None:
    for number in (-1, 0, 77, 2**63, 10**40):
        for ask in (memory.nearest, memory.similar, memory.seen):
            with pytest.raises(UnknownIdError):
                ask(number)


def test_a_camera_has_one_name(memory: SceneMemory) -> None:
    for wrong in ({}, {"frame": 1, "time_s": 0.1}, {"position": (0, 0, 0)}, {"quat_wxyz": (1, 0, 0, 0), "frame": 1}):
        with pytest.raises(OptionError):
            memory.camera(**wrong)  # type: ignore[arg-type]


def test_an_answer_sees_one_state_of_the_file(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(shutil.copy(room, tmp_path / "both.l3r"))
    with Store.open(path, writable=True) as writer, list3r.open(path) as memory:
        boxes_in_box = memory.store.instances.boxes_in_box

        def and_then_a_writer(*corners: object, **filters: object) -> object:
            found = boxes_in_box(*corners, **filters)  # type: ignore[arg-type]
            with writer.transaction():
                writer.instances.drop(TWIN, None)
            return found

        with monkeypatch.context() as patch:
            patch.setattr(memory.store.instances, "boxes_in_box", and_then_a_writer)
            before = {m.instance.id for m in memory.within(center=(2.0, 0.0, 0.7), radius=0.5)}
        after = {m.instance.id for m in memory.within(center=(2.0, 0.0, 0.7), radius=0.5)}
        assert TWIN in before and after == before - {TWIN}


def test_a_memory_says_what_it_holds(make_memory: Callable[..., Path], tmp_path: Path) -> None:
    with list3r.open(make_memory()) as memory:
        assert repr(memory) == "<SceneMemory 'room.l3r': 4 instances, 2 of structure, 1 session, metric, z up>"
        assert len(memory) == 4 and [i.id for i in memory] == [2, 3, 4, 5]
        assert (
            3 in memory
            and 1 in memory
            and 99 not in memory
            and "mug" in memory
            and "elephant" not in memory
            and memory[3] in memory
        )
        told = memory.info()
        assert (told["instances"], told["structure"], told["relations"], told["units"]) == (4, 2, 4, "m")
        assert memory._repr_png_().startswith(b"\x89PNG")
    assert repr(memory) == "<SceneMemory 'room.l3r', closed>"
    Store.create(tmp_path / "empty.l3r").close()
    with list3r.open(tmp_path / "empty.l3r") as empty:
        assert empty and len(empty) == 0 and "0 instances" in repr(empty)


def test_a_memory_says_how_far_its_path_can_be_trusted(tmp_path: Path) -> None:
    with Store.create(tmp_path / "a.l3r") as store:
        with store.transaction():
            session = store.sessions.add("walk", "abc", BuildSettings().as_plain(), 40)
            for k in range(2):
                made = chunk_result(k, 20 * k, 20, ())
                posed = made.posed & (np.arange(20) >= 3 * k)
                chunk = store.chunks.add(session, replace(made, posed=posed, unsure=frozenset({5, 6, 9, 21})))
                place = {chunk: Sim3.identity()}
                store.chunks.place(place, {chunk: 1 + k}, {chunk: np.diag([0.0, 4e-4, 0.0, 0.0, 0.0, 0.0, 0.0])})
        told = info(store)["trust"]
    assert told == {
        "lost": [[1, 20, 22]],
        "unsure": [[1, 5, 6], [1, 9, 9]],
        "breaks": [[1, 23]],
        "parts": [{"part": 1, "frames": 20, "deviation": 0.02}, {"part": 2, "frames": 17, "deviation": 0.02}],
    }
    assert path_in_words(told, "m") == (
        "places known to 0.02 m; 2 parts of 20, 17 frames; lost in 3 frames (20 to 22); "
        "little support in 3 frames (5 to 6, 9)"
    )


def test_things_are_had_by_id_and_by_name(memory: SceneMemory) -> None:
    mug = memory[MUG]
    assert (mug.id, mug.name) == (MUG, "mug") and memory[mug].id == MUG
    assert [i.id for i in memory["mug"]] == [MUG, TWIN] and [i.id for i in memory["floor"]] == [FLOOR]
    with pytest.raises(KeyError, match="nothing called 'mugg'; close names: mug") as error:
        memory["mugg"]
    assert isinstance(error.value, UnknownIdError) and "\n" not in str(error.value)
    with pytest.raises(UnknownIdError, match="77"):
        memory[77]
    with pytest.raises(OptionError, match="an id or a name"):
        memory[1:2]  # type: ignore[call-overload]


def test_an_instance_stands_where_an_id_goes(memory: SceneMemory) -> None:
    mug, chair = memory[MUG], memory[CHAIR]
    pairs: list[tuple[object, object]] = [
        ([m.instance.id for m in memory.nearest(mug)], [m.instance.id for m in memory.nearest(MUG)]),
        ([m.instance.id for m in memory.similar(mug)], [m.instance.id for m in memory.similar(MUG)]),
        (memory.relations(mug, viewpoint=chair), memory.relations(MUG, viewpoint=CHAIR)),
        (memory.relations(predicate="between", object=mug, other=chair),
         memory.relations(predicate="between", object=MUG, other=CHAIR)),
        (memory.relations_of(mug), memory.relations_of(MUG)),
        (memory.seen(mug), memory.seen(MUG)),
        (memory.measure(mug, chair).gap, memory.measure(MUG, CHAIR).gap),
        (memory.path_between(mug, chair), memory.path_between(MUG, CHAIR)),
        (len(memory.support(mug).points), len(memory.support(MUG).points)),
    ]  # fmt: skip
    for by_instance, by_id in pairs:
        assert by_instance == by_id


def test_an_edit_takes_an_instance(room: Path, tmp_path: Path) -> None:
    with list3r.open(shutil.copy(room, tmp_path / "edit.l3r"), writable=True) as memory:
        memory.label(memory[CHAIR], "throne")
        assert [i.id for i in memory["throne"]] == [CHAIR]


def test_things_become_arrays_tables_and_clouds(memory: SceneMemory) -> None:
    np.testing.assert_array_equal(memory.boxes, [i.aabb for i in memory])
    assert memory["mug"].boxes.shape == (2, 2, 3) and memory.find("elephant").boxes.shape == (0, 2, 3)
    assert memory.points.shape == (sum(len(memory.support(i).points) for i in memory), 3)
    found = memory.find("mug")
    table = found.to_dataframe()
    assert list(table["id"]) == [m.instance.id for m in found] and {"name", "score", "x", "reason"} <= set(table)
    assert not hasattr(memory.relations(), "boxes") and not hasattr(memory.relations_of(MUG), "boxes")
    assert list(memory.relations().to_dataframe().columns) == ["subject", "predicate", "object", "confidence", "margin"]
    cloud = pytest.importorskip("open3d") and memory.to_open3d(MUG)
    np.testing.assert_allclose(np.asarray(cloud.points), memory.support(MUG).points, atol=1e-6)
    scene = memory.to_trimesh()
    assert len(scene.geometry) == 4 and f"{MUG} mug" in scene.geometry
    assert memory.plot().axes


def test_a_file_says_its_format(memory: SceneMemory, tmp_path: Path) -> None:
    assert memory.export(tmp_path / "x.glb")[0].read_bytes()[:4] == b"glTF"
    assert memory.export(str(tmp_path / "x.json"))[0].exists()
    for wrong in ("x.xyz", "glb"):
        with pytest.raises(OptionError, match=r"\.glb"):
            memory.export(wrong)


def test_a_notebook_shows_short_tables_with_pictures(tmp_path: Path) -> None:
    with Store.create(tmp_path / "pictures.l3r") as store, store.transaction():
        write_small_room(store, small_picture())
        label = '<script>alert("x")</script>'
        store.instances.put([dataclasses.replace(store.instances.get(MUG), label=label)])
    with list3r.open(tmp_path / "pictures.l3r") as memory:
        for shown in (memory._repr_html_(), memory.nearest(MUG)._repr_html_()):
            assert "data:image/jpeg;base64," in shown and "<script>" not in shown
        answers = memory.instances() * 30
        assert len(answers) == 120
        answers = Answers(answers)
        answers.picture_of = memory._thumbnail
        assert answers._repr_html_().count("<tr>") == 21 and "100 more" in answers._repr_html_()
        shown = memory[MUG]._repr_html_()
        assert "<script>" not in shown and f"<td>{MUG}</td>" in shown and memory[MUG].description in shown
        near = memory.nearest(MUG, 1)
        assert repr(near).startswith(f"[<Match {near[0].score:.2f}: Instance {near[0].instance.id}: ")
        assert len(repr(answers)) < 4000 and "array(" not in repr(memory[MUG]) + repr(memory.nearest(MUG))
        after = memory.instances()
    assert "<img" not in after._repr_html_() and "mug" in after._repr_html_()
