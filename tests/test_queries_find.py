"""find: what a text describes, and that nothing is guessed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Relation
from list3r.memory.store.store import Store
from list3r.queries.find import Found, find
from list3r.queries.finding.grammar import parse
from tests.conftest import write_small_room

FLOOR, TABLE, MUG, TWIN, CHAIR, WALL = range(1, 7)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """The small room: a white and a red mug on a table, a brown chair with a cushion's box beside it."""
    with Store.create(tmp_path_factory.mktemp("find") / "room.l3r") as opened, opened.transaction():
        write_small_room(opened)
        mug, twin = opened.instances.get(MUG), opened.instances.get(TWIN)
        opened.instances.put(
            [
                dataclasses.replace(mug, label="mug", description="small white cylinder, 10 cm", color_name="white"),
                dataclasses.replace(twin, description="small dark red cylinder, 10 cm", color_name="dark red"),
                dataclasses.replace(
                    opened.instances.get(TABLE), description="large brown table, 1.2 m", color_name="brown"
                ),
                dataclasses.replace(opened.instances.get(CHAIR), label="office chair", color_name="brown"),
            ]
        )
        opened.relations.replace(
            [CHAIR], [Relation(CHAIR, "next_to", TABLE, 0.8, 0.1), Relation(TABLE, "next_to", CHAIR, 0.8, 0.1)]
        )
        yield opened


def ids(found: Found) -> list[int]:
    return [m.instance.id for m in found]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mug", [MUG]),
        ("mugs", [MUG]),
        ("the cup", [MUG]),
        ("white mug on table", [MUG]),
        ("white mug on the desk", []),
        ("cylinders on the table", [MUG, TWIN]),
        ("red cylinder", [TWIN]),
        ("dark red things", [TWIN]),
        ("chair next to 2", [CHAIR]),
        ("chair next_to #2", [CHAIR]),
        ("office chair beside the table", [CHAIR]),
        ("brown thing", [TABLE, CHAIR]),
        ("the biggest brown thing", [TABLE]),
        ("smallest brown thing", [CHAIR]),
        ("small thing on 2", [MUG, TWIN]),
        ("anything on 2", [MUG, TWIN]),
        ("floor", [FLOOR]),
        ("3", [MUG]),
        ("thing on the table next to the chair", [MUG, TWIN]),
        ("table with a mug", [TABLE]),
        ("table next to the chair and with a mug", [TABLE]),
        ("mug on chair", []),
        ("white table", []),
        ("elephant", []),
        ("mug on elephant", []),
        ("huge mug", []),
    ],
)
def test_what_a_text_means(store: Store, text: str, expected: list[int]) -> None:
    with_inverses = {"table with a mug", "table next to the chair and with a mug"}
    if text in with_inverses:
        store.relations.replace([], [Relation(TABLE, "supports", MUG, 0.95, 0.02)])
    found = find(store, text, 9)
    assert (sorted(ids(found)) if found.exact else []) == expected
    assert found.exact or all(m.score < 0.7 for m in found)


def test_words_that_nothing_bears_are_named_with_those_that_things_bear(store: Store) -> None:
    found = find(store, "golden elephant on the zebra")
    assert found.unknown_words == ("golden", "elephant", "zebra")
    assert "'elephant'" in found.notes[0] and "table" in found.notes[0]


def test_what_does_not_hold_is_said(store: Store) -> None:
    found = find(store, "white table")
    assert "no instance matches all of the words 'white', 'table'" in found.notes
    assert ids(found) == [TABLE] and not found.exact and found[0].score < 0.7
    found = find(store, "mug on chair")
    assert not found.exact and "on" in found.notes[0] and found.unknown_words == ()


def test_ambiguous_answers_are_ranked_with_reasons(store: Store) -> None:
    found = find(store, "things on the table")
    assert found.ambiguous and "2 instances match" in found.notes[-1]
    assert all("on #2" in m.reason for m in found)
    assert [m.score for m in found] == sorted((m.score for m in found), reverse=True)
    assert found[0].best_view is not None and found[0].best_view.frame_index == 3
    assert ids(find(store, "things on the table", 1)) == ids(found)[:1]


def test_sides_depend_on_who_looks(store: Store) -> None:
    """From x = 0 towards +x the left hand is at +y."""
    here = (0.0, 0.0, 1.0)
    assert ids(find(store, "cylinder left of 4", viewpoint=here)) == [MUG]
    assert ids(find(store, "cylinder right of 3", viewpoint=here)) == [TWIN]
    assert not find(store, "cylinder left of 4", viewpoint=(4.0, 0.0, 1.0)).exact
    assert "as seen from frame 3" in find(store, "mug left of the red cylinder")[0].reason


def test_what_is_between(store: Store) -> None:
    assert MUG not in ids(find(store, "thing between 3 and 4"))


@pytest.mark.parametrize("text", ["", "   ", "!?", "..."])
def test_texts_without_sense_are_refused_in_one_line(store: Store, text: str) -> None:
    with pytest.raises(OptionError) as caught:
        find(store, text)
    assert "\n" not in str(caught.value)


def test_numbers_that_are_no_ids_are_told(store: Store) -> None:
    for text in ("chair next to 77", "99999999999999999999999999", "mug on #0"):
        found = find(store, text)
        assert not found.exact and any("has no instance" in note for note in found.notes)


def test_vertical_relations_are_unknown_without_gravity(store: Store) -> None:
    held = store.relations.all()
    store.relations.replace(None, [r for r in held if r.predicate == "next_to"])
    store.facts.gravity = "unknown"
    try:
        found = find(store, "mug on table")
        assert not found.exact and any("unknown" in n for n in found.notes)
        assert find(store, "is there a mug on the table?").answer is None
        assert ids(find(store, "chair next to table")) == [CHAIR]
    finally:
        store.facts.gravity = "estimated"
        store.relations.replace(None, held)


class Letters:
    """Texts as counts of letters: a space in which words that share letters are alike."""

    space = "letters@1/26"
    min_cosine = 0.95

    def encode(self, text: str) -> np.ndarray:
        return np.array([text.lower().count(chr(97 + k)) for k in range(26)], np.float32)


def test_a_text_encoder_stands_in_where_no_thing_bears_a_word(store: Store) -> None:
    encoder = Letters()
    assert find(store, "elbat", encoder=encoder) == [] and find(store, "elbat").unknown_words == ("elbat",)
    vectors = np.stack([encoder.encode("table"), encoder.encode("xyz")])
    store.embeddings.put(encoder.space, [TABLE, MUG], vectors)
    found = find(store, "elbat", encoder=encoder)
    assert ids(found) == [TABLE] and "cosine 1.00" in found[0].reason and not found.exact and found[0].score < 0.9
    assert ids(find(store, "mug", encoder=encoder)) == [MUG]
    assert ids(find(store, "mug on elbat", encoder=encoder)) == [MUG]


def test_the_grammar_binds_to_the_right_and_and_to_the_first() -> None:
    (phrase,) = parse("white mugs on the table near the door").phrases
    assert (phrase.words, phrase.noun, phrase.meant) == (("white",), ("mug",), ("mug",)) and len(phrase.where) == 1
    assert phrase.where[0].object.noun == ("table",)
    assert phrase.where[0].object.where[0].wording == "near"
    (flat,) = parse("mug on the table and next to 12").phrases
    assert [c.wording for c in flat.where] == ["on", "next to"] and flat.where[1].object.instance_id == 12
    (two,) = parse("lamp between the sofa and the table and near 3").phrases
    assert two.where[0].other is not None and two.where[0].other.noun == ("table",) and two.where[1].wording == "near"
    assert parse("mug to the left of 3").phrases[0].where[0].predicates == ("left_of",)


def test_an_empty_memory_answers_nothing(tmp_path: Path) -> None:
    with Store.create(tmp_path / "empty.l3r") as empty:
        assert find(empty, "white mug on table") == []
        assert find(empty, "thing left of thing") == []
