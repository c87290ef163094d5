"""The command line: one module per command, loaded when it is used."""

from __future__ import annotations

from orthoflow.cli.program import main, program

__all__ = ["main", "program"]
