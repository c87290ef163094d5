"""Runs the `orthoflow` command with `python -m orthoflow`."""

from __future__ import annotations

from orthoflow.cli import main

main()
