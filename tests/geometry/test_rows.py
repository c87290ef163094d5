"""Rows of arrays are taken and joined together, whatever else a dataclass says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import Rows


@dataclass(frozen=True, kw_only=True)
class Places(Rows):
    wall: int
    at: NDArray[np.float64]
    names: NDArray[np.str_]


PLACES = Places(wall=3, at=np.arange(6.0).reshape(3, 2), names=np.array(["a", "b", "c"]))


def test_taking_and_joining_keep_the_rows_of_all_arrays_together() -> None:
    some = PLACES.take(np.array([True, False, True]))
    assert (some.wall, len(some), some.at.tolist()) == (3, 2, [[0.0, 1.0], [4.0, 5.0]])
    again = Places.joined([some.take(np.array([1, 0])), PLACES.take(slice(1, 2))])
    assert (again.wall, again.names.tolist()) == (3, ["c", "a", "b"])
    assert again.at.tolist() == [[4.0, 5.0], [0.0, 1.0], [2.0, 3.0]]
