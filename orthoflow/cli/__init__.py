"""The command line, with one module per command, which is imported when the command is used."""

from __future__ import annotations

from orthoflow.cli.program import main, program

__all__ = ["main", "program"]
