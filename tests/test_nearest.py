"""Names that a misspelt one may stand for, and how much is compared and said."""

from __future__ import annotations

import pytest

from orthoflow.errors import nearest


@pytest.mark.parametrize(("n_letters", "is_compared"), [(200, True), (201, False)])
def test_names_of_two_hundred_letters_are_compared_and_no_longer_ones(
    n_letters: int, is_compared: bool
) -> None:
    name = "x" * n_letters
    assert nearest(name, [name]) == (name if is_compared else "")
