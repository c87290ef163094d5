"""Two products are compared number by number, within limits that carry a unit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_provenance.arrays import ArrayDifference, Tolerances, measure_payloads
from orthoflow_provenance.document import JsonValue, PayloadLike

from tests.provenance_records import Given

LIMITS = {"depth_m": (1e-4, "m"), "gsd_m": (1e-6, "m"), "rgb": (2.0, "grey")}


def beyond_limits(
    left: PayloadLike, right: PayloadLike, tolerances: Tolerances
) -> tuple[ArrayDifference, ...]:
    measured = measure_payloads(left, right, tolerances)
    return tuple(difference for difference in measured if difference.n_values)


def compare(
    left: NDArray[np.generic], right: NDArray[np.generic], name: str = "walls/0/depth_m"
) -> tuple[ArrayDifference, ...]:
    return beyond_limits(Given(arrays={name: left}), Given(arrays={name: right}), LIMITS)


def test_a_difference_within_the_limit_is_none_and_beyond_it_is_measured() -> None:
    depth = np.zeros((4, 5))
    moved = depth.copy()
    moved[1, 2], moved[3, 3] = 9e-5, -0.25
    assert compare(depth, np.where(moved < 0, 0, moved)) == ()
    (difference,) = compare(depth, moved)
    assert difference == ArrayDifference(
        name="walls/0/depth_m",
        largest=0.25,
        limit=1e-4,
        unit="m",
        n_values=1,
        problem="1 of 20 values differ by more than 0.0001 m, the largest by 0.25",
    )


def test_nan_equals_nan_and_nothing_else() -> None:
    left = np.array([np.nan, 1.0, np.nan])
    assert compare(left, left.copy()) == ()
    (difference,) = compare(left, np.array([np.nan, np.nan, 1.0]))
    assert (difference.largest, difference.n_values) == (math.inf, 2)


def test_unsigned_integers_do_not_wrap_around() -> None:
    left, right = np.array([0], dtype=np.uint8), np.array([2], dtype=np.uint8)
    assert compare(left, right, "rgb") == ()
    assert compare(right, left, "rgb") == ()


@pytest.mark.parametrize(
    ("right", "problem"),
    [
        (np.zeros((5, 4)), "float64 of shape (4, 5) versus float64 of shape (5, 4)"),
        (
            np.zeros((4, 5), dtype=np.float32),
            "float64 of shape (4, 5) versus float32 of shape (4, 5)",
        ),
    ],
)
def test_other_shapes_and_types_cannot_be_compared(
    right: NDArray[np.generic], problem: str
) -> None:
    (difference,) = compare(np.zeros((4, 5)), right)
    assert (difference.problem, difference.largest) == (problem, math.inf)


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        ({"walls": [{"gsd_m": 0.01}]}, {"walls": [{"gsd_m": 0.0100005}]}, []),
        (
            {"walls": [{"gsd_m": 0.01}]},
            {"walls": [{"gsd_m": 0.02}]},
            [("walls/0/gsd_m", "0.01 versus 0.02; the limit is 1e-06 m")],
        ),
        ({"a": 1}, {"a": 1.0}, []),
        ({"a": 1}, {"a": 2}, [("a", "1 versus 2; the limit is 0")]),
        ({"a": 1000.0}, {"a": 1000.0009}, []),
        ({"a": 1e-8}, {"a": 9e-7}, []),
        (
            {"a_px": 1000.0},
            {"a_px": 1000.002},
            [("a_px", "1000 versus 1000; the limit is 0.001 px")],
        ),
        ({"a": 1}, {"a": True}, [("a", "1 versus True")]),
        ({"a": "x"}, {"a": "y"}, [("a", "'x' versus 'y'")]),
        ({"a": [1]}, {"a": [1, 2]}, [("a", "[1] versus [1, 2]")]),
        ({"a": None}, {}, [("a", "it exists in only one of the products")]),
    ],
)
def test_metadata_are_compared_value_by_value(
    left: dict[str, JsonValue], right: dict[str, JsonValue], expected: list[tuple[str, str]]
) -> None:
    found = beyond_limits(Given(metadata=left), Given(metadata=right), LIMITS)
    assert [(difference.name, difference.problem) for difference in found] == expected
