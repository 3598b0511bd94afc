"""Queries: what they find, and what they refuse in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from list3r.memory.core.errors import OptionError, SpaceMismatchError, UnknownIdError
from list3r.memory.store.search.vectors import VectorIndex
from list3r.memory.store.store import Store
from list3r.queries.nearest import nearest
from list3r.queries.relations import relations
from list3r.queries.seen import seen
from list3r.queries.similar import similar
from list3r.queries.within import within
from tests.conftest import instance, write_small_room

FLOOR, TABLE, MUG, TWIN, CHAIR, WALL = range(1, 7)


@pytest.fixture
def store(make_memory: Callable[..., Path]) -> Iterator[Store]:
    with Store.open(make_memory(), writable=True) as opened:
        yield opened


def ids(matches: list[Any]) -> list[int]:
    return [m.instance.id for m in matches]


def test_nearest_to_a_point_is_ordered_by_surfaces_and_gives_both_distances(store: Store) -> None:
    found = nearest(store, point=(1.8, 0.1, 1.0), k=4)
    assert ids(found) == [MUG, TABLE, TWIN, CHAIR]
    assert np.isclose(found[0].distance_m or 0, 1.0 - 0.82, atol=0.02)
    assert np.isclose(found[0].center_distance_m or 0, 1.0 - 0.77)
    assert all(a.distance_m <= b.distance_m for a, b in pairwise(found))  # type: ignore[operator]
    assert found[0].reason == "from the point"


def test_nearest_agrees_with_brute_force(store: Store) -> None:
    rng = np.random.default_rng(0)
    for point in rng.uniform([0, -2, 0], [4, 2, 2], (20, 3)):
        brute = {
            i.id: float(np.linalg.norm(store.surfaces.of(i.id).points - point, axis=1).min())
            for i in store.instances.all()
        }
        found = nearest(store, point=point, k=6, structure=True)
        assert len(found) == 6
        for m in found:
            assert np.isclose(m.distance_m or 0, brute[m.instance.id], atol=1e-6)


def test_nearest_to_an_instance_leaves_itself_out_and_takes_aliases(store: Store) -> None:
    assert ids(nearest(store, instance_id=MUG, k=2)) == [TABLE, TWIN]
    with store.transaction():
        store.instances.drop(TWIN, alias_of=MUG)
    assert ids(nearest(store, instance_id=TWIN, k=1)) == [TABLE]


def test_structure_answers_only_when_asked_for(store: Store) -> None:
    assert WALL not in ids(nearest(store, point=(3.9, 0, 1), k=9))
    assert ids(nearest(store, point=(3.9, 0, 1), k=1, structure=True)) == [WALL]


def test_filters_narrow_the_answer(store: Store) -> None:
    assert ids(nearest(store, point=(1.8, 0.1, 1.0), k=9, max_distance=0.2)) == [MUG]
    assert nearest(store, point=(1.8, 0.1, 1.0), min_confidence=0.95) == []
    assert nearest(store, point=(1.8, 0.1, 1.0), state="removed") == []
    assert len(nearest(store, point=(1.8, 0.1, 1.0), state="present")) == 4


def test_words_find_labels_and_descriptions(store: Store) -> None:
    assert ids(nearest(store, words="mug")) == [MUG, TWIN]
    assert ids(nearest(store, words="the cups")) == [MUG, TWIN]
    assert nearest(store, words="elephant") == []
    assert nearest(store, words="mug")[0].distance_m is None
    assert ids(nearest(store, words="wall")) == ids(nearest(store, words="walls", structure=True)) == [WALL]
    assert ids(nearest(store, words="mug", point=(2.2, -0.1, 0.8), k=1)) == [TWIN]


def test_words_that_nothing_bears_are_told(store: Store) -> None:
    found = nearest(store, words="small golden mug")
    assert found[0].reason == "named mug; not known to look so" and found.notes[-1].startswith("nothing fits")
    assert nearest(store, words="mug")[0].reason == "named mug"


def test_things_that_touch_have_no_distance(store: Store) -> None:
    touching = {m.instance.id: m.distance_m for m in nearest(store, instance_id=TABLE, k=9)}
    assert touching[MUG] == 0.0 and touching[CHAIR] > 0.01


def test_more_words_found_beat_fewer(store: Store) -> None:
    import dataclasses

    with store.transaction():
        store.instances.put(
            [
                dataclasses.replace(store.instances.get(MUG), label="mug", description="small white cylinder, 9 cm"),
                dataclasses.replace(store.instances.get(TWIN), description="small red cylinder, 9 cm"),
            ]
        )
    assert ids(nearest(store, words="white mug")) == [MUG]
    assert ids(nearest(store, words="small cylinder")) == [TWIN, MUG], "what has the name mug is less a cylinder"
    assert ids(nearest(store, words="red thing")) == [TWIN]


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"point": (0, 0)},
        {"point": (0, 0, float("nan"))},
        {"point": "here"},
        {"point": (0, 0, 0), "instance_id": 2},
        {"point": (0, 0, 0), "k": 0},
        {"point": (0, 0, 0), "max_distance": -1.0},
        {"point": (0, 0, 0), "max_distance": float("inf")},
        {"point": (0, 0, 0), "min_confidence": 2.0},
        {"point": (0, 0, 0), "state": "gone"},
        {"words": "   "},
        {"words": "the"},
        {"words": "mug", "max_distance": 1.0},
    ],
)
def test_nearest_refuses_nonsense_in_one_line(store: Store, arguments: dict[str, Any]) -> None:
    with pytest.raises(OptionError) as caught:
        nearest(store, **arguments)
    assert "\n" not in str(caught.value)


def test_unknown_ids_are_told(store: Store) -> None:
    for ask in (
        lambda: nearest(store, instance_id=77),
        lambda: similar(store, instance_id=77),
        lambda: relations(store, subject=77),
    ):
        with pytest.raises(UnknownIdError, match="77"):
            ask()


def test_within_a_sphere_and_a_box(store: Store) -> None:
    assert set(ids(within(store, center=(1.8, 0.1, 0.77), radius=0.12))) == {MUG, TABLE}
    found = within(store, lower=(1.5, -0.5, 0.73), upper=(2.5, 0.5, 0.9))
    assert {MUG, TWIN} <= set(ids(found))
    assert found[0].score > 0.8
    assert WALL in ids(within(store, center=(4, 0, 1), radius=0.3, structure=True))
    assert within(store, center=(40, 0, 1), radius=0.3) == []


@pytest.mark.parametrize(
    "region",
    [
        {},
        {"center": (0, 0, 0)},
        {"radius": 1.0},
        {"lower": (0, 0, 0)},
        {"lower": (1, 0, 0), "upper": (0, 1, 1)},
        {"lower": (0, 0, 0), "upper": (1, 1, 1), "radius": 1.0},
        {"center": (0, 0, 0), "radius": -1.0},
        {"center": (0, 0), "radius": 1.0},
    ],
)
def test_within_refuses_nonsense(store: Store, region: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        within(store, **region)


def test_relations_are_filtered_and_checked(store: Store) -> None:
    assert {(r.subject, r.object) for r in relations(store, predicate="on", object=TABLE)} == {
        (MUG, TABLE),
        (TWIN, TABLE),
    }
    assert relations(store, subject=CHAIR, min_confidence=0.9) == []
    found = relations(store)
    assert [r.confidence for r in found] == sorted((r.confidence for r in found), reverse=True)
    with pytest.raises(OptionError, match="choose one of: on"):
        relations(store, predicate="upon")


@pytest.mark.parametrize("length", [1e38, 1e-38, 1e300, 1e-300])
def test_how_long_a_vector_is_does_not_matter(store: Store, length: float) -> None:
    (space,) = store.embeddings.spaces()
    known, vectors = store.embeddings.all(space)
    query = vectors[list(known).index(MUG)].astype(np.float64)
    found = [(m.instance.id, m.score) for m in similar(store, vector=query, space=space, k=9)]
    assert found[0] == (MUG, 1.0)
    assert [(m.instance.id, m.score) for m in similar(store, vector=length * query, space=space, k=9)] == found


@pytest.mark.parametrize("length", [1e38, 1e-37])
def test_how_long_a_stored_vector_is_does_not_matter(tmp_path: Path, length: float) -> None:
    told = []
    for by in (1.0, length):
        with Store.create(tmp_path / f"{by}.l3r") as store:
            with store.transaction():
                write_small_room(store)
                (space,) = store.embeddings.spaces()
                ids, vectors = store.embeddings.all(space)
                unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
                store.embeddings.put(space, ids.tolist(), unit * np.float32(by))
            told.append([(m.instance.id, m.score) for m in similar(store, instance_id=MUG, k=9)])
    assert told[0] and [i for i, _ in told[1]] == [i for i, _ in told[0]]
    assert [s for _, s in told[1]] == pytest.approx([s for _, s in told[0]], abs=1e-3)


def test_similar_is_the_exact_cosine_order(store: Store) -> None:
    space = store.embeddings.spaces()[0]
    known, vectors = store.embeddings.all(space)
    cosine = vectors @ vectors[list(known).index(MUG)]
    expected = [int(known[n]) for n in np.argsort(-cosine, kind="stable") if known[n] in (TABLE, TWIN, CHAIR)]
    found = similar(store, instance_id=MUG, k=3)
    assert ids(found) == expected
    assert np.isclose(found[0].score, cosine[list(known).index(expected[0])], atol=1e-4)
    by_vector = similar(store, vector=vectors[list(known).index(MUG)], space=space, k=1)
    assert ids(by_vector) == [MUG] and np.isclose(by_vector[0].score, 1.0, atol=1e-5)


def test_spaces_do_not_mix(store: Store) -> None:
    with pytest.raises(SpaceMismatchError):
        similar(store, vector=np.ones(16), space="clip@2/512")
    with pytest.raises(SpaceMismatchError):
        similar(store, vector=np.ones(512), space="test@1/16")
    with pytest.raises(OptionError):
        similar(store, vector=np.ones(16))
    with pytest.raises(OptionError):
        similar(store)
    with pytest.raises(OptionError):
        similar(store, vector=np.zeros(16), space="test@1/16")
    with store.transaction():
        store.embeddings.put("clip@2/4", [MUG], np.ones((1, 4), np.float32))
    with pytest.raises(OptionError, match="several"):
        VectorIndex.of(store)


def test_queries_work_on_an_empty_memory(tmp_path: Path) -> None:
    with Store.create(tmp_path / "empty.l3r") as empty:
        assert nearest(empty, point=(0, 0, 0)) == []
        assert nearest(empty, words="mug") == []
        assert within(empty, center=(0, 0, 0), radius=1.0) == []
        assert relations(empty) == []
        with pytest.raises(SpaceMismatchError, match="none"):
            similar(empty, vector=np.ones(3), space="test@1/3")
        with pytest.raises(OptionError, match="no embeddings"):
            VectorIndex.of(empty)


def test_queries_read_while_another_process_could_write(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory()) as reader:
        assert ids(nearest(reader, point=(1.8, 0.1, 1.0), k=1)) == [MUG]


def test_a_box_ends_at_its_upper_corner(store: Store) -> None:
    (table,) = within(store, lower=(1.0, -1.0, -1.0), upper=(2.99, 0.7, 0.6))
    assert table.instance.id == TABLE and 0.3 < table.score < 0.9


def test_a_stretch_goes_on_while_its_breaks_are_short(store: Store) -> None:
    found = seen(store, MUG, gap_s=0.05)
    assert len(found.frames) == 20 and len(found.spans_s) == 1
    assert len(seen(store, MUG, gap_s=0.01).spans_s) == 20


def test_what_lives_in_another_part_is_not_near_a_thing(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory(), writable=True) as apart:
        with apart.transaction():
            apart.instances.put([instance(20, (2.0, 0.0, 0.8), (0.1,) * 3, (1, 1, 1), description="mug", component=2)])
        assert {m.instance.id for m in nearest(apart, instance_id=TABLE, words="mug")} == {MUG, TWIN}
        assert {m.instance.id for m in nearest(apart, point=(2.0, 0.0, 0.8), words="mug")} == {MUG, TWIN, 20}
