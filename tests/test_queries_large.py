"""Questions to a memory that is too large to look at all of it have the answers that looking at all of it gives."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import Instance, Relation
from list3r.memory.store.store import Store
from list3r.queries.find import find
from list3r.queries.match import Match
from list3r.queries.nearest import nearest
from list3r.queries.relations import relations
from list3r.queries.seen import visible
from list3r.queries.views import gather, visibility
from list3r.queries.views.camera import PosedCamera
from tests.conftest import instance

COUNT = 400
COLORS, SHAPES, LABELS = (
    ("red", "blue", "dark green"),
    ("box", "sheet", "cylinder"),
    (None, None, "mug", "office chair"),
)


def things(rng: np.random.Generator) -> Iterator[Instance]:
    for n in range(1, COUNT + 1):
        center, size = rng.uniform([0, 0, 0], [9, 9, 3]), rng.uniform(0.05, 0.8, 3)
        yield replace(
            instance(n, tuple(center), tuple(size), (200, 30, 30)),
            label=LABELS[n % 4],
            description=f"small {COLORS[n % 3]} {SHAPES[n % 5 % 3]}, 9 cm",
            structure="wall" if n % 97 == 0 else None,
            color_name=COLORS[n % 3],
            confidence=n % 7 / 7,
        )


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    rng = np.random.default_rng(0)
    with Store.create(tmp_path_factory.mktemp("large") / "large.l3r") as made:
        with made.transaction():
            made.facts.gravity = "known"
            made.instances.put(things(rng))
            pairs = rng.integers(1, COUNT + 1, (900, 2)).tolist()
            kinds = ("near", "on", "next_to")
            made.relations.replace(
                None, [Relation(a, kinds[k % 3], b, 0.5 + k / 2000, 0.1) for k, (a, b) in enumerate(pairs) if a != b]
            )
        yield made


def plain(matches: list[Match]) -> list[tuple[object, ...]]:
    return [(m.instance.id, m.score, m.distance_m, m.reason) for m in matches]


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(gather, "EVERYTHING", COUNT)
    return monkeypatch


TEXTS = [
    "mug",
    "red mug",
    "dark green office chair",
    "red mug on blue box",
    "box near mug",
    "mug near the wall",
    "chair next to 12",
    "thing on 30",
    "red thing on a blue sheet near a chair",
    "the biggest blue cylinder",
    "wall",
    "9",
    "mug between 4 and 8",
    "zebra",
    "red zebra on mug",
    "red blue",
    "small mug",
    "large red box near chair",
    "red box near blue table",
]


@pytest.mark.parametrize("text", TEXTS)
def test_find_answers_alike(store: Store, text: str, large: pytest.MonkeyPatch) -> None:
    wanted = find(store, text, k=30)
    large.setattr(gather, "EVERYTHING", 0)
    found = find(store, text, k=30)
    assert plain(found) == plain(wanted)
    assert found.unknown_words == wanted.unknown_words and bool(found.notes) == bool(wanted.notes)


@pytest.mark.parametrize("words", ["mug", "red mug", "mug zebra", "zebra"])
def test_words_stand_for_the_same_things(store: Store, words: str, large: pytest.MonkeyPatch) -> None:
    def ask() -> list[object]:
        return [
            plain(nearest(store, words=words, k=9)),
            plain(nearest(store, words=words, point=(4.0, 4.0, 1.0), k=9)),
            plain(nearest(store, words=words, instance_id=7, k=9, color="red")),
            list(relations(store, words, "near", None)),
        ]

    wanted = ask()
    large.setattr(gather, "EVERYTHING", 0)
    assert ask() == wanted


@pytest.mark.parametrize("predicates", [("near",), ("on", "next_to"), ("in",)])
def test_pairs_are_those_of_the_relations_and_follow_what_is_written(store: Store, predicates: tuple[str, ...]) -> None:
    some, others = range(1, COUNT, 2), range(5, COUNT)

    def pairs(subjects: range | None, objects: range | None) -> list[tuple[int, int]]:
        return sorted(store.relations.pairs(predicates, subjects, objects))

    def expected(subjects: range | None, objects: range | None) -> list[tuple[int, int]]:
        held = [(r.subject, r.object) for r in store.relations.all() if r.predicate in predicates]
        return sorted(
            (a, b) for a, b in held if (subjects is None or a in subjects) and (objects is None or b in objects)
        )

    for ends in ((some, others), (others, some), (some, None), (None, some), (range(0), others)):
        assert pairs(*ends) == expected(*ends)
    before = pairs(some, others)
    with contextlib.suppress(ZeroDivisionError), store.transaction():
        store.relations.replace([], [Relation(1, predicates[0], COUNT - 1, 0.9, 0.1)])
        assert pairs(some, others) == sorted({*before, (1, COUNT - 1)})
        raise ZeroDivisionError
    assert pairs(some, others) == before


def test_what_is_common_is_looked_for_around_the_place(store: Store, large: pytest.MonkeyPatch) -> None:
    wanted = nearest(store, words="mug", point=(4.0, 4.0, 1.0), k=9)
    large.setattr(gather, "EVERYTHING", 0)
    large.setattr("list3r.queries.find._COMMON", 10)
    found = nearest(store, words="mug", point=(4.0, 4.0, 1.0), k=9)
    assert [(m.instance.id, m.distance_m) for m in found] == [(m.instance.id, m.distance_m) for m in wanted]


@pytest.mark.parametrize("depth", [None, 2.5])
def test_a_camera_sees_what_it_saw(store: Store, depth: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    for _ in range(6):
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        pose[:3, 3] = rng.uniform(0, 9, 3)
        camera = PosedCamera(pose, (300.0, 300.0, 159.5, 119.5), (240, 320), 1, 1)
        found = plain(visible(store, camera, min_visible=0.0, max_depth=depth))
        with monkeypatch.context() as patch:
            patch.setattr("list3r.queries.seen.in_front", lambda store, *_: store.instances.all())
            assert plain(visible(store, camera, min_visible=0.0, max_depth=depth)) == found
        with monkeypatch.context() as patch:
            patch.setattr(visibility, "_MANY", 0)
            few = {m.instance.id for m in visible(store, camera, min_visible=0.0, max_depth=depth)}
        assert few <= {row[0] for row in found}


def test_what_is_left_out_is_said(store: Store, large: pytest.MonkeyPatch) -> None:
    large.setattr(gather, "EVERYTHING", 10)
    large.setattr("list3r.queries.relations._MOST_NAMED", 20)
    large.setattr("list3r.queries.find._COMMON", 20)
    large.setattr(gather, "_MOST", 20)
    assert "more than 20 instances match 'red'; 20 of them" in relations(store, subject="red").reason
    assert relations(store, subject=7).reason == ""
    found = nearest(store, words="red box")
    assert len(found) == 5 and "instances match 'red box'; 20 of them were considered" in found.notes[0]
    assert nearest(store, words="red box", point=(4, 4, 1)).notes == ()


def test_what_nothing_bears_is_said(store: Store, large: pytest.MonkeyPatch) -> None:
    large.setattr(gather, "EVERYTHING", 10)
    for said in (nearest(store, words="zebra").notes[0], relations(store, subject="zebra").reason):
        assert said.startswith("no instance has the word 'zebra' in its label or description; frequent names: ")


DAMAGES = (
    "UPDATE instances SET confidence = 1 - confidence WHERE id = ?",
    "UPDATE instances SET state = 'removed' WHERE id = ?",
    "UPDATE instances SET structure = CASE WHEN structure IS NULL THEN 'wall' END WHERE id = ?",
    "UPDATE instances SET label = 'red box' WHERE id = ?",
    "UPDATE instances SET description = 'blue sheet' WHERE id = ?",
    "UPDATE words_data SET block = CAST(block || x'00' AS BLOB) WHERE id > ?",
)


@pytest.mark.parametrize("damage", DAMAGES)
def test_find_in_a_large_damaged_file_answers_as_in_a_sound_one_or_refuses(
    store: Store, damage: str, large: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    large.setattr(gather, "EVERYTHING", 0)
    texts = ("red box", "mug", "red", "wall")
    wanted = {text: plain(find(store, text)) for text in texts}
    pages = store.connection._database.serialize("main")
    refused = 0
    for n in range(2, 62, 5):
        path = tmp_path / f"{n}.l3r"
        path.write_bytes(pages)
        with contextlib.closing(sqlite3.connect(path)) as database, database:
            database.execute(damage, (n,))
        with Store.open(path) as damaged:
            for text in texts * 2:
                try:
                    assert plain(find(damaged, text)) == wanted[text], (n, text)
                except MemoryFileError as error:
                    assert "repair" in str(error)
                    refused += 1
    assert refused
