"""Who waits for the compiler hears which kernel it is about."""

from __future__ import annotations

import numba

from orthoflow.geometry import compiling
from orthoflow.geometry.kernel_news import heard_by


def test_a_kernel_and_those_that_it_needs_are_counted_and_told_once() -> None:
    assert compiling.numba is numba
    namespace: dict[str, object] = {"njit": numba.njit}
    exec(
        "@njit\ndef inner(x):\n    return x + 1\n@njit\ndef outer(x):\n    return inner(x) * 2\n",
        namespace,
    )
    outer = namespace["outer"]
    heard: list[str] = []
    with heard_by(heard.append):
        assert outer(1) == 4  # type: ignore[operator]
        assert outer(2) == 6  # type: ignore[operator]
    assert heard == ["compiling 1 of 2: outer", "compiling 2 of 2: inner", ""]
    assert namespace["inner"](1.5) == 2.5  # type: ignore[operator]
    assert len(heard) == 3
