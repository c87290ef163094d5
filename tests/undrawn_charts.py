"""A dot in the place of what is only drawn for a figure: that takes longer than most tests."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import TYPE_CHECKING, Final

import numpy as np

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


def blank_charts(request: pytest.FixtureRequest, patch: pytest.MonkeyPatch) -> None:
    """Put blanks in the place of matplotlib's figures, except in tests of charts.

    Setting up axes takes longer than many a result that they show. Tests of charts themselves ask
    for one of the fixtures `charts` and `drawings`.
    """
    if not {"charts", "drawings"} & {*request.fixturenames}:
        patch.setattr("matplotlib.figure.Figure", Blank)
        patch.setattr("orthoflow.files.drawing.styled", nullcontext)


class Blank:
    """Accepts every call in the place of a matplotlib figure, or of anything that it returns."""

    def __init__(self, figsize: tuple[float, float] = (1.0, 1.0), **_: object) -> None:
        self._size = figsize

    def get_size_inches(self) -> tuple[float, float]:
        """Width and height, as matplotlib's figure gives them."""
        return self._size

    def subplots(
        self, nrows: int = 1, ncols: int = 1, *, squeeze: bool = True, **_: object
    ) -> object:
        """Give as many blanks, in the shape that matplotlib gives axes in."""
        panels = np.empty((nrows, ncols), dtype=object)
        panels.fill(self)
        return panels.squeeze()[()] if squeeze else panels

    def __getitem__(self, _: object) -> Blank:
        return self

    def __iter__(self) -> Iterator[Blank]:
        return iter((self, self))

    def __call__(self, *_: object, **__: object) -> Blank:
        return self

    def __getattr__(self, name: str) -> Blank:
        if name.startswith("__"):  # numpy would take it for an array
            raise AttributeError(name)
        return self
