"""A dot in the place of what is only drawn for a figure: that takes longer than most tests."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Iterator
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

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


def build_plane_charts_once(
    request: pytest.FixtureRequest, patch: pytest.MonkeyPatch, test: str = ""
) -> None:
    """Let a test set up the charts of its detections once; see `_build_charts_once`."""
    import matplotlib.figure
    from orthoflow_plugins.plane import figures, search

    common = ("draw_deviations", "draw_planes", "draw_thickness")
    own = ("draw_accumulator", "draw_space", "draw_sections", "_draw_normals")
    _build_charts_once(request, patch, (search, common, matplotlib.figure), test)
    _build_charts_once(request, patch, (figures, own, matplotlib.figure), test)


def build_orient_charts_once(
    request: pytest.FixtureRequest, patch: pytest.MonkeyPatch, test: str = ""
) -> None:
    """Let a test set up the charts of its orientations once; see `_build_charts_once`."""
    import matplotlib.figure
    from orthoflow_plugins.orient import report

    names = ("draw_positions", "draw_residuals")
    _build_charts_once(request, patch, (report, names, matplotlib.figure), test)


def _build_charts_once(
    request: pytest.FixtureRequest,
    patch: pytest.MonkeyPatch,
    charts: tuple[ModuleType, tuple[str, ...], ModuleType],
    test: str,
) -> None:
    """Let a test call what builds charts once, whatever its parameters and repetitions are.

    To set up their axes takes longer than many a result that they show: the first test of a file
    does it, others put their values onto a blank. Tests of charts themselves ask for one of the
    fixtures `charts` and `drawings`, and get each.

    Args:
        request: of the test.
        patch: lasts as long as it.
        charts: module that calls what builds charts, names it has there, and the module where
            that looks up matplotlib's `Figure`.
        test: what counts as one test; by default one with all its parameters.
    """
    if {"charts", "drawings"} & {*request.fixturenames}:
        return
    module, names, source = charts
    for name in names:
        key = (request.path, name)
        build = partial(_build_once, key, test or request.node.originalname, source)
        patch.setattr(module, name, partial(build, getattr(module, name)))


# File and what builds a chart -> tests that had it built.
_built: dict[tuple[object, str], set[str]] = {}


def _build_once(
    key: tuple[object, str],
    test: str,
    source: Any,
    build: Callable[..., None],
    *args: object,
    **known: object,
) -> None:
    tests = _built.setdefault(key, set())
    if test in tests:
        return
    figure = source.Figure
    if tests:
        source.Figure = Blank
    tests.add(test)
    try:
        build(*args, **known)
    finally:
        source.Figure = figure


class Blank:
    """Takes in the place of a matplotlib figure, or of what it gives, all that it is told."""

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
