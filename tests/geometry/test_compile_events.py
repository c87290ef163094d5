"""Which kernel is compiled is reported to those who wait for it."""

from __future__ import annotations

import re

import numba

from orthoflow.geometry import compiling
from orthoflow.geometry.compile_events import on_compiling


def test_a_kernel_and_those_that_it_needs_are_reported_once() -> None:
    assert compiling.numba is numba
    namespace: dict[str, object] = {"njit": numba.njit}
    exec(
        "@njit\ndef inner(x):\n    return x + 1\n@njit\ndef outer(x):\n    return inner(x) * 2\n",
        namespace,
    )
    outer = namespace["outer"]
    reported: list[str] = []
    with on_compiling(reported.append):
        assert outer(1) == 4  # type: ignore[operator]
        assert outer(2) == 6  # type: ignore[operator]
    matches = [re.fullmatch(r"compiling (\w+) \((\d+) so far\)", text) for text in reported[:2]]
    (outer_name, first), (inner_name, second) = (
        match.groups() if match else ("", "") for match in matches
    )
    assert (outer_name, inner_name, reported[2:]) == ("outer", "inner", [""])
    # Whatever else this process compiled before is counted, too.
    assert int(second) == int(first) + 1
    assert namespace["inner"](1.5) == 2.5  # type: ignore[operator]
    assert len(reported) == 3
