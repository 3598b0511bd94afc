"""Consolidation: chunks in, a library with lasting ids out; the same whatever happened on the way."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.errors import UnknownIdError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult, FrameSamples, LocalInstance, LocalLibrary
from list3r.memory.library.consolidation import ConsolidationReport, consolidate
from list3r.memory.library.identities import assign_ids
from list3r.memory.library.relations.settings import RelationSettings
from list3r.memory.library.rules import ConsolidationSettings, settings_of
from list3r.memory.library.world.world import WORLD
from list3r.memory.store.search.graphs import merge_graph, relation_graph
from list3r.memory.store.store import Store
from tests.conftest import chunk_result, local_instance
from tests.memory_scenes import BOX, CHAIR, FLOOR, MAGAZINE, MUG, TABLE, TWIN, Piece, surface

THINGS = [FLOOR, TABLE, MUG, TWIN, BOX, MAGAZINE, CHAIR]
FRAMES = 20


def local(at: int, piece: Piece, index: int, first: int, drift: np.ndarray, view: float | None = None) -> LocalInstance:
    """A local instance of a thing with a box of its own in the image."""
    points = surface(piece, 100 * index + at, view=1.1 * index if view is None else view) + drift
    found = local_instance(at, points.astype(np.float32), piece.rgb, np.arange(first, first + FRAMES))
    feature = np.random.default_rng([ord(c) for c in piece.name]).normal(size=16) ** 2
    x = 6.0 * [p.name for p in THINGS].index(piece.name) if piece in THINGS else 50.0
    box = np.tile(np.float32([4 + x, 10, 8 + x, 20]), (FRAMES, 1))
    return dataclasses.replace(
        found,
        feature=(feature / np.linalg.norm(feature)).astype(np.float32),
        track=dataclasses.replace(found.track, boxes_xyxy=box),
        plane=None if piece.plane is None else np.asarray(piece.plane, float),
        structure=piece.structure,
    )


def chunk(index: int, pieces: list[Piece] | None = None, drift: float = 0.015, step: int = 14) -> ChunkResult:
    """Chunk `index` of a walk round the things, with a small error of its own; neighbours share 6 frames."""
    pieces = THINGS if pieces is None else pieces
    offset = np.random.default_rng(index).normal(size=3)
    offset *= drift / np.linalg.norm(offset)
    first = step * index
    order = np.random.default_rng(index + 50).permutation(len(pieces))
    instances = tuple(local(at, pieces[n], index, first, offset) for at, n in enumerate(order))
    links = np.array([(a, b) for a in range(len(order)) for b in range(a)], np.int32).reshape(-1, 2)
    result = chunk_result(index, first, FRAMES, instances)
    T_chunk_cam = result.T_chunk_cam.copy()
    T_chunk_cam[:, :3, 3] += [-2.0, 0.0, 1.5]
    return dataclasses.replace(result, T_chunk_cam=T_chunk_cam, library=LocalLibrary(instances, links, "test@1/16"))


def create(path: Path) -> Store:
    store = Store.create(path)
    with store.transaction():
        store.facts.scale_kind = "metric"
        store.facts.gravity = "estimated"
        store.sessions.add("walk", "abc", {}, 200)
    return store


def add(store: Store, result: ChunkResult, placed: Sim3 | None = None, component: int = 1) -> ConsolidationReport:
    with store.transaction():
        chunk_id = store.chunks.add(1, result)
        store.chunks.place({chunk_id: placed or Sim3.identity()}, {chunk_id: component})
        return consolidate(store, chunk_id)


def content(store: Store) -> list[object]:
    """All that consolidation writes."""
    return [
        [
            (i.id, i.description, i.confidence, i.observations, i.center.tolist(), i.box.size.tolist())
            for i in store.instances.all()
        ],
        [(i.best_view, i.structure, i.first_seen_s, i.last_seen_s) for i in store.instances.all()],
        store.observations.all(),
        store.relations.all(),
        store.merges.decisions(),
        store.ids.aliases(),
        store.embeddings.all("test@1/16")[1].tolist(),
    ]


def named(store: Store) -> dict[str, int]:
    """Ids by the true name: the thing whose box has the true centre within 10 cm."""
    out = {}
    for piece in THINGS:
        near = [i.id for i in store.instances.all() if np.linalg.norm(i.center - piece.center) < 0.1]
        assert len(near) == 1, f"{piece.name}: {near}"
        out[piece.name] = near[0]
    return out


def test_a_walk_becomes_one_instance_for_each_thing(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        reports = [add(store, chunk(k)) for k in range(4)]
        assert reports[0].new == tuple(range(1, len(THINGS) + 1))
        assert all(not r.new and not r.merged for r in reports[1:])
        assert reports[-1].instances == len(THINGS) - 1 and reports[-1].structure == 1
        ids = named(store)
        mug = store.instances.get(ids["mug"])
        assert np.abs(mug.box.size - [0.08, 0.08, 0.1]).max() < 0.04
        assert mug.color_name == "white" and mug.description.startswith("small white") and "cm" in mug.description
        assert mug.observations == 3 * 14 + FRAMES
        assert mug.first_seen_s == 0.0 and np.isclose(mug.last_seen_s, (3 * 14 + FRAMES - 1) / 30)
        assert mug.best_view is not None and mug.state == "present"
        assert store.instances.get(ids["floor"]).structure == "floor"
        assert store.instances.get(ids["table"]).structure is None
        on = {(r.subject, r.object) for r in store.relations.all(predicate="on")}
        assert {(ids[n], ids["table"]) for n in ("mug", "twin mug", "box", "magazine")} <= on
        assert store.verify() == []


def test_a_small_thing_is_told_as_large_as_its_whole_views_agree_on_and_a_large_one_as_all_saw_it(
    tmp_path: Path,
) -> None:
    with create(tmp_path / "a.l3r") as store:
        for k in range(5):
            add(store, chunk(k, drift=0.0 if k < 4 else 0.04))
        ids = named(store)
        box, table = store.instances.get(ids["box"]), store.instances.get(ids["table"])
        assert np.abs(box.box.size - [0.3, 0.2, 0.16]).max() < 0.02
        assert (np.sort(np.diff(box.aabb, axis=0)[0]) - np.sort(box.box.size)).max() > 0.02
        assert np.allclose(np.sort(np.diff(table.aabb, axis=0)[0]), np.sort(table.box.size), atol=0.01)


def test_confidence_grows_with_evidence(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        add(store, chunk(0))
        before = {i.id: i.confidence for i in store.instances.all()}
        add(store, chunk(1))
        things = [i for i in store.instances.all() if i.structure is None]
        assert things and all(i.confidence > before[i.id] for i in things)
        assert all(0.0 <= i.confidence <= 1.0 for i in store.instances.all())


def test_consolidating_again_changes_nothing_and_logs_nothing(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        for k in range(3):
            add(store, chunk(k))
        before = content(store)
        with store.transaction():
            report = consolidate(store)
        assert report.new == () and report.merged == ()
        assert content(store) == before


def test_a_build_that_goes_on_in_another_process_equals_one_that_never_stopped(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        for k in range(4):
            add(store, chunk(k))
        whole = content(store)
    for k in range(4):
        with create(tmp_path / "b.l3r") if k == 0 else Store.open(tmp_path / "b.l3r", writable=True) as store:
            add(store, chunk(k))
            assert k < 3 or content(store) == whole


def test_a_chunk_that_was_rolled_back_leaves_no_trace(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store, create(tmp_path / "b.l3r") as other:
        for s in (store, other):
            add(s, chunk(0))
        with pytest.raises(RuntimeError), store.transaction():
            chunk_id = store.chunks.add(1, chunk(1, [MUG, CHAIR], drift=0.3))
            store.chunks.place({chunk_id: Sim3.identity()}, {chunk_id: 1})
            consolidate(store, chunk_id)
            raise RuntimeError
        for s in (store, other):
            add(s, chunk(1))
        assert content(store) == content(other)


def test_the_order_of_local_ids_does_not_change_the_partition(tmp_path: Path) -> None:
    sets = []
    for name, turn in (("a", 0), ("b", 1)):
        with create(tmp_path / f"{name}.l3r") as store:
            for k in range(3):
                result = chunk(k)
                library = result.library
                add(
                    store,
                    dataclasses.replace(
                        result,
                        library=dataclasses.replace(
                            library, instances=library.instances[::-1] if turn else library.instances
                        ),
                    ),
                )
            sets.append(
                {
                    frozenset((o.chunk_id, o.local_id) for o in store.observations.of(i.id))
                    for i in store.instances.all()
                }
            )
    assert sets[0] == sets[1]


def test_when_two_instances_prove_one_the_older_id_stays_and_the_other_resolves_to_it(tmp_path: Path) -> None:
    """A loop closure brings the second view of a thing to where the first was."""
    with create(tmp_path / "a.l3r") as store:
        add(store, chunk(0, [CHAIR]))
        add(store, chunk(1, [CHAIR], step=500), placed=Sim3.exp([1.5, 0, 0, 0, 0, 0, 0]))
        assert [i.id for i in store.instances.all()] == [1, 2]
        with store.transaction():
            store.chunks.place({2: Sim3.identity()}, {2: 1})
            report = consolidate(store, 2)
        assert report.merged == ((2, 1),)
        assert [i.id for i in store.instances.all()] == [1]
        assert store.instances.get(2).id == 1 and store.ids.aliases() == {2: 1}
        assert [d.kind for d in store.merges.decisions()] == ["merge", "alias"]
        with store.transaction():
            store.chunks.place({2: Sim3.exp([1.5, 0, 0, 0, 0, 0, 0])}, {2: 1})
            report = consolidate(store, 2)
        assert report.new == (3,), "a split gives a new id to the part that leaves; 2 is not used again"
        assert sorted(i.id for i in store.instances.all()) == [1, 3]
        assert store.merges.decisions()[-1].kind == "split"
        with pytest.raises(UnknownIdError):
            store.instances.get(99)


def test_what_others_see_as_part_of_a_thing_is_not_shown_and_its_id_resolves_to_the_thing(tmp_path: Path) -> None:
    patch = Piece("patch", (0.45, 0.2, 0.72), (0.2, 0.15, 0.004), (150, 110, 70), points=300)
    with create(tmp_path / "a.l3r") as store:
        add(store, chunk(0, [TABLE, patch]))
        assert len(store.instances.all()) == 2
        for k in range(1, 4):
            add(store, chunk(k, [TABLE]))
        assert len(store.instances.all()) == 1
        table = store.instances.all()[0].id
        assert store.ids.resolve(3 - table) == table


def computed(result: ChunkResult, things: int) -> ChunkResult:
    """The chunk as if its depth had been computed, with depth wherever it or others see one of some things."""
    frames = np.repeat(result.frame_indices, things)
    slot = np.tile(np.arange(things), len(result.frame_indices))
    # what is seen at a place in the picture is told by the box, see `local`
    boxes = {int(i.track.boxes_xyxy[0, 0]): i.local_id for i in result.library.instances}
    places = sorted({int(4 + 6.0 * n) for n in range(len(THINGS))} | {54})
    owner = np.array([boxes.get(places[k], -1) for k in slot], np.int32)
    samples = FrameSamples(
        frame=frames,
        pixel=slot.astype(np.int32),
        points=np.zeros((len(frames), 3), np.float32),
        confidence=np.ones(len(frames), np.float32),
        instance=owner,
        camera_frames=result.frame_indices,
        T_chunk_cam=result.T_chunk_cam,
    )
    return dataclasses.replace(result, scale_kind="relative", samples=samples)


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_what_the_next_chunk_misses_in_the_same_frames_was_never_there(tmp_path: Path, kind: str) -> None:
    phantom = Piece("phantom", (-0.6, 0.4, 0.9), (0.2, 0.1, 0.1), (90, 40, 40), points=300)
    with create(tmp_path / "a.l3r") as store:
        made = computed if kind == "relative" else (lambda result, _: result)
        add(store, made(chunk(0, [TABLE, MUG, phantom]), 8))
        before = {i.id for i in store.instances.all()}
        assert len(before) == 3
        report = add(store, made(chunk(1, [TABLE, MUG], step=6), 8))
        after = {i.id for i in store.instances.all()}
        if kind == "metric":
            assert after == before
            return
        assert after < before and report.hidden == 1
        (gone,) = before - after
        with pytest.raises(UnknownIdError):
            store.instances.get(gone)
        again = add(store, made(chunk(2, [TABLE, MUG, phantom], step=6), 8))
        assert len(again.new) == 1 and gone not in again.new


def test_where_the_next_chunk_has_no_depth_it_misses_nothing(tmp_path: Path) -> None:
    phantom = Piece("phantom", (-0.6, 0.4, 0.9), (0.2, 0.1, 0.1), (90, 40, 40), points=300)
    with create(tmp_path / "a.l3r") as store:
        add(store, computed(chunk(0, [TABLE, MUG, phantom]), 8))
        add(store, computed(chunk(1, [TABLE, MUG], step=6), 7))
        assert len(store.instances.all()) == 3


def test_relations_and_confidence_of_computed_depth_allow_for_its_noise(tmp_path: Path) -> None:
    given = ConsolidationSettings(relations=RelationSettings(contact_m=0.05))
    with create(tmp_path / "a.l3r") as store:
        assert settings_of(store, given) == given
        with store.transaction():
            store.facts.scale_kind = "relative"
        found = settings_of(store, given)
        assert found.relations == RelationSettings(contact_m=0.05, noise_m=RelationSettings().computed_noise_m)
        assert found.structure.floor_band_m == found.structure.computed_floor_band_m > given.structure.floor_band_m
        assert found.evidence.odds == given.evidence.computed_odds != given.evidence.odds
        assert settings_of(store, found) == found


def test_what_bounds_the_room_is_not_missed(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        add(store, computed(chunk(0, [TABLE, FLOOR]), 8))
        add(store, computed(chunk(1, [TABLE], step=6), 8))
        assert len(store.instances.all()) == 2


def test_too_few_frames_are_not_shown(tmp_path: Path) -> None:
    result = chunk(0, [MUG, CHAIR])
    mug, chair = result.library.instances
    short = dataclasses.replace(
        mug,
        track=dataclasses.replace(
            mug.track,
            frames=mug.track.frames[:2],
            boxes_xyxy=mug.track.boxes_xyxy[:2],
            centers_xy=mug.track.centers_xy[:2],
            areas_px=mug.track.areas_px[:2],
            visible_fraction=mug.track.visible_fraction[:2],
            masks=mug.track.masks[:2],
        ),
    )
    with create(tmp_path / "a.l3r") as store:
        report = add(
            store, dataclasses.replace(result, library=dataclasses.replace(result.library, instances=(short, chair)))
        )
        assert (report.instances, report.hidden) == (1, 1)


def test_parts_of_the_walk_that_could_not_be_joined_stay_apart(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        add(store, chunk(0, [MUG, TABLE]))
        add(store, chunk(1, [MUG, TABLE], step=500), component=2)
        assert sorted(i.component for i in store.instances.all()) == [1, 1, 2, 2]
        homes = {i.id: i.component for i in store.instances.all()}
        assert all(homes[r.subject] == homes[r.object] for r in store.relations.all())
        assert not [r for r in store.relations.all(predicate="on") if homes[r.subject] == 2], (
            "up is known in the first part only"
        )
        with store.transaction():
            store.facts.upright_parts = (2,)
            consolidate(store)
        assert [r for r in store.relations.all(predicate="on") if homes[r.subject] == 2]


def test_without_gravity_there_are_no_vertical_relations_and_boxes_are_free(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        with store.transaction():
            store.facts.gravity = "unknown"
        for k in range(2):
            add(store, chunk(k))
        assert {r.predicate for r in store.relations.all()} <= {"near", "next_to"}
        floor = next(i for i in store.instances.all() if i.structure)
        assert floor.structure == "plane"


def test_a_relative_memory_tells_no_centimetres(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        with store.transaction():
            store.facts.scale_kind = "relative"
        add(store, dataclasses.replace(chunk(0), scale_kind="relative"))
        assert all("cm" not in i.description and " m" not in i.description for i in store.instances.all())


@pytest.mark.parametrize(("depth", "metre"), [(2.0, 1.05), (3.0, 1.10), (8.0, 4.0)])
def test_a_metre_of_a_relative_memory_is_told_by_depths_and_by_the_height_of_the_cameras(
    tmp_path: Path, depth: float, metre: float
) -> None:
    """The cameras are 1.49 m over the floor; where the depths say something else altogether, they alone are heard."""
    with create(tmp_path / "a.l3r") as store:
        with store.transaction():
            store.facts.scale_kind = "relative"
        result = chunk(0)
        T = result.T_chunk_cam[0]
        points = np.tile(T[:3, 3] + depth * T[:3, 2], (len(result.samples.frame), 1)).astype(np.float32)
        samples = dataclasses.replace(result.samples, points=points, T_chunk_cam=result.T_chunk_cam)
        add(store, dataclasses.replace(result, scale_kind="relative", samples=samples))
        world = store.facts[WORLD]
        assert world is not None and world.unit == pytest.approx(metre, rel=0.02)


def test_an_empty_memory_and_an_empty_chunk_are_no_trouble(tmp_path: Path) -> None:
    with create(tmp_path / "a.l3r") as store:
        with store.transaction():
            assert consolidate(store).instances == 0
        assert add(store, chunk(0, [])).instances == 0
        assert add(store, chunk(1)).structure == 1


def test_graphs_say_what_the_store_says(tmp_path: Path) -> None:
    import networkx

    with create(tmp_path / "a.l3r") as store:
        for k in range(3):
            add(store, chunk(k))
        relations = relation_graph(store)
        assert set(relations.nodes) == {i.id for i in store.instances.all()}
        assert relations.number_of_edges() == len(store.relations.all())
        merges = merge_graph(store)
        assert merges.number_of_nodes() == len(store.observations.all())
        parts = {frozenset(merges.nodes[n]["instance"] for n in part) for part in networkx.connected_components(merges)}
        assert parts == {frozenset([i.id]) for i in store.instances.all()}


def test_ids_go_to_the_largest_part_and_are_never_used_again() -> None:
    groups = [[(1, 0), (2, 0)], [(2, 1), (3, 0), (3, 1)], [(3, 2)]]
    weights = {key: 10 for group in groups for key in group} | {(3, 1): 5}
    before = {(1, 0): 4, (2, 0): 7, (2, 1): 4, (3, 0): 4}
    ids = assign_ids(groups, before, weights, [True] * 3, [None] * 3, next_id=9)
    assert ids.of_group == (7, 4, 9)
    assert ids.new == (9,) and ids.aliases == () and ids.splits == () and ids.last_id == 9
    ids = assign_ids([[(1, 0), (2, 0)]], {(1, 0): 4, (2, 0): 7}, weights, [True], [None], next_id=9)
    assert ids.of_group == (4,) and ids.aliases == ((7, 4),)
    ids = assign_ids([[(1, 0)], [(2, 0)]], {(1, 0): 4, (2, 0): 4}, {(1, 0): 1, (2, 0): 9}, [True] * 2, [None] * 2, 9)
    assert ids.of_group == (9, 4) and ids.splits == ((4, 9),)
    ids = assign_ids([[(1, 0)], [(2, 0)]], {(1, 0): 4, (2, 0): 5}, weights, [True, False], [None, 0], next_id=9)
    assert ids.of_group == (4, None) and ids.aliases == ((5, 4),)
