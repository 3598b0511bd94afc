"""The table of nouns: a tree, with every name in seven languages, and what of it names an instance."""

from __future__ import annotations

from importlib.resources import files

import pytest
from hypothesis import given
from hypothesis import strategies as st

from list3r.memory.core.description.nouns import (
    LANGUAGES,
    all_nouns,
    is_a,
    kinds_of,
    names,
    narrower,
    nouns_of,
    raw_words,
)
from list3r.memory.core.description.spelling import split_words
from list3r.memory.core.description.words import kind_word, vocabulary

NOUNS = st.sampled_from(sorted(all_nouns()))


def plural(name: str) -> str:
    """The plural as people write it."""
    irregular = {"knife": "knives", "shelf": "shelves", "mouse": "mice", "person": "people", "scarf": "scarves"}
    if " of " in name:
        head, _, rest = name.partition(" of ")
        return f"{plural(head)} of {rest}"
    head, _, last = name.rpartition(" ")
    if last in irregular or (last.endswith("s") and not last.endswith(("ss", "us"))):
        last = irregular.get(last, last)
    elif last.endswith("shelf"):
        last = last.removesuffix("f") + "ves"
    elif last.endswith(("s", "x", "ch", "sh")) or last in ("potato", "tomato"):
        last += "es"
    elif last.endswith("y") and last[-2] not in "aeiou":
        last = last[:-1] + "ies"
    else:
        last += "s"
    return f"{head} {last}".strip()


def test_the_tree_has_no_cycle_and_no_gap() -> None:
    for name, noun in all_nouns().items():
        assert name not in kinds_of(name) and set(noun.broader) <= set(all_nouns())
        assert all(name in narrower(kind) for kind in noun.broader)


def test_it_holds_what_homes_and_offices_hold() -> None:
    assert len(all_nouns()) >= 500
    leaves = [n for n in all_nouns().values() if not narrower(n.name)]
    sized = [n for n in leaves if n.size_cm is not None]
    assert len(sized) > 0.95 * len(leaves)
    assert all(0 < n.size_cm[0] < n.size_cm[1] for n in sized if n.size_cm)


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_thing_has_a_name_in_every_language_that_leads_to_it(language: str) -> None:
    of = {text for n in all_nouns().values() for text in (n.name, *n.synonyms)}
    english = {words for text in of for words in (raw_words(text), tuple(split_words(text)))}
    for noun in all_nouns().values():
        assert noun.foreign[language] or noun.size_cm is None
        for word in noun.foreign[language]:
            assert noun.name in names()[raw_words(word)] or raw_words(word) in english


def test_plurals_and_other_names_lead_to_the_same_noun() -> None:
    for name, noun in all_nouns().items():
        assert name in (*names().get(tuple(split_words(plural(name))), ()), *nouns_of(plural(name)))
        assert all(name in names()[raw_words(s)] for s in noun.synonyms)


@given(NOUNS, NOUNS)
def test_kinds_are_transitive(a: str, b: str) -> None:
    assert is_a(a, a)
    if is_a(a, b):
        assert set(kinds_of(b)) <= set(kinds_of(a))


def test_facts() -> None:
    assert kinds_of("chair")[0] == "seat" and is_a("chair", "furniture") and not is_a("seat", "chair")
    assert is_a("cup", "drinking vessel") and is_a("cup", "container")
    low, high = all_nouns()["mug"].size_cm or (0.0, 0.0)
    assert 5 <= low < high <= 20
    assert "sit on" in all_nouns()["seat"].uses and "sleep in" in all_nouns()["bed"].uses
    assert is_a("Stuhl", "furniture") and nouns_of("old office chairs") == ("office chair", "chair")
    assert "bear" not in nouns_of("teddy bear") and nouns_of("pile of books") == ("book",)


def test_an_instance_is_kept_under_what_it_is_called() -> None:
    words = vocabulary("black office chair", None, "large black box, 1.0 m", "black")
    assert words[kind_word("office chair")] == 1.0 and 0.9 < words[kind_word("chair")] < 1.0
    assert kind_word("box") not in words
    assert vocabulary(None, None, "large brown table, 1.2 m", "brown")[kind_word("table")] == 0.9
    assert kind_word("desk") in vocabulary("desk lamp desk", None, "", "")
    assert kind_word("desk") not in vocabulary("desk lamp", None, "", "")


def test_the_licence_of_wordnet_lies_beside_the_table() -> None:
    folder = files("list3r.memory.core.description")
    assert "WordNet 3.0 Copyright" in (folder / "nouns.LICENSE.txt").read_text()
    assert len((folder / "nouns.tsv").read_bytes()) < 150_000
