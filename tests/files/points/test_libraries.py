"""The fence around reading libraries."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.errors import InputError, OrthoflowError, PluginError
from orthoflow.files.points.scan_file import load_library, reading


class Panic(BaseException):
    """As pyo3 raises for a panic in Rust: no Exception."""


@pytest.mark.parametrize(
    "error", [Panic("index 5"), MemoryError(), RuntimeError("a\nb"), OSError()]
)
def test_whatever_a_library_throws_becomes_one_sentence(error: BaseException) -> None:
    wanted = r"a\.laz cannot be read as LAZ: "
    with pytest.raises(InputError, match=wanted) as caught, reading(Path("a.laz"), "LAZ"):
        raise error
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3), OrthoflowError("own")])
def test_interrupts_and_own_errors_pass_the_fence(error: BaseException) -> None:
    with pytest.raises(type(error)), reading(Path("a.laz"), "LAZ"):
        raise error


def test_a_missing_library_is_named() -> None:
    with pytest.raises(PluginError, match=r"a\.foo needs the library no_such_reader"):
        load_library("no_such_reader", Path("a.foo"))
