"""What was meant by numbers that are written as people write them."""

from __future__ import annotations

import math

import pytest

from orthoflow.workflow.hints import meant_number, meant_parameter


@pytest.mark.parametrize(
    ("parameter", "text", "said"),
    [
        ("gsd_m", "0,003", "; decimals have a point: 0.003"),
        ("gsd_m", "3mm", "; it is in metres, and no unit stands behind it: 0.003"),
        ("gsd_m", "5 cm", "; it is in metres, and no unit stands behind it: 0.05"),
        ("gsd_m", "0,5 cm", "; it is in metres, and no unit stands behind it: 0.005"),
        ("max_tilt_deg", "10°", "; it is in degrees, and no unit stands behind it: 10"),
        ("noise_mm", "0.002 m", "; it is in millimetres, and no unit stands behind it: 2"),
        ("min_share", "5 m", "; no unit stands behind a number"),
        ("gsd_m", "5 deg", "; no unit stands behind a number"),
        ("gsd_m", "0.003", "; write it without quotes"),
        ("gsd_m", "fine", ""),
        ("gsd_m", "1.2.3", ""),
        ("gsd_m", [1], ""),
    ],
)
def test_a_number_in_words_gets_its_value(parameter: str, text: object, said: str) -> None:
    assert meant_number(parameter, text) == said


@pytest.mark.parametrize(
    ("parameter", "words", "units"),
    [
        (
            "gsd_m",
            "metres",
            {"m": 1, "dm": 0.1, "cm": 0.01, "mm": 0.001, "um": 1e-6, "µm": 1e-6, "km": 1000},
        ),
        ("noise_mm", "millimetres", {"mm": 1, "um": 0.001, "m": 1000}),
        ("tilt_deg", "degrees", {"deg": 1, "°": 1, "rad": 180 / math.pi, "gon": 360 / 400}),
        ("tilt_rad", "radians", {"rad": 1, "°": math.pi / 180}),
        ("limit_s", "seconds", {"s": 1, "ms": 0.001, "min": 60, "h": 60 * 60}),
        ("shift_px", "px", {"px": 1}),
    ],
)
def test_units_of_one_family_are_reckoned_into_each_other(
    parameter: str, words: str, units: dict[str, float]
) -> None:
    for unit, factor in units.items():
        assert meant_number(parameter, f"3 {unit}") == (
            f"; it is in {words}, and no unit stands behind it: {3 * factor:g}"
        )


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("gsd_mm", 50, " (it is gsd_m, in metres: gsd_m: 0.05)"),
        ("gsd_cm", "5", " (it is gsd_m, in metres)"),
        ("tilt_rad", math.pi, " (it is tilt_deg, in degrees: tilt_deg: 180)"),
        ("tilt_m", 1, ""),
        ("gsd_m", 1, ""),
        ("mm", 1, ""),
        ("gsd_mm", True, " (it is gsd_m, in metres)"),
    ],
)
def test_a_name_with_another_unit_is_led_to_ours(name: str, value: object, said: str) -> None:
    assert meant_parameter(name, ["crs", "gsd_m", "tilt_deg"], value) == said  # type: ignore[arg-type]
