"""Ids over time against true ids of pixels."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.evaluation.identity import evaluate_identities
from list3r.memory.core.errors import OptionError

LABELS = np.zeros((6, 8), int)
LABELS[:3, :4], LABELS[3:, 4:] = 1, 2


def masks(first: int | None, second: int | None) -> list[tuple[int, np.ndarray]]:
    return [(e, LABELS == k) for k, e in ((1, first), (2, second)) if e is not None]


def test_kept_ids_are_no_switches_even_over_gaps() -> None:
    found = evaluate_identities([(LABELS, masks(10, 20)), (LABELS, masks(None, 20)), (LABELS, masks(10, 20))])
    assert (found.frames, found.objects, found.switches, found.several_ids) == (3, 2, 0, {})


def test_every_change_counts_and_both_things_of_a_swap() -> None:
    rows = [(10, 20), (20, 10), (20, 30), (10, 30)]
    found = evaluate_identities([(LABELS, masks(*row)) for row in rows])
    assert found.switches == 4
    assert found.several_ids == {1: (10, 20), 2: (20, 10, 30)}


def test_a_thing_under_two_masks_keeps_the_id_it_had() -> None:
    wide = LABELS == 1
    wide[0, 4] = True
    both = [(11, LABELS == 1), (10, wide)]
    assert evaluate_identities([(LABELS, masks(10, None)), (LABELS, both)]).switches == 0


def test_poor_masks_and_unwanted_things_do_not_count() -> None:
    poor = [(10, np.ones((6, 8), bool))]
    assert evaluate_identities([(LABELS, poor)]).objects == 0
    assert evaluate_identities([(LABELS, masks(1, 2))], wanted={2}).objects == 1
    assert evaluate_identities([]).frames == 0
    assert evaluate_identities([(LABELS, [(3, np.zeros((6, 8), bool))])]).objects == 0


def test_masks_of_another_size_are_named() -> None:
    with pytest.raises(OptionError, match="one size"):
        evaluate_identities([(LABELS, [(1, np.ones((3, 3), bool))])])
