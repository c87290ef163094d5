"""Orthoimages from laser scans and free-hand photographs, with methods that can be compared."""

from __future__ import annotations

from typing import TYPE_CHECKING

from orthoflow.version import __version__

if TYPE_CHECKING:
    from orthoflow.cli.from_python import run as run
    from orthoflow.report.notebooks import open_run as open_run

__all__ = ["__version__", "open_run", "run"]


def __dir__() -> list[str]:
    # What is loaded on first use is there for `help` and for completion, too.
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> object:
    # Lazy: `orthoflow --help` must not load numpy and h5py for a name it never uses.
    if name == "open_run":
        from orthoflow.report.notebooks import open_run  # noqa: PLC0415

        return open_run
    if name == "run":
        from orthoflow.cli.from_python import run  # noqa: PLC0415

        return run
    raise AttributeError(f"module 'orthoflow' has no attribute {name!r}")
