"""Training weights further."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.instances.learned.weights import COMPUTED, SHIPPED, load_weights


def test_a_mean_of_weights_lies_between_the_networks_and_has_the_new_judge() -> None:
    pytest.importorskip("torch")
    from training.further import mean_of

    before, after = load_weights(SHIPPED), load_weights(COMPUTED)
    for kept in (0.0, 0.25, 1.0):
        mean = mean_of(before, after, kept)
        assert mean.keys() == after.keys()
        for name, value in mean.items():
            if name.startswith(("fine.", "coarse.")):
                expected = kept * before[name] + (1 - kept) * after[name]
                np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-7)
            else:
                assert np.array_equal(value, after[name])
