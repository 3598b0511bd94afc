"""What things are called by default: votes of the learned discoverer, and who overrules them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.calibration import calibration
from list3r.instances.geometric.support import without_fliers
from list3r.instances.learned.name_confidence import NameConfidence, NameSigns, name_signs, with_confidence
from list3r.memory.core.description.nouns import is_a
from list3r.memory.library.labels import (
    OWN_NAMES,
    LabelSettings,
    decide,
    decide_by_rank,
    decide_kind,
    votes_of_names,
    votes_of_probabilities,
)


@pytest.mark.parametrize("probability", [0.67, 0.75, 0.9])
def test_one_chunk_gives_the_probability_that_it_was_told(probability: float) -> None:
    votes = {OWN_NAMES: votes_of_probabilities([("chair", probability), ("table", 0.1 * (1 - probability))])}
    said = decide(votes)
    assert said is not None and said[0] == "chair"
    assert said[1] == pytest.approx(probability * (1 - LabelSettings().always_wrong), abs=0.01)


def test_what_is_unsure_stays_unnamed_and_several_chunks_are_as_sure_as_in_the_mean() -> None:
    one = votes_of_probabilities([("chair", 0.45), ("stool", 0.3)])
    assert decide({OWN_NAMES: one}) is None
    sure = votes_of_probabilities([("chair", 0.85)])
    single, double = decide({OWN_NAMES: sure}), decide({OWN_NAMES: sure + sure})
    assert single is not None and double is not None and double[1] == pytest.approx(single[1])
    doubted = decide({OWN_NAMES: sure + one})
    assert doubted is not None and doubted[1] < single[1]


def test_a_detector_overrules_the_discoverer() -> None:
    own = votes_of_probabilities([("chair", 0.95)])
    detector = votes_of_names([("couch", 0.7)] * 6)
    alone, both = decide({"detector": detector}), decide_by_rank({OWN_NAMES: own, "detector": detector})
    assert alone is not None and alone[0] == "couch" and both == alone
    silent = decide_by_rank({OWN_NAMES: own, "detector": votes_of_names([])})
    assert silent is not None and silent[0] == "chair"


def test_what_a_detector_says_must_be_surer_than_what_only_the_discoverer_says() -> None:
    votes = votes_of_probabilities([("chair", 0.75)])
    assert decide({"detector": votes}) is not None
    assert decide_by_rank({"detector": votes}) is None
    assert decide_by_rank({OWN_NAMES: votes}) == decide({OWN_NAMES: votes})
    lenient = replace(LabelSettings(), min_detected=0.5)
    assert decide_by_rank({"detector": votes}, settings=lenient) == decide({"detector": votes})
    assert decide_by_rank({OWN_NAMES: votes_of_probabilities([("chair", 0.6)])}) is None


def test_an_unsure_detector_neither_adds_a_name_nor_takes_one_away() -> None:
    sure, unsure, other = (
        votes_of_probabilities([v]) for v in (("table", 0.75), ("table", 0.55), ("dining table", 0.75))
    )
    assert decide_by_rank({OWN_NAMES: unsure, "detector": other}) is None
    assert decide_by_rank({OWN_NAMES: sure, "detector": other}) == decide_by_rank({OWN_NAMES: sure}) is not None


def test_names_that_are_unsure_alone_make_the_kind_that_they_share_sure() -> None:
    seats = {OWN_NAMES: votes_of_probabilities([("chair", 0.5), ("stool", 0.3), ("armchair", 0.19)])}
    assert decide_by_rank(seats) is None
    kind = decide_kind(seats)
    assert kind is not None and kind[0] == "seat" and kind[1] == pytest.approx(0.97 * 0.99, abs=0.02)
    assert decide_kind({OWN_NAMES: votes_of_probabilities([("chair", 0.5), ("lamp", 0.49)])}) is None
    chairs = {OWN_NAMES: votes_of_probabilities([("chair", 0.55), ("armchair", 0.44)])}
    assert (decide_kind(chairs) or [""])[0] == "chair", "the narrowest kind that is sure"


@given(st.lists(st.sampled_from(["chair", "stool", "sofa", "desk", "mug", "bowl"]), min_size=1, unique=True), st.data())
def test_a_kind_is_at_least_as_probable_as_each_name_in_it(names: list[str], data: st.DataObject) -> None:
    shares = data.draw(st.lists(st.floats(0.01, 1.0), min_size=len(names), max_size=len(names)))
    named = [(n, 0.97 * s / sum(shares)) for n, s in zip(names, shares, strict=True)]
    votes, lenient = {OWN_NAMES: votes_of_probabilities(named)}, LabelSettings(min_branch=0.0, min_confidence=0.0)
    leaf, kind = decide(votes, settings=lenient), decide_kind(votes, settings=replace(lenient, min_branch=0.9))
    assert leaf is not None and (kind is None or kind[1] >= 0.9)
    if kind is not None and is_a(leaf[0], kind[0]):
        assert kind[1] >= leaf[1] - 1e-9


@given(st.integers(0, 10_000))
def test_what_is_believed_keeps_the_likeliest_name_and_adds_up_to_no_more_than_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = rng.dirichlet(np.full(6, 0.5), 5) * rng.uniform(0.05, 1.0, (5, 1))
    right = rng.uniform(0.0, 1.0, 5)
    out = with_confidence(names, right)
    rows, best = np.arange(5), names.argmax(axis=1)
    assert np.allclose(out[rows, best], right)
    assert (out >= 0.0).all() and (out.sum(axis=1) <= 1.0 + 1e-9).all()
    less = right <= names[rows, best]
    assert (out.argmax(axis=1) == best)[less].all()


def test_a_name_is_believed_less_in_a_room_full_of_doubt_and_of_what_is_no_whole() -> None:
    belief, whole = NameConfidence(), np.full(10, 0.9)
    sure = np.array([[0.9, 0.1]])
    names = np.concatenate([sure, np.repeat([[0.35, 0.3]], 9, axis=0)])
    alone = belief.probability(name_signs(sure, whole[:1], np.zeros(1)))[0]
    among = belief.probability(name_signs(names, whole, np.zeros(10)))[0]
    walls = belief.probability(name_signs(names, whole, np.array([0.0] + 9 * [1.0])))[0]
    assert among < alone and walls == pytest.approx(alone), "structure has no names"
    signs = NameSigns(np.array([2.0, 2.0]), np.array([0.9, 0.4]), 1.0)
    assert np.diff(belief.probability(signs))[0] < 0.0


def test_readings_that_fly_are_left_out_and_small_things_kept() -> None:
    rng = np.random.default_rng(0)
    box = rng.uniform(0, 0.2, (4000, 3)).astype(np.float32)
    flying = (np.array([0.5, 0.0, 0.0]) + rng.uniform(0, 0.3, (12, 3))).astype(np.float32)
    kept = without_fliers(np.concatenate([box, flying]), 1.0)
    assert len(kept) > 3900 and kept.max() < 4000
    assert np.array_equal(without_fliers(flying, 1.0), np.arange(12))


def test_calibration_is_none_where_probabilities_are_kept() -> None:
    rng = np.random.default_rng(3)
    stated = rng.uniform(0, 1, 20000)
    held = calibration(stated, rng.uniform(0, 1, 20000) < stated)
    boast = calibration(np.full(200, 0.95), np.arange(200) % 2 == 0)
    assert held["ece"] < 0.02 and boast["ece"] == pytest.approx(0.45)
    assert held["right_at_0.6"] > held["right_at_1"]
