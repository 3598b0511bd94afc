"""Moving things in the memory: joined over time, never with what they passed, with a track and a place of rest."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.exporters.scene_json import scene_dict, scene_schema
from list3r.memory.core.records import Instance, LocalInstance, LocalLibrary, MotionTrack
from list3r.memory.library.consolidation import consolidate
from list3r.memory.store.store import Store
from tests.conftest import box_points, chunk_result, local_instance

FRAMES, STEP = 20, 14
TABLE = ((2.0, 0.0, 0.36), (1.2, 0.8, 0.72), (150, 110, 70))
FLOOR = ((2.0, 0.0, -0.01), (6.0, 6.0, 0.02), (120, 120, 120))


def with_box(found: LocalInstance, x: np.ndarray, width: float = 8.0) -> LocalInstance:
    boxes = np.stack([x, np.full(len(x), 8.0), x + width, np.full(len(x), 30.0)], axis=1)
    return dataclasses.replace(found, track=dataclasses.replace(found.track, boxes_xyxy=boxes.astype(np.float32)))


def still(
    local_id: int,
    center: tuple[float, ...],
    size: tuple[float, ...],
    rgb: tuple[int, int, int],
    first: int,
    x: float,
    seed: int = 0,
) -> LocalInstance:
    """A thing that stays, with a box of its own in the picture."""
    points = box_points(center, size, 900, 10 * local_id + seed)
    found = with_box(local_instance(local_id, points, rgb, np.arange(first, first + FRAMES)), np.full(FRAMES, x))
    return dataclasses.replace(found, structure=size[2] < 0.05, plane=_level(center, size))


def _level(center: tuple[float, ...], size: tuple[float, ...]) -> np.ndarray | None:
    return np.array([0.0, 0.0, 1.0, -center[2] - size[2] / 2]) if size[2] < 0.05 else None


def walker(
    local_id: int,
    first: int,
    path: object,
    rgb: tuple[int, int, int] = (200, 30, 30),
    *,
    seed: int = 0,
    size: tuple[float, ...] = (0.4, 0.3, 1.7),
) -> LocalInstance:
    """A thing whose middle at frame k is `path(k)`."""
    frames = np.arange(first, first + FRAMES)
    places = np.array([path(k) for k in frames], np.float32)  # type: ignore[operator]
    points = box_points(tuple(places[-1].tolist()), size, 600, seed)
    found = with_box(local_instance(local_id, points, rgb, frames), 4 + 10 * (places[:, 1] + 2))
    feature = np.ones(16, np.float32) / 4
    return dataclasses.replace(found, feature=feature, dynamic=True, motion=MotionTrack(frames, places))


def across(k: int) -> tuple[float, float, float]:
    """1.2 m/s past the table, at 30 frames a second."""
    return 1.2, -1.8 + 0.04 * k, 0.85


def room(first: int) -> list[LocalInstance]:
    return [still(0, *TABLE, first, 20.0, first), still(1, *FLOOR, first, 40.0, first)]


def chunk(index: int, movers: list[LocalInstance], first: int | None = None) -> object:
    first = STEP * index if first is None else first
    result = chunk_result(index, first, FRAMES, (*room(first), *movers))
    T = result.T_chunk_cam.copy()
    T[:, :3, 3] += [-2.0, 0.0, 1.5]
    library = LocalLibrary(result.library.instances, np.zeros((0, 2), np.int32), "test@1/16")
    return dataclasses.replace(result, T_chunk_cam=T, library=library)


def memory(path: Path, chunks: list[object], flags: dict[int, dict[int, MotionTrack | None]] | None = None) -> Store:
    store = Store.create(path)
    with store.transaction():
        store.facts.scale_kind = "metric"
        store.facts.gravity = "estimated"
        store.sessions.add("walk", "abc", {}, 200)
    for result in chunks:
        with store.transaction():
            chunk_id = store.chunks.add(1, result)  # type: ignore[arg-type]
            store.chunks.place(
                {c.chunk_id: c.S_world_chunk for c in store.chunks.all()},
                dict.fromkeys([c.chunk_id for c in store.chunks.all()], 1),
            )
            consolidate(store, chunk_id)
            if flags and chunk_id in flags:
                store.local_instances.flag_dynamic(chunk_id, flags[chunk_id])
                consolidate(store, chunk_id)
    return store


def moving(store: Store) -> list[Instance]:
    return [i for i in store.instances.all() if i.dynamic]


def test_a_walk_over_several_chunks_is_one_thing_with_one_track(tmp_path: Path) -> None:
    store = memory(tmp_path / "m.l3r", [chunk(k, [walker(2, STEP * k, across, seed=k)]) for k in range(4)])
    (person,) = moving(store)
    times_s, places = store.tracks.of(person.id)
    frames = np.arange(3 * STEP + FRAMES)
    assert np.allclose(times_s, frames / 30)
    assert np.abs(places - [across(k) for k in frames]).max() < 0.01
    assert np.linalg.norm(person.center - across(int(frames[-1]))) < 0.1
    assert len(store.observations.of(person.id)) == 4
    assert not store.relations.all(subject=person.id) and not store.relations.all(object=person.id)
    assert "moving" in person.description
    support = store.surfaces.of(person.id)
    assert np.ptp(support.points[:, 1]) < 0.6


def test_the_order_of_merging_and_streaming_do_not_matter(tmp_path: Path) -> None:
    chunks = [chunk(k, [walker(2, STEP * k, across, seed=k)]) for k in range(3)]
    streamed = memory(tmp_path / "a.l3r", chunks)
    whole = Store.create(tmp_path / "b.l3r")
    with whole.transaction():
        whole.facts.scale_kind = "metric"
        whole.facts.gravity = "estimated"
        whole.sessions.add("walk", "abc", {}, 200)
        ids = [whole.chunks.add(1, c) for c in chunks]  # type: ignore[arg-type]
        whole.chunks.place({c.chunk_id: c.S_world_chunk for c in whole.chunks.all()}, dict.fromkeys(ids, 1))
        consolidate(whole)
    parts = [{(o.chunk_id, o.local_id) for o in s.observations.of(moving(s)[0].id)} for s in (streamed, whole)]
    assert parts[0] == parts[1]


def test_what_comes_back_looking_the_same_is_the_same(tmp_path: Path) -> None:
    def later(k: int) -> tuple[float, float, float]:
        return 1.2, 1.0 - 0.03 * (k - 60), 0.85

    store = memory(tmp_path / "m.l3r", [chunk(0, [walker(2, 0, across)]), chunk(4, [walker(2, 56, later, seed=1)])])
    assert len(moving(store)) == 1
    assert len(store.tracks.of(moving(store)[0].id)[0]) == 2 * FRAMES


def test_another_colour_is_another_thing(tmp_path: Path) -> None:
    blue = walker(2, 56, across, (20, 20, 220), seed=1)
    store = memory(tmp_path / "m.l3r", [chunk(0, [walker(2, 0, across)]), chunk(4, [blue])])
    assert len(moving(store)) == 2


def test_two_seen_side_by_side_stay_two(tmp_path: Path) -> None:
    def behind(k: int) -> tuple[float, float, float]:
        return 1.2, -0.6 + 0.04 * k, 0.85

    pair = [chunk(k, [walker(2, STEP * k, across), walker(3, STEP * k, behind, seed=9)]) for k in range(2)]
    store = memory(tmp_path / "m.l3r", pair)
    assert len(moving(store)) == 2
    assert all(len(store.observations.of(i.id)) == 2 for i in moving(store))


def test_it_is_never_one_with_what_it_passed(tmp_path: Path) -> None:
    def through(k: int) -> tuple[float, float, float]:
        return 2.0, -0.2 + 0.02 * k, 0.5

    size = (1.0, 0.7, 0.72)
    store = memory(tmp_path / "m.l3r", [chunk(k, [walker(2, STEP * k, through, size=size)]) for k in range(2)])
    (mover,) = moving(store)
    tables = [i for i in store.instances.all() if np.linalg.norm(i.center - TABLE[0]) < 0.1 and not i.dynamic]
    assert len(tables) == 1 and not tables[0].dynamic
    assert {o.local_id for o in store.observations.of(mover.id)} == {2}


def put_down(k: int) -> tuple[float, float, float]:
    """Carried over the table's end, and put on it at frame 20."""
    go = float(np.clip(k / 20.0, 0.0, 1.0))
    return 2.0, -1.4 + 1.2 * go, 0.72 + 0.15 + 0.3 * (1 - go)


def test_what_is_put_down_has_its_place_and_relations_there(tmp_path: Path) -> None:
    size = (0.3, 0.3, 0.3)
    carried = [walker(2, 0, put_down, size=size), walker(2, STEP, put_down, size=size, seed=1)]
    rest = put_down(100)
    left = [
        still(2, rest, size, (200, 30, 30), 28, 4 + 10 * (rest[1] + 2)),
        still(2, rest, size, (200, 30, 30), 42, 4 + 10 * (rest[1] + 2), 1),
    ]
    store = memory(tmp_path / "m.l3r", [chunk(k, [m]) for k, m in enumerate([*carried, *left])])
    (thing,) = moving(store)
    assert np.linalg.norm(thing.center - rest) < 0.03
    assert np.abs(thing.box.size - 0.3).max() < 0.05
    assert any(r.predicate == "on" for r in store.relations.all(subject=thing.id))
    assert "moving" not in thing.description
    assert len(store.observations.of(thing.id)) == 4
    times_s, places = store.tracks.of(thing.id)
    assert len(times_s) == 42 + FRAMES and np.linalg.norm(places[-1] - rest) < 0.03


def test_what_other_chunks_found_to_move_is_respected(tmp_path: Path) -> None:
    chunks = [chunk(k, [still(2, (1.0, 1.5, 0.5), (0.3, 0.3, 1.0), (90, 200, 90), STEP * k, 58.0, k)]) for k in (0, 1)]
    flags: dict[int, dict[int, MotionTrack | None]] = {2: {2: None}}
    store = memory(tmp_path / "m.l3r", chunks, flags)
    (thing,) = moving(store)
    times_s, places = store.tracks.of(thing.id)
    assert len(times_s) == FRAMES + STEP and np.isfinite(places).all()
    assert not store.relations.all(subject=thing.id)


def test_what_bounds_the_room_never_moves(tmp_path: Path) -> None:
    store = memory(tmp_path / "m.l3r", [chunk(0, []), chunk(1, [])], {2: {1: None}})
    assert not moving(store)


def test_without_movers_nothing_changes_and_tracks_are_empty(tmp_path: Path) -> None:
    store = memory(tmp_path / "m.l3r", [chunk(0, []), chunk(1, [])])
    assert not moving(store)
    times_s, places = store.tracks.of(store.instances.all()[0].id)
    assert times_s.shape == (0,) and places.shape == (0, 3)


def test_exports_and_commands_show_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "m.l3r"
    store = memory(path, [chunk(k, [walker(2, STEP * k, across, seed=k)]) for k in range(2)])
    (person,) = moving(store)
    scene = scene_dict(store)
    store.close()
    jsonschema.validate(scene, scene_schema())
    entry = next(i for i in scene["instances"] if i["id"] == person.id)
    assert entry["dynamic"] and len(entry["track"]) == STEP + FRAMES
    assert np.allclose(entry["track"][0], [0.0, *across(0)], atol=2e-3)
    assert not any("track" in i for i in scene["instances"] if i["id"] != person.id)
    with list3r.open(path) as opened:
        assert len(opened.track(person.id)[0]) == STEP + FRAMES
        assert opened.export("plan", tmp_path / "plan.png")[0].stat().st_size > 0
    for words in (["list", str(path)], ["show", str(path), str(person.id)]):
        assert run(words) == 0
        shown = capsys.readouterr().out
        assert ("dynamic" if words[0] == "list" else "moved") in shown
    assert run(["show", str(path), str(person.id), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["matches"][0]["track"]) == STEP + FRAMES


def test_the_stage_moves_it(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from list3r.exporters.usd.stage import usd_stage

    store = memory(tmp_path / "m.l3r", [chunk(k, [walker(2, STEP * k, across, seed=k)]) for k in range(2)])
    (person,) = moving(store)
    stage = usd_stage(store)
    prim = stage.GetPrimAtPath(f"/World/Instances/instance_{person.id}")
    samples = prim.GetAttribute("xformOp:translate").GetTimeSamples()
    assert samples == [float(k) for k in range(STEP + FRAMES)]
    first, last = (np.array(prim.GetAttribute("xformOp:translate").Get(t)) for t in (samples[0], samples[-1]))
    assert np.allclose(last, person.box.center, atol=1e-6)
    assert np.allclose(last - first, np.subtract(across(STEP + FRAMES - 1), across(0)), atol=0.01)
