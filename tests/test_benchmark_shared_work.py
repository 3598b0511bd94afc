"""Work shared by variants of the association benchmark: equal arguments give the result there is, others a new one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks.shared_work import SharedWork, digest
from list3r.association.overlap.alignment import AlignmentSettings
from list3r.association.revisits import joint_window
from list3r.memory.core.errors import DegenerateError


@dataclass(frozen=True)
class Record:
    values: np.ndarray
    names: frozenset[str] = frozenset()


def test_fingerprints_tell_every_part_of_the_arguments() -> None:
    a = np.arange(6.0)
    known = [a, a.reshape(2, 3), a.astype(np.float32), Record(a), Record(a, frozenset("x")), (a, 1), (a, 2), None]
    assert len({digest(k) for k in known}) == len(known)
    assert digest(Record(a.copy(), frozenset("xy"))) == digest(Record(a, frozenset("yx")))
    settings = AlignmentSettings()
    assert digest(settings) == digest(replace(settings))


def test_a_stage_is_asked_once_for_equal_arguments_and_fails_alike() -> None:
    rng = np.random.default_rng(1)
    p, weight, frame = rng.standard_normal((60, 3)), np.ones(60), np.repeat(np.arange(6), 10)
    plain = joint_window.align(p, 2.0 * p, weight, frame, False)
    work = SharedWork()
    with work.used():
        first = joint_window.align(p, 2.0 * p, weight, frame, False)
        assert joint_window.align(p.copy(), 2.0 * p, weight, frame, False) is first
        assert joint_window.align(p, 3.0 * p, weight, frame, False) is not first
        for _ in range(2):
            with pytest.raises(DegenerateError):
                joint_window.align(p[:2], p[:2], weight[:2], frame[:2], False)
    assert np.array_equal(first.S_v_u.as_matrix(), plain.S_v_u.as_matrix())
    assert joint_window.align.__name__ == "align"


def test_a_joint_window_is_made_once() -> None:
    asked = []
    ask = SharedWork().joint(lambda *ends: asked.append(ends) or len(asked))
    assert ask(1, [1, 2], 1, [5]) == ask(1, (1, 2), 1, (5,)) == 1
    assert ask(1, [1, 3], 1, [5]) == 2
