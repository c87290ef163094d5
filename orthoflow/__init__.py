"""Orthoimages from laser scans and hand-held photographs, with methods that can be compared."""

from __future__ import annotations

from typing import TYPE_CHECKING

from orthoflow.version import __version__

if TYPE_CHECKING:
    from orthoflow.cli.from_python import run as run
    from orthoflow.report.notebooks import open_run as open_run
    from orthoflow.report.notebooks import open_runs as open_runs

__all__ = ["__version__", "open_run", "open_runs", "run"]


def __dir__() -> list[str]:
    # Names that are imported on first use must also be listed for `help` and completion.
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> object:
    # Imported on first use, so that `orthoflow --help` does not load numpy and h5py.
    if name in ("open_run", "open_runs"):
        from orthoflow.report import notebooks  # noqa: PLC0415

        return getattr(notebooks, name)
    if name == "run":
        from orthoflow.cli.from_python import run  # noqa: PLC0415

        return run
    raise AttributeError(f"module 'orthoflow' has no attribute {name!r}")
