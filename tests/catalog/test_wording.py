"""Names that a misspelt one may stand for, and how much is compared and said."""

from __future__ import annotations

import pytest

from orthoflow.catalog.wording import describe_error, did_you_mean, nearest


@pytest.mark.parametrize(
    ("name", "near"), [("hugh2d", "hough2d"), ("ransac3", "ransac"), ("zzz", ""), ("", "")]
)
def test_the_nearest_name_is_given_where_one_is_near(name: str, near: str) -> None:
    assert nearest(name, {"ransac", "hough2d", "region"}) == near
    assert did_you_mean(name, ["hough2d", "ransac"]) == (f" (did you mean {near}?)" if near else "")


def test_three_letters_of_five_are_near_enough() -> None:
    # Twice the letters in common over all letters: 6 of 10, and 5 of 9.
    assert nearest("abcxy", ["abczw"]) == "abczw"
    assert nearest("abxyz", ["abcd"]) == ""


@pytest.mark.parametrize(("n_known", "near"), [(1000, "name0007"), (1001, "")])
def test_a_thousand_names_are_compared_and_no_more(n_known: int, near: str) -> None:
    assert nearest("nane0007", (f"name{k:04}" for k in range(n_known))) == near


@pytest.mark.parametrize(("n_letters", "is_compared"), [(200, True), (201, False)])
def test_names_of_two_hundred_letters_are_compared_and_no_longer_ones(
    n_letters: int, is_compared: bool
) -> None:
    name = "x" * n_letters
    assert nearest(name, [name]) == (name if is_compared else "")


def test_an_error_is_told_in_five_hundred_letters() -> None:
    assert describe_error(KeyError("x" * 498)) == f"KeyError: '{'x' * 498}'"
    assert describe_error(ValueError("x" * 501)) == f"ValueError: {'x' * 500}... (501 characters)"
    assert describe_error(ValueError()) == "ValueError"
