"""What is said of a run of a method that failed."""

from __future__ import annotations

import linecache
import re
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


def test_an_error_is_named_with_the_line_of_the_method_that_raised_it() -> None:
    where = own_line()
    said = "on the suite's inputs the method raised "
    assert failed(raised(ValueError("no"))) == f"{said}ValueError: no{where}"
    assert failed(raised(MethodError(f"too few{where}"))).count(where) == 1
    assert failed(MethodError("too few")) == f"{said}MethodError: too few"
    with pytest.raises(ProductError) as caught:
        PointLabels(plane_index=np.zeros((2, 2), dtype=np.int16))
    assert re.search(r"raised ProductError: .* \(test_cases\.py:\d+\)$", failed(caught.value))


def test_a_missing_example_is_told_as_it_is() -> None:
    assert failed(ExampleError("there is no example of frames")) == "there is no example of frames"
