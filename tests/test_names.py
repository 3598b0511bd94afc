"""What things are called by default: votes of the learned discoverer, and who overrules them."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.evaluation.calibration import calibration
from list3r.instances.geometric.support import without_fliers
from list3r.memory.library.labels import (
    OWN_NAMES,
    LabelSettings,
    decide,
    decide_by_rank,
    votes_of_names,
    votes_of_probabilities,
)


@pytest.mark.parametrize("probability", [0.55, 0.7, 0.9])
def test_one_chunk_gives_the_probability_that_it_was_told(probability: float) -> None:
    votes = {OWN_NAMES: votes_of_probabilities([("chair", probability), ("table", 0.1 * (1 - probability))])}
    said = decide(votes)
    assert said is not None and said[0] == "chair"
    assert said[1] == pytest.approx(probability * (1 - LabelSettings().always_wrong), abs=0.01)


def test_what_is_unsure_stays_unnamed_and_several_chunks_are_as_sure_as_in_the_mean() -> None:
    one = votes_of_probabilities([("chair", 0.45), ("stool", 0.3)])
    assert decide({OWN_NAMES: one}) is None
    sure = votes_of_probabilities([("chair", 0.7)])
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
