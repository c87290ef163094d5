"""Who waits for the compiler hears which kernel it is about."""

from __future__ import annotations

import re

import numba

from orthoflow.engine.worker import _News
from orthoflow.geometry import compiling
from orthoflow.geometry.kernel_news import heard_by
from orthoflow.sdk import StepEvent


def test_a_kernel_and_those_that_it_needs_are_told_once() -> None:
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
    told = [re.fullmatch(r"compiling (\w+) \((\d+) so far\)", text) for text in heard[:2]]
    (outer_name, first), (inner_name, second) = (
        match.groups() if match else ("", "") for match in told
    )
    assert (outer_name, inner_name, heard[2:]) == ("outer", "inner", [""])
    # Whatever else this process compiled before is counted, too.
    assert int(second) == int(first) + 1
    assert namespace["inner"](1.5) == 2.5  # type: ignore[operator]
    assert len(heard) == 3


def test_a_step_says_what_it_compiles_and_then_again_what_it_did() -> None:
    told: list[StepEvent] = []
    news = _News(told.append)
    news.listen(StepEvent(kind="progress", text="peeling", fraction=0.25))
    for text in ("compiling outer", "compiling inner", "", "compiling other", ""):
        news.compiling(text)
    assert [event.text for event in told] == [
        "peeling",
        "compiling outer",
        "compiling inner",
        "peeling",
        "compiling other",
        "peeling",
    ]
    assert {event.fraction for event in told} == {0.25}
