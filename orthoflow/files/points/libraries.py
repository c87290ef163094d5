"""A fence around reading libraries: whatever they throw becomes one sentence about the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from orthoflow.errors import InputError, OrthoflowError, PluginError

T = TypeVar("T")


@contextmanager
def reading(path: Path, format_name: str) -> Iterator[None]:
    """Turn what a library throws while it reads a file into an `InputError`.

    Raises:
        InputError: the library failed.
    """
    try:
        yield
    except (OrthoflowError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        # BaseException: a panic in a library written in Rust is not an Exception.
        raise InputError(
            f"{path.name} cannot be read as {format_name}: {_first_line(error)}; the file is "
            "damaged or cut off, copy or export it again"
        ) from error


def guarded(items: Iterator[T], path: Path, format_name: str) -> Iterator[T]:
    """Pass on a library's items, with its errors turned as `reading` does."""
    while True:
        with reading(path, format_name):
            item = next(items, None)
        if item is None:
            return
        yield item


# Any: the libraries have no types.
def load_library(name: str, path: Path) -> Any:
    """Import a reading library when a file needs it.

    Raises:
        PluginError: it is not installed or does not load.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise PluginError(
            f"{path.name} needs the library {name}, which does not load ({_first_line(error)}): "
            f"install it with `python -m pip install {name}`"
        ) from error


def _first_line(error: BaseException) -> str:
    text = str(error).strip() or type(error).__name__
    return " ".join(text.splitlines()[0].split())[:200].rstrip(".:;, ")
