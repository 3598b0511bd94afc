"""Medians and quantiles are NumPy's, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.reconstruction.order_statistics import median, medians, quantile


@pytest.mark.parametrize("count", [1, 2, 3, 7, 50, 301])
def test_medians_and_quantiles_are_those_of_numpy_to_the_last_bit(count: int) -> None:
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=count), rng.integers(0, 4, count).astype(np.float64)):
        assert median(values) == np.median(values)
        for share in (0.0, 0.1, 0.5, 0.8, 1.0):
            assert quantile(values, share) == np.quantile(values, share)
    colors = rng.uniform(0, 255, (count, 3)).astype(np.float32)
    assert np.array_equal(medians(colors), np.median(colors, axis=0))
