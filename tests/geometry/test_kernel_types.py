"""What a kernel takes is read as it was written."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numba import types
from numba.core.errors import NumbaNotImplementedError
from numpy.typing import NDArray

from orthoflow.geometry.kernel_types import Text, text_of, type_of


class Table(NamedTuple):
    """What kernels take together."""

    values: NDArray[np.float32]
    step_m: float


_VALUES = types.Array(types.float32, 2, "C", readonly=True)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (types.int64, "int64"),
        (types.boolean, "bool"),
        (types.Array(types.uint8, 3, "A"), "uint8 3 A"),
        (_VALUES, "const float32 2 C"),
        (types.UniTuple(types.int64, 2), ["", "int64", "int64"]),
        (types.Tuple((types.int64, _VALUES)), ["", "int64", "const float32 2 C"]),
        (types.UniTuple(types.slice2_type, 2), ["", "slice", "slice"]),
        (
            types.NamedTuple((_VALUES, types.float64), Table),
            [f"{__name__}:Table", "const float32 2 C", "float64"],
        ),
        (types.NamedUniTuple(types.float64, 2, Table), [f"{__name__}:Table"] + 2 * ["float64"]),
    ],
)
def test_a_type_is_read_as_it_was_written(kind: types.Type, text: Text) -> None:
    assert text_of(kind) == text
    assert type_of(text) == kind


def test_a_type_that_no_kernel_of_ours_takes_is_refused() -> None:
    with pytest.raises(NumbaNotImplementedError):
        text_of(types.unicode_type)


@pytest.mark.parametrize("text", ["", "float65", "float64 2", ["nowhere:Table", "int64"]])
def test_a_text_that_is_no_type_is_refused(text: Text) -> None:
    with pytest.raises((AttributeError, ImportError, LookupError, TypeError, ValueError)):
        type_of(text)
