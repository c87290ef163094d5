"""The command line: one module per command, imported when the command is used."""

from __future__ import annotations

from orthoflow.cli.program import main, program

__all__ = ["main", "program"]
