"""Numbers of many values are those of numpy, whether they fit into memory or not."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.inspect import spreads
from orthoflow_plugins.inspect.spreads import Spread

from orthoflow.geometry.robust import median_deviation


@pytest.mark.parametrize("count", [101, 1000])
@pytest.mark.parametrize("kind", ["even", "ties", "far"])
def test_parts_give_the_numbers_of_the_whole(
    monkeypatch: pytest.MonkeyPatch, count: int, kind: str
) -> None:
    rng = np.random.default_rng(count)
    values = {
        "even": rng.normal(0.001, 0.003, count),
        "ties": rng.integers(-3, 4, count) / 8.0,
        "far": rng.standard_cauchy(count) * 1e9,
    }[kind]
    whole = Spread(values, 1e3)
    assert not whole.is_large
    expected = (
        whole.rms(),
        whole.mean(),
        whole.median(),
        whole.median_deviation(),
        whole.median_deviation(0.5),
        whole.percentile_of_size(99.0),
    )
    assert expected[0] == np.sqrt(np.mean(np.square(1e3 * values)))
    assert expected[1] == np.mean(1e3 * values)
    assert expected[2] == np.median(1e3 * values)
    assert expected[3] == median_deviation(1e3 * values)
    assert expected[5] == np.percentile(np.abs(1e3 * values), 99)
    monkeypatch.setattr(spreads, "_AT_ONCE", 64)
    parts = Spread(values, 1e3)
    assert parts.is_large
    found = (
        parts.rms(),
        parts.mean(),
        parts.median(),
        parts.median_deviation(),
        parts.median_deviation(0.5),
        parts.percentile_of_size(99.0),
    )
    # Medians are the same number, sums and what lies between two values the same to rounding.
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    if count % 2:
        assert found[2:5] == expected[2:5]
