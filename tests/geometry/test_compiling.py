"""One version of each kernel, whatever constants it is called with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core.caching import NullCache

from orthoflow.geometry.compiling import compiled, kernel_part


def compiled_here(kernel: Any) -> Any:
    """Take nothing that another process has compiled."""
    kernel._cache = NullCache()
    return kernel


@compiled_here
@kernel_part
def taken(values: Any, k: int, place: tuple[int, int]) -> int:
    return int(values[k]) + place[0] - place[1]


@compiled_here
@compiled
def taken_many(values: Any) -> int:
    count = 0
    for i in range(values.size):
        count += taken(values, count % 2, (i, 0))
    return (
        count + taken(values, 0, (0, 1)) + taken(values, 1, (0, count)) + taken(values, 2, (1, 2))
    )


@compiled_here
@kernel_part
def member(pair: tuple[int, float], k: int) -> float:
    return pair[k]


@compiled_here
@compiled
def both_members(n: int) -> float:
    return member((n, 0.5), 1) + member((n, 0.5), 0)


def test_a_part_has_one_version_for_all_constants() -> None:
    values = np.zeros(4, dtype=np.int64)
    # The counter goes 0, 1, 3, 6; then -1, -6 and -1 are added.
    assert taken_many(values) == 6 - 1 - 6 - 1
    assert len(taken.signatures) == 1


def test_a_tuple_of_several_types_is_indexed_by_constants_all_the_same() -> None:
    assert both_members(3) == 3.5
    assert len(member.signatures) == 2
