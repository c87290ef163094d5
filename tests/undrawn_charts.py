"""A dot in the place of what is only drawn for a figure: that takes longer than most tests."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Final

from orthoflow.sdk import StepContext
from orthoflow.sdk.context import Drawing

if TYPE_CHECKING:
    import pytest

# As it was when the tests began.
FIGURE: Final = StepContext.figure

# A PNG of one pixel.
_DOT: Final = b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg=="
)


def keep_dot(
    self: StepContext, name: str, content: bytes | Callable[[], bytes] | Drawing, caption: str = ""
) -> None:
    """Keep a figure as a step does, but nothing of what is still to be drawn."""
    FIGURE(self, name, content if isinstance(content, bytes) else _DOT, caption)


def keep_dots_for_charts() -> None:
    """Draw no charts in this process."""
    StepContext.figure = keep_dot  # type: ignore[method-assign]


def build_charts_once(
    request: pytest.FixtureRequest, patch: pytest.MonkeyPatch, module: ModuleType, *names: str
) -> None:
    """Let a test call what builds charts once, whatever its parameters and repetitions are.

    To set up their axes takes longer than many a result that they show. Tests of charts themselves
    ask for one of the fixtures `charts` and `drawings`, and get each.
    """
    if {"charts", "drawings"} & {*request.fixturenames}:
        return
    for name in names:
        build = partial(_build_once, (request.path, request.node.originalname, name))
        patch.setattr(module, name, partial(build, getattr(module, name)))


# File, test and what builds a chart.
_built: set[tuple[object, ...]] = set()


def _build_once(
    key: tuple[object, ...], build: Callable[..., None], *args: object, **known: object
) -> None:
    if key not in _built:
        _built.add(key)
        build(*args, **known)
