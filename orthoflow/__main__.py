"""Lets `python -m orthoflow` do the same as the `orthoflow` command."""

from __future__ import annotations

from orthoflow.cli import main

main()
