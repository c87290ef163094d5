"""Keeps rasterio from printing a traceback over text in a file that is not UTF-8."""

from __future__ import annotations

import sys
from functools import cache
from types import TracebackType


@cache
def let_go_of_foreign_text() -> None:
    """Print no traceback where rasterio cannot read what GDAL quotes of a file that is not UTF-8.

    It tries to in a callback, which can raise nothing, and so prints the error in both ways that
    Python has for that. What GDAL has against the file is raised behind it.
    """
    hear, show = sys.unraisablehook, sys.excepthook

    def hear_rest(unraisable: sys.UnraisableHookArgs) -> None:
        in_rasterio = "rasterio" in str(unraisable.object)
        if not (in_rasterio and isinstance(unraisable.exc_value, UnicodeDecodeError)):
            hear(unraisable)

    def show_rest(
        kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        # Whatever ends a program has come through some line of it.
        if not (trace is None and isinstance(error, UnicodeDecodeError)):
            show(kind, error, trace)

    sys.unraisablehook, sys.excepthook = hear_rest, show_rest
