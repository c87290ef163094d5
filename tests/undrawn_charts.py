"""A dot in the place of every chart: drawing takes longer than what most tests look at."""

from __future__ import annotations

from base64 import b64decode
from typing import Final

from orthoflow.sdk import StepContext
from orthoflow.sdk.context import Drawing

# As it was when the tests began.
FIGURE: Final = StepContext.figure

# A PNG of one pixel.
_DOT: Final = b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg=="
)


def keep_dot(self: StepContext, name: str, content: bytes | Drawing, caption: str = "") -> None:
    """Keep a figure as a step does, but nothing of what a chart shows."""
    FIGURE(self, name, content if isinstance(content, bytes) else _DOT, caption)


def keep_dots_for_charts() -> None:
    """Draw no charts in this process."""
    StepContext.figure = keep_dot  # type: ignore[method-assign]
