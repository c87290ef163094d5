"""Scales of intensities and colours that no file states, or that it states wrongly."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.read import scales
from orthoflow_plugins.read.scales import ColourScale, IntensityScale, choose_scales, normalise

Range = tuple[float, float]


@pytest.mark.parametrize(
    ("seen", "stated", "intensity_max", "scale"),
    [
        ((2.0, 9.0), (0.0, 10.0), 50.0, (0.0, 50.0, "intensity_max")),
        ((2.0, 9.0), (0.0, 10.0), None, (0.0, 10.0, "stated")),
        # A millionth beyond is rounding, more than that is another scale.
        ((0.0, 10.000_005), (0.0, 10.0), None, (0.0, 10.0, "stated")),
        ((-0.000_005, 10.0), (0.0, 10.0), None, (0.0, 10.0, "stated")),
        ((0.0, 10.000_02), (0.0, 10.0), None, (0.0, 10.000_02, "data")),
        ((-0.000_02, 10.0), (0.0, 10.0), None, (-0.000_02, 10.0, "data")),
        # Limits of which the data take less than a quarter are those of the sensor.
        ((0.0, 2.49), (0.0, 10.0), None, (0.0, 2.49, "data")),
        ((0.0, 2.51), (0.0, 10.0), None, (0.0, 10.0, "stated")),
        ((2.0, 9.0), None, None, (2.0, 9.0, "data")),
        ((7.0, 7.0), None, None, (0.0, 7.0, "data")),
        ((-7.0, -7.0), None, None, (-7.0, 0.0, "data")),
    ],
)
def test_a_scan_has_the_users_scale_the_one_it_states_or_that_of_its_data(
    seen: Range, stated: Range | None, intensity_max: float | None, scale: tuple[float, float, str]
) -> None:
    (found,) = choose_scales([seen], [stated], intensity_max)
    assert found is not None
    assert (found.low, found.high, found.rule) == scale
    assert found.stated == (stated if scale[2] == "data" else None)


def test_each_scan_is_scaled_by_its_own_limits_and_similar_ones_together() -> None:
    ranges = [(0.1, 0.9), (7000.0, 60000.0), None, (0.0, 255.0), (5.0, 200.0), (-2048.0, 2047.0)]
    stated = [(0.0, 1.0), (0.0, 65535.0), (0.0, 1.0), None, None, None]
    scales = choose_scales(ranges, stated, None)
    assert scales[2] is None
    assert [(scale.low, scale.high) for scale in scales if scale is not None] == [
        *((0.0, 1.0), (0.0, 65535.0), (0.0, 255.0), (0.0, 255.0), (-2048.0, 2047.0)),
    ]


def test_intensities_go_from_nought_to_one_and_what_lies_beyond_is_clipped_and_counted() -> None:
    scale = IntensityScale(low=10.0, high=30.0, rule="data")
    values = np.array([10.0, 20.0, 30.0, 5.0, 40.0, np.nan, np.inf, -np.inf])
    values = values.astype(np.float32)
    assert normalise(values, scale) == 2
    np.testing.assert_array_equal(values, [0.0, 0.5, 1.0, 0.0, 1.0, np.nan, np.nan, np.nan])
    # A millionth beyond is not worth counting.
    near = np.array([30.0 + 1e-5, 10.0 - 1e-5], dtype=np.float64).astype(np.float32)
    assert normalise(near, scale) == 0
    np.testing.assert_array_equal(near, [1.0, 0.0])


def test_intensity_that_is_the_grey_of_the_colours_is_told_by_either_grey() -> None:
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    luma, mean = (rgb @ [0.299, 0.587, 0.114]).astype(np.float32), rgb.mean(axis=1)
    for grey in (luma, mean.astype(np.float32), 3.0 * luma + 5.0, np.rint(luma)):
        assert (scales.correlation_with_grey(grey, rgb) or 0.0) > 0.999
    assert scales.correlation_with_grey(rng.random(500).astype(np.float32), rgb) is None
    # A scene of two colours correlates with any intensity, but for what lies beyond roundings.
    rgb = np.where(rng.random((500, 1)) < 0.5, 200, 50).astype(np.uint8).repeat(3, axis=1)
    laser = rgb[:, 0] / 255.0 + rng.normal(0.0, 0.005, 500)
    assert scales.correlation_with_grey(laser.astype(np.float32), rgb) is None


def stored(*blocks: np.ndarray, limit: float | None = None) -> tuple[list[list[int]], str | None]:
    count = sum(map(len, blocks))
    into = np.zeros((count, 3), dtype=np.uint8)
    scale = ColourScale(into, limit)
    for block in blocks:
        scale.add(block)
    return into.tolist(), scale.scale


def test_colours_are_of_the_widest_scale_that_any_block_shows() -> None:
    unit = np.array([[0.0, 0.5, 1.0]], dtype=np.float32)
    byte = np.array([[0.0, 128.0, 255.0]], dtype=np.float32)
    word = np.array([[0, 128 * 257, 255 * 256]], dtype=np.uint16)
    assert stored(unit) == ([[0, 128, 255]], "0..1")
    assert stored(byte) == ([[0, 128, 255]], "8 bit")
    assert stored(word) == ([[0, 128, 255]], "16 bit")
    # Zeros and ones are full brightness until a block says that they are of 255.
    ones = np.array([[0.0, 1.0, 1.0]], dtype=np.float32)
    assert stored(ones) == ([[0, 255, 255]], "0..1")
    assert stored(ones, byte) == ([[0, 1, 1], [0, 128, 255]], "8 bit")
    # What was below 256 of 65536 is all but black.
    assert stored(byte, word) == ([[0, 0, 1], [0, 128, 255]], "16 bit")
    assert stored(word, byte) == ([[0, 128, 255], [0, 0, 0]], "16 bit")
    assert stored(byte, unit) == ([[0, 128, 255], [0, 0, 1]], "8 bit")


@pytest.mark.parametrize(
    ("largest", "limit", "expected", "scale"),
    [
        (1.0, 1.0, [0, 102, 255], "0..1"),
        (255.0, 255.0, [0, 102, 255], "8 bit"),
        (65535.0, 65535.0, [0, 102, 255], "16 bit"),
        (1023.0, 1023.0, [0, 102, 255], "stated limit"),
        (1023.0, None, [0, 102, 255], "10 bit"),
        (4095.0, None, [0, 102, 255], "12 bit"),
        (4095.0, 1023.0, [0, 102, 255], "12 bit"),
        # What does not fit its limit is read as what it is.
        (255.0, 1.0, [0, 102, 255], "8 bit"),
        (255.0, 65535.0, [0, 102, 255], "8 bit"),
        (65535.0, 255.0, [0, 102, 255], "16 bit"),
    ],
)
def test_a_stated_limit_is_full_brightness_where_data_fit_it(
    largest: float, limit: float | None, expected: list[int], scale: str
) -> None:
    block = np.array([[0.0, 0.4 * largest, largest]])
    assert stored(block, limit=limit) == ([expected], scale)
    colours = ColourScale(np.zeros((1, 3), dtype=np.uint8), limit)
    colours.add(block)
    assert colours.misfit == (limit if limit != largest else None)
