"""What is said of a run of a method that failed."""

from __future__ import annotations

import linecache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from orthoflow.errors import MethodError, ProductError
from orthoflow.products import PointLabels
from orthoflow.testing import cases as module
from orthoflow.testing.examples import ExampleError


class Params(BaseModel):
    """Two parameters."""

    size_m: float
    count: int = 3


class Toy:
    """Stands for a method; this file is its package."""

    Params = Params


def failed(error: Exception) -> str:
    witness: Any = SimpleNamespace(trial=SimpleNamespace(method=Toy))
    return module._failure(error, lambda: witness)


def fail(error: Exception) -> None:
    raise error


def raised(error: Exception) -> Exception:
    """The error as it comes out of a method's own line."""
    with pytest.raises(type(error)) as caught:
        fail(error)
    return caught.value


def own_line() -> str:
    source = linecache.getlines(__file__)
    line = next(k for k, text in enumerate(source, start=1) if text.strip() == "raise error")
    return f" (test_cases.py:{line})"


def test_the_line_is_told_where_the_method_itself_raised() -> None:
    where = own_line()
    assert failed(raised(ValueError("no"))).endswith(where)
    assert failed(raised(MethodError("too few"))) == (
        f"the method refuses the suite's inputs: too few{where}"
    )
    # Raised in its own line it is the method's word, not that of a product it makes.
    assert failed(raised(ProductError("odd"))) == (
        f"the method refuses the suite's inputs: odd{where}"
    )
    assert failed(raised(MethodError(f"too few{where}"))).count(where) == 1


def test_without_a_line_of_its_own_none_is_told() -> None:
    assert failed(MethodError("too few")) == "the method refuses the suite's inputs: too few"
    assert failed(KeyError("x")).startswith("the method raised KeyError")
    assert "(" not in failed(ValueError("no"))


def test_what_a_method_makes_is_not_valid_where_a_product_says_so() -> None:
    with pytest.raises(ProductError) as caught:
        PointLabels(plane_index=np.zeros((2, 2), dtype=np.int16))
    said = failed(caught.value)
    assert said.startswith("what the method makes is not valid: ")
    # Where annotations do not fit is seen when the method has returned, in no line of its own.
    behind = caught.value.with_traceback(caught.tb.tb_next)
    assert failed(behind).startswith("what the method makes is not valid: ")
    assert " (test_cases.py:" in said


def test_a_missing_example_is_told_as_it_is() -> None:
    assert failed(ExampleError("there is no example of frames")) == "there is no example of frames"
