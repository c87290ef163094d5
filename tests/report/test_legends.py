"""Scale bars and colour bars are as long and as wide as they say."""

from __future__ import annotations

import re

import pytest

from orthoflow.report.legends import depth_bar, length_words, round_length_m, scale_bar


@pytest.mark.parametrize("width_m", [0.013, 0.9, 5.4, 31.0, 740.0])
def test_a_bar_is_as_long_as_it_says(width_m: float) -> None:
    drawn = scale_bar(width_m)
    share = float(re.findall(r'rect class="ink" x="1" y="3" width="([0-9.]+)%"', drawn)[0]) / 100
    number, unit = re.findall(r">([0-9.]+) (c?m)</text>", drawn)[0]
    said_m = float(number) * (0.01 if unit == "cm" else 1.0)
    assert share * width_m == pytest.approx(said_m, rel=1e-3)
    assert 0.1 <= share <= 0.3


def test_lengths_are_round() -> None:
    assert [round_length_m(most) for most in (0.999, 1.0, 4.9, 5.1, 23.0)] == [0.5, 1, 2, 5, 20]
    assert [length_words(length) for length in (0.001, 0.5, 1.0, 200.0)] == [
        "0.1 cm",
        "50 cm",
        "1 m",
        "200 m",
    ]


def test_the_colours_of_depth_name_their_ends() -> None:
    drawn = depth_bar(0.251)
    assert ">-251 mm (behind)</text>" in drawn
    assert ">+251 mm (before)</text>" in drawn
