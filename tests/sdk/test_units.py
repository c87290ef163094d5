"""Units that names of parameters and metrics say."""

from __future__ import annotations

import pytest

from orthoflow.sdk.units import unit_of


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("tolerance_m", "m"),
        ("area_min_m2", "m2"),
        ("area_m2_min", "m2"),
        # The last word that is a unit.
        ("m_per_px", "px"),
        ("spacing_mm_max", "mm"),
        ("memory_mib", "MiB"),
        ("offset_grey", "grey levels"),
        ("limit_sigma", "sigmas"),
        ("seen_share", "1"),
        ("share", "1"),
        ("power", "1"),
        # A name alone is no length.
        ("m", ""),
        ("deg", ""),
        ("n_trials", ""),
        ("radius", ""),
    ],
)
def test_the_last_word_that_is_a_unit_is_one(name: str, unit: str) -> None:
    assert unit_of(name) == unit
